"""Many simulations of one model on a GPU, by MuJoCo Warp; its arrays are shared with torch."""

from __future__ import annotations

import contextlib
import copy
import logging
from collections.abc import Callable, Iterator
from functools import cached_property
from types import ModuleType
from typing import Any

import mujoco
import torch

from pace_envs.compiler.fusion import launch_pending
from pace_envs.devices import find_device
from pace_envs.simulation import EnvIds, Simulation

_PLANE, _SPHERE, _CAPSULE, _BOX = (
    mujoco.mjtGeom.mjGEOM_PLANE,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_BOX,
)
_MOST_CONTACTS = 64
"""More at once are not expected of a robot, however many of its geoms could touch."""
_CONTACTS = {
    frozenset({_PLANE, _CAPSULE}): 2,
    frozenset({_CAPSULE}): 2,
    frozenset({_CAPSULE, _BOX}): 2,
    frozenset({_BOX}): 8,
}
_SINGLE = 1
_OTHERS = 4


def most_contacts(model: mujoco.MjModel) -> int:
    """Contacts that the colliding pairs of geoms can have together, at most 64."""
    total = int(model.npair) * _OTHERS
    for i in range(model.ngeom):
        for j in range(i + 1, model.ngeom):
            if _collide(model, i, j):
                total += _contacts_of(int(model.geom_type[i]), int(model.geom_type[j]))
    return min(total, _MOST_CONTACTS)


def most_constraints(model: mujoco.MjModel, contacts: int) -> int:
    """Rows of the constraint solver: equalities, joint friction, limits, and the pyramids of that many contacts."""
    equalities = 6 * int(model.neq)
    limits = int(model.jnt_limited.sum()) + 2 * int(model.ntendon)
    widest = int(model.geom_condim.max(initial=1))
    rows = max(1, 2 * (widest - 1))
    return equalities + int(model.nv) + int(model.ntendon) + limits + rows * contacts


def _collide(model: mujoco.MjModel, i: int, j: int) -> bool:
    if not (model.geom_contype[i] & model.geom_conaffinity[j] or model.geom_contype[j] & model.geom_conaffinity[i]):
        return False
    a, b = (int(model.body_weldid[model.geom_bodyid[g]]) for g in (i, j))
    if a == b:
        return False
    parents = [int(model.body_weldid[model.body_parentid[body]]) for body in (a, b)]
    return 0 in (a, b) or not (parents[0] == b or parents[1] == a)


def _contacts_of(one: int, other: int) -> int:
    kinds = frozenset({one, other})
    if _SPHERE in kinds:
        return _SINGLE
    return _CONTACTS.get(kinds, _OTHERS)


_INSTALL = 'pip install "pace-mujoco[gpu]"'
_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0")
"""Constants that MuJoCo computes of masses and armatures: one per environment where those are."""
_AFTER_RESETS = frozenset({"sensordata", "qacc"})
"""Derived fields that nothing reads between an environment's reset and its first step."""
_STATE = ("qpos", "qvel", "qacc_warmstart", "qfrc_applied", "time")


class WarpSimulation(Simulation):
    """A :class:`~pace_envs.simulation.Simulation` on a GPU, in float32.

    The same MuJoCo model is stepped by `MuJoCo Warp <https://github.com/google-deepmind/mujoco_warp>`_. Reads, writes
    and steps are queued on torch's current stream; nothing waits for the GPU. A step is replayed from a CUDA graph, and
    it can be captured into one of torch's.

    What differs from the processor: after a reset of some environments, contact sensors and accelerations are those of
    the step before until the next one.
    """

    dtype = torch.float32
    turns_motors = False
    data: Any
    warp_model: Any

    def bind(self, field: str) -> torch.Tensor:
        """A live tensor over a field of the data, shape (num_envs, ...)."""
        if not hasattr(self.data, field):
            raise ValueError(f"MuJoCo Warp has no field {field!r} of the data. Use device='cpu' for it.")
        self._bound.add(field)
        return self._warp.to_torch(getattr(self.data, field))

    def expand(self, field: str) -> torch.Tensor:
        """A live tensor over the values per simulation of a model field, shape (num_envs, ...)."""
        if field not in self._expanded:
            whole = getattr(self.warp_model, field)
            shared = self._warp.to_torch(whole)
            own = shared[:1].expand(self.num_envs, *shared.shape[1:]).contiguous()
            setattr(self.warp_model, field, self._warp.from_torch(own, dtype=whole.dtype))
            self._expanded[field] = own
            self._forget_graphs()
        return self._expanded[field]

    def _step(self, middle: torch.Tensor | None = None) -> None:
        if middle is None:
            self._run("step")
        else:
            self._middle.copy_(middle)
            self._run("halves")

    @cached_property
    def _middle(self) -> torch.Tensor:
        """Speeds of a step's middle, which ``halves`` reads, (num_envs, nv)."""
        return torch.zeros_like(self.qvel)

    @cached_property
    def _outcomes(self) -> dict[str, torch.Tensor]:
        fields = ("qfrc_constraint", "nf", "nefc")
        return {field: self._warp.to_torch(getattr(self.data, field)) for field in fields}

    def _change_of_speeds(self, impulse: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
        self._impulse.copy_(impulse)
        self._run("solve_m")
        return self._response

    @cached_property
    def _impulse(self) -> torch.Tensor:
        """What ``solve_m`` reads, (num_envs, nv)."""
        return torch.zeros_like(self.qvel)

    @cached_property
    def _response(self) -> torch.Tensor:
        """What ``solve_m`` writes, (num_envs, nv)."""
        return torch.zeros_like(self.qvel)

    def forward(self, env_ids: EnvIds = None) -> None:
        """Compute everything that follows from the state, without advancing time.

        For some environments, only where it is read before the next step; then for all of them.
        """
        self.update_constants()
        if env_ids is None or not self._bound <= _AFTER_RESETS.union(_STATE):
            if self._as_armature is not None:
                self._as_armature.zero_()
            self._run("forward")

    def reset(self, env_ids: EnvIds = None) -> None:
        """Put the state of all or some simulations back to the model's."""
        rows = self.rows(env_ids)
        self.qpos[rows] = self._qpos0
        for field in (self.qvel, self.qfrc_applied, self.gained, *self._cleared):
            field[rows] = 0.0

    @property
    def state(self) -> list[torch.Tensor]:
        """Live tensors of all that :meth:`reset` puts back, (num_envs, ...) each."""
        return [self.qpos, self.qvel, self.qfrc_applied, self.gained, *self._cleared]

    def rows(self, env_ids: EnvIds) -> torch.Tensor | slice:
        """What selects environments; indices that are on the device already are trusted, so that nothing waits."""
        if env_ids is None or isinstance(env_ids, slice):
            return slice(None) if env_ids is None else env_ids
        if isinstance(env_ids, torch.Tensor) and env_ids.device == self.device and env_ids.dtype != torch.bool:
            return env_ids.long()
        return torch.as_tensor(self.resolve_env_ids(env_ids), device=self.device).long()

    def model_of(self, env_id: int) -> mujoco.MjModel:
        """A copy of the model as one environment has it."""
        model = copy.copy(self.model)
        for field, values in self._expanded.items():
            own = getattr(model, field)
            own[:] = values[env_id].cpu().numpy().reshape(own.shape)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def read_data(self, env_id: int, data: mujoco.MjData) -> None:
        """Read the state of one environment."""
        for field in ("qpos", "qvel", "qfrc_applied"):
            getattr(data, field)[:] = getattr(self, field)[env_id].cpu().numpy()
        data.time = float(self._warp.to_torch(self.data.time)[env_id])

    def close(self) -> None:
        """Release the simulations."""
        self._forget_graphs()
        self.data = self.warp_model = None

    # ------------------------------------------------------------------ inside

    def _find_device(self) -> torch.device:
        device = find_device(self.cfg.device)
        self._warp, self._mjw = _packages()
        return device

    def _start(self) -> None:
        self.batch = self.data = self.warp_model = None
        self._graphs: dict[str, Any] = {}
        self._kept: list[Any] = []
        self._bound: set[str] = set()
        self.version = 0
        flags = self.model.opt.disableflags
        self.model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # Warp never starts again by itself
        with self._on_stream():
            try:
                self.warp_model = self._mjw.put_model(self.model)
                contacts = most_contacts(self.model) if self.cfg.contacts else 0
                self.data = self._mjw.make_data(
                    self.model, nworld=self.num_envs, nconmax=contacts, njmax=most_constraints(self.model, contacts)
                )
            except (NotImplementedError, ValueError) as error:
                raise ValueError(
                    f"MuJoCo Warp cannot simulate this model: {error} Use device='cpu', or take that out of the model."
                ) from None
        self.model.opt.disableflags = flags
        self._qpos0 = self.tensor(self.model.qpos0)
        self._cleared = [self.bind(name) for name in ("qacc", "qacc_warmstart", "time")]

    def _update_constants(self) -> None:
        self._constants_changed = False
        if not {"body_mass", "body_inertia", "body_ipos", "body_pos", "dof_armature"} & set(self._expanded):
            return
        for field in _DERIVED:
            self.expand(field)
        self._run("set_const")

    def _run(self, name: str) -> None:
        """Queue a step, a forward pass or the constants on torch's current stream."""
        launch_pending()
        if self.device.type == "cpu" or not self.cfg.graphs:
            with self._on_stream():
                self._call(name)
            return
        wp = self._warp
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
        if torch.cuda.is_current_stream_capturing():
            with wp.ScopedStream(stream, sync_enter=False, sync_exit=False):
                wp.capture_begin(stream=stream, external=True)
                try:
                    self._call(name)
                finally:
                    self._kept.append(wp.capture_end(stream=stream))
            return
        if name not in self._graphs:
            with self._unchanged_state(), wp.ScopedStream(stream):
                self._call(name)  # kernels are loaded at their first launch, which cannot be captured
            torch.cuda.synchronize(self.device)
            with wp.ScopedDevice(str(self.device)), wp.ScopedCapture() as capture:
                self._call(name)
            self._graphs[name] = capture.graph
        wp.capture_launch(self._graphs[name], stream=stream)

    def _call(self, name: str) -> None:
        if name == "halves":
            self._halves()
            return
        function: Callable[..., None] = getattr(self._mjw, name)
        more = [self._warp.from_torch(each) for each in (self._response, self._impulse)] if name == "solve_m" else []
        function(self.warp_model, self.data, *more)

    def _halves(self) -> None:
        """A step whose gravity and Coriolis forces act at the speed of its middle."""
        model, data, wp, mjw = self.warp_model, self.data, self._warp, self._mjw
        mjw.step1(model, data)
        wp.copy(self._speed, data.qvel)
        wp.copy(data.qvel, wp.from_torch(self._middle))
        mjw.fwd_velocity(model, data)
        wp.copy(data.qvel, self._speed)
        mjw.passive(model, data)  # damping is that of the speed before the step
        mjw.step2(model, data)

    @cached_property
    def _speed(self) -> Any:
        """Where ``halves`` keeps the speeds before the step."""
        return self._warp.empty_like(self.data.qvel)

    @contextlib.contextmanager
    def _on_stream(self) -> Iterator[None]:
        wp = self._warp
        if self.device.type == "cpu":
            with wp.ScopedDevice("cpu"):
                yield
        else:
            with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self.device))):
                yield

    @contextlib.contextmanager
    def _unchanged_state(self) -> Iterator[None]:
        fields = [self._warp.to_torch(getattr(self.data, name)) for name in _STATE]
        saved = [field.clone() for field in fields]
        launch_pending()
        yield
        for field, value in zip(fields, saved, strict=True):
            field.copy_(value)
        launch_pending()

    def _forget_graphs(self) -> None:
        self._graphs.clear()
        self._kept.clear()
        self.version += 1


def _packages() -> tuple[ModuleType, ModuleType]:
    try:
        import mujoco_warp
        import warp
    except ImportError as error:
        raise ValueError(f"A GPU needs MuJoCo Warp, which is not installed ({error}): {_INSTALL}.") from None
    warp.config.log_level = max(warp.config.log_level, logging.WARNING)  # not a line for every kernel
    warp.init()
    return warp, mujoco_warp
