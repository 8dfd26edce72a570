"""Many simulations of one model on a thread pool, their arrays shared with torch."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import mujoco
import numpy as np
import torch
from mujoco import batch

from pace_actuators.effects import Effect
from pace_actuators.effects.fading_friction import solver_parameters, step_of_constraint
from pace_actuators.memory import check_memory
from pace_envs.coulomb import TURNS, impulses, settled
from pace_envs.model_file import leave_out_pictures
from pace_envs.motor_coordinates import MotorCoordinates
from pace_envs.moving_frame import FIELDS, FrameState, bias_in_frame
from pace_envs.mujoco_warnings import keep_quiet
from pace_envs.quaternions import from_rotation_vector, multiply

EnvIds = Sequence[int] | torch.Tensor | np.ndarray | slice | None

_INTEGRATORS = {
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "leapfrog": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}


_STATE = ("qpos", "qvel", "qfrc_applied", "qacc_warmstart", "time")
_FRICTION = ("qfrc_constraint", "nf", "nefc")
"""The constraints' forces after a step, how many frictions there are, and how many constraints."""


@dataclass(kw_only=True)
class SimulationCfg:
    """How the physics is stepped."""

    dt: float = 0.0025
    """Physics time step [s]."""

    integrator: Literal["implicitfast", "leapfrog", "implicit", "euler"] = "implicitfast"
    """One of MuJoCo's, all of first order, or ``"leapfrog"``: of second order, at little more than implicitfast's cost.

    With x and v the state, M, D and f the inertia, the damping and all other forces:

        x½ = x + h v / 2        M(x½) (v₊ - v) = h (f - c(x½, v½) - D (v + v₊) / 2)        x₊ = x½ + h v₊ / 2

    Gravity and Coriolis forces c act at the speed of the step's middle, v½ = v + (v - v₋) / 2 with v₋ one step before.
    What is held over the step (a drive's torque) acts when it should, and Coulomb friction turns where the speed passes
    zero (:mod:`pace_envs.coulomb`). Contacts and limits remain of first order.
    """

    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """Gravity [m/s^2]."""

    friction_timeconst: float | None = None
    """Time constant of the joints' Coulomb friction [s]; ``None``: two time steps.

    MuJoCo's default of 20 ms is soft: a stuck joint creeps.
    """

    friction_impedance: float = 0.999
    """Impedance of the joints' Coulomb friction, 0 to 1; the closer to 1, the less a stuck joint creeps."""

    contacts: bool = False
    """Whether geoms collide."""

    sensors: bool = True
    """Whether MuJoCo computes the model's sensors; without them the model has no textures either."""

    num_threads: int = 0
    """Threads of the physics; 0 means one per processor that the process may use. Results do not depend on it."""

    device: str = "cpu"
    """Where it runs: ``"cpu"`` in float64, or ``"cuda:0"``, ``"cuda:1"``, … in float32 by MuJoCo Warp."""

    graphs: bool = True
    """Whether a step is replayed from a CUDA graph on a GPU; else every kernel is launched by itself."""

    fused: bool = True
    """Whether what is captured of drives and managers becomes a few kernels (:mod:`pace_envs.compiler`); else each of
    torch's operations is one."""

    class_type: Callable[[SimulationCfg, mujoco.MjSpec, int], Simulation] | None = None
    """What builds the simulation; ``None`` means :class:`Simulation`, or on a GPU ``WarpSimulation``."""


def make_simulation(cfg: SimulationCfg, spec: mujoco.MjSpec, num_envs: int) -> Simulation:
    """Build what the configuration asks for."""
    if cfg.class_type is not None:
        return cfg.class_type(cfg, spec, num_envs)
    if cfg.device == "cpu":
        return Simulation(cfg, spec, num_envs)
    from pace_envs.warp_simulation import WarpSimulation  # only where it is asked for

    return WarpSimulation(cfg, spec, num_envs)


def available_processors() -> int:
    """How many processors this process may use: fewer than there are where it is pinned to some."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Simulation:
    """Steps ``num_envs`` copies of a model and exposes their fields as torch tensors (no copies).

    Attributes:
        device: Device of all tensors.
        dtype: Type of all tensors.
        model: The compiled model.
        gained: Of speed in the last step of second order, in MuJoCo's coordinates, (num_envs, nv).
        friction_time: Time constant of each Coulomb friction that gives way, 0 where it is hard, (num_envs, nv) [s];
            ``None``: all are hard.
        version: Grows where arrays were replaced: CUDA graphs that were captured before are of no use.
    """

    dtype = torch.float64
    version = 0
    turns_motors = True
    """Whether it can hold the coordinates of motors that move several joints."""
    batch: Any

    @property
    def is_trapezoidal(self) -> bool:
        """Whether positions move with the mean of the old and the new speed; else with the new one (semi-implicit)."""
        return self.cfg.integrator == "leapfrog"

    @property
    def turns_friction(self) -> bool:
        """Whether Coulomb friction turns within a step; soft friction does not."""
        return self.is_trapezoidal and self.cfg.friction_timeconst is None

    def __init__(self, cfg: SimulationCfg, spec: mujoco.MjSpec, num_envs: int):
        """Compile the model and start the thread pool.

        Args:
            spec: The model; it is changed: options, joint friction's solver parameters, no actuators or keys.

        Raises:
            ValueError: If a value of the configuration or the model is unusable.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}, expected at least 1.")
        if not (np.isfinite(cfg.dt) and 0 < cfg.dt <= 0.1):
            raise ValueError(f"sim.dt is {cfg.dt} s, expected a time step in (0, 0.1] s.")
        if cfg.integrator not in _INTEGRATORS:
            cure = ' Write "leapfrog", which takes the place of "rk4".' if cfg.integrator == "rk4" else ""
            raise ValueError(f"Unknown integrator {cfg.integrator!r}. Available: {', '.join(_INTEGRATORS)}.{cure}")
        self.cfg = cfg
        self.num_envs = num_envs
        self.device = self._find_device()
        self.model = self._compile(spec)
        self._start()
        self.qpos = self.bind("qpos")
        self.qvel = self.bind("qvel")
        self.qfrc_applied = self.bind("qfrc_applied")
        self._constants_changed = False
        self._expanded: dict[str, torch.Tensor] = {}
        self._drift = Drift(self.model, self.device) if self.is_trapezoidal else None
        self.gained = torch.zeros_like(self.qvel)
        self._bias: torch.Tensor | None = None
        self._link_fields: dict[str, torch.Tensor] = {}
        self._link_places: dict[int, tuple[torch.Tensor, ...]] = {}
        self._frame: _Frame | None = None
        self.coordinates: MotorCoordinates | None = None
        self.carrying: torch.Tensor | None = None
        """What driven joints carry of joints that follow them, (nv, nv): see ``ClosedLoops.carrying``."""
        self.friction_time: torch.Tensor | None = None
        self._as_armature: torch.Tensor | None = None
        """Of damping, in the inertia that was computed last, (num_envs, nv) [kg m²]; only where friction is soft."""

    def couple(self, coordinates: MotorCoordinates) -> None:
        """Let state, torques and what drives leave to the model be those of motors in the columns of their joints."""
        self.coordinates = coordinates
        coordinates.to_motors()

    @contextmanager
    def _in_joints(self) -> Iterator[None]:
        """MuJoCo's own coordinates for a while."""
        if self.coordinates is None:
            yield
            return
        self.coordinates.to_joints()
        try:
            yield
        finally:
            self.coordinates.to_motors()

    @property
    def qfrc_bias(self) -> torch.Tensor:
        """Torque of gravity and of the motion, with the sign of MuJoCo, (num_envs, nv) [N m].

        Driven joints carry those that follow them by a ratio.
        """
        bias = self._own_bias if self._bias is None else self._bias
        bias = bias if self.carrying is None else bias @ self.carrying.T
        return bias if self.coordinates is None else self.coordinates.efforts_of_motors(bias)

    @cached_property
    def _own_bias(self) -> torch.Tensor:
        """The same as MuJoCo computes it: of a base at rest, at the speed before a step."""
        return self.bind("qfrc_bias")

    def move_base(self, motion: torch.Tensor | None, point: np.ndarray | None = None) -> None:
        """Let the base move in the next physics steps: see :func:`~pace_envs.moving_frame.bias_in_frame`.

        Args:
            motion: Of each physics step, (steps, num_envs, 9): angular velocity [rad/s], angular acceleration [rad/s²]
                and specific force [m/s²] in the middle of it, in the model's axes; ``None``: it rests under gravity.
            point: Where the specific force was measured, (num_envs, 3) [m], in the model's world.
        """
        if motion is None or point is None:
            self._frame = self._bias = None
        elif self._frame is None:
            self._frame = _Frame(motion=motion, point=point, fields=[self.bind(name).numpy() for name in FIELDS])
        else:
            self._frame.motion, self._frame.point, self._frame.step = motion, point, 0

    def bind(self, field: str) -> torch.Tensor:
        """A live tensor over an ``MjData`` field, shape (num_envs, ...).

        State fields can be written; fields that MuJoCo computes are for reading only.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # torch knows no read-only tensors
            return torch.from_numpy(self.batch.bind(field))

    def expand(self, field: str) -> torch.Tensor:
        """A live tensor over the values per simulation of an ``MjModel`` field, shape (num_envs, ...).

        Call :meth:`constants_changed` after writing.
        """
        if field not in self._expanded:
            self._expanded[field] = torch.from_numpy(self.batch.expand(field))
        return self._expanded[field]

    def write_passive(
        self,
        columns: torch.Tensor | slice,
        armature: torch.Tensor,
        friction: torch.Tensor,
        viscous: torch.Tensor,
        implicit: torch.Tensor | None,
    ) -> None:
        """Write what drives leave to the simulation, (num_envs, len(columns)) each; after the applied torques.

        Args:
            armature: Rotor inertia [kg m²].
            friction: Coulomb friction [N m].
            viscous: Viscous friction [N m s/rad].
            implicit: Viscous friction that must act on the speed at the end of the step [N m s/rad].
        """
        if implicit is None:
            damping = viscous
        elif not self.is_trapezoidal:
            damping = viscous + implicit
        else:  # _leap() lets half of the damping act on the speed before the step: of ``implicit``, nothing
            damping = viscous + 2.0 * implicit
            self.qfrc_applied[:, columns] += implicit * self.qvel[:, columns]
        self.expand("dof_armature")[:, columns] = armature
        self.expand("dof_frictionloss")[:, columns] = friction
        self.expand("dof_damping")[:, columns] = damping

    def soften_friction(self, columns: torch.Tensor | slice, time_constant: torch.Tensor) -> None:
        """Let Coulomb friction give way, as MuJoCo's own constraint does.

        Args:
            columns: Degrees of freedom.
            time_constant: Of MuJoCo's ``solreffriction`` at its defaults of ``solimp``, 0 where it is hard,
                (num_envs, len(columns)) [s].
        """
        if self.friction_time is None:
            self.friction_time, self._as_armature = torch.zeros_like(self.qvel), torch.zeros_like(self.qvel)
        self.friction_time[:, columns] = time_constant
        of_joints = self.friction_time
        if (turn := self.coordinates) is not None:  # friction of motors that move several joints is their tendons'
            motors = turn.carried["frictionloss"]
            of_joints = of_joints.index_fill(1, motors.columns, 0.0)
            time = self.friction_time[:, motors.columns]
            self._write_softness("tendon_solref_fri", "tendon_solimp_fri", motors.tendons, time)
        self._write_softness("dof_solref", "dof_solimp", slice(None), of_joints)

    def friction_weights(self, columns: torch.Tensor) -> torch.Tensor:
        """What a torque on a joint accelerates it by in the model's own posture, by which MuJoCo scales its friction.

        Args:
            columns: Degrees of freedom.

        Returns:
            (num_envs, len(columns)) [1 / kg m²].
        """
        self.update_constants()
        weights = self.expand("dof_invweight0").clone()
        if self.coordinates is not None:
            motors = self.coordinates.carried["frictionloss"]
            weights[:, motors.columns] = self.expand("tendon_invweight0")[:, motors.tendons]
        return weights[:, columns]

    def _write_softness(self, solref: str, solimp: str, which: torch.Tensor | slice, time: torch.Tensor) -> None:
        """Write the solver parameters of frictions, (num_envs, …) [s]; hard ones have those of the model."""
        constant, impedance = solver_parameters(*step_of_constraint(time, self.cfg.dt))
        for field, value, width in ((solref, constant, 1), (solimp, impedance, 2)):
            hard = self.tensor(getattr(self.model, field))[which, :width]
            self.expand(field)[:, which, :width] = torch.where((time > 0)[..., None], value[..., None], hard)

    def felt_link(self, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """What joints carry, as it was computed last, (num_envs, len(columns)) each; gravity pulls no slide back.

        Args:
            columns: Their degrees of freedom.

        Returns:
            Inertia without armature [kg m²], how fast gravity pulls back with the angle [N m/rad], and the part of
            the inertia that does not couple to other joints [kg m²].
        """
        if not self._link_fields:  # they hold what is computed after they were bound
            self._link_fields = {name: self.bind(name) for name in ("M", "xaxis", "xanchor", "subtree_com")}
            self.forward()
        fields = self._link_fields
        _, entries, joints, bodies, gravity = self._link_place(columns)
        if self.coordinates is None:
            diagonal = fields["M"][:, entries]
        else:
            diagonal = fields["M"] @ self._motor_inertias[:, columns]
        inertia = (diagonal - self.expand("dof_armature")[:, columns]).clamp(min=0.0)
        if self._as_armature is not None:
            inertia = (inertia - self._as_armature[:, columns]).clamp(min=0.0)
        axis, arm = fields["xaxis"][:, joints], fields["subtree_com"][:, bodies] - fields["xanchor"][:, joints]
        weight = self.expand("body_subtreemass")[:, bodies, None] * gravity
        turned = torch.linalg.cross(torch.linalg.cross(axis, arm), weight)
        turns = torch.as_tensor(self.model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_HINGE)
        pull = -(axis * turned).sum(dim=-1) * turns
        if self.coordinates is not None:
            pull = pull @ self._joints_per_motor[columns][:, columns].square()  # each joint alone
        return inertia, pull, inertia * self._stands_alone[columns]

    @cached_property
    def _joints_per_motor(self) -> torch.Tensor:
        """R⁻¹ of all degrees of freedom, (nv, nv)."""
        every = torch.eye(self.model.nv, dtype=self.dtype, device=self.device)
        return every if self.coordinates is None else self.coordinates.speeds_of_joints(every).T

    @cached_property
    def _motor_inertias(self) -> torch.Tensor:
        """Of each entry of M, what it counts in the inertia at each coordinate, diag(R⁻ᵀ M R⁻¹), (nM, nv)."""
        turn = self._joints_per_motor
        rows, columns = self._entries_of_inertia
        return turn[rows] * turn[columns] * torch.where(rows == columns, 1.0, 2.0)[:, None]

    def _link_place(self, columns: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Where the fields of degrees of freedom are: entries of M, joints, bodies, and gravity; looked up once."""
        if id(columns) not in self._link_places:
            model, ids = self.model, columns.cpu().numpy()
            places = (model.M_rowadr[ids] + model.M_rownnz[ids] - 1, model.dof_jntid[ids], model.dof_bodyid[ids])
            on_device = [torch.as_tensor(place, device=self.device).long() for place in places]
            self._link_places[id(columns)] = (columns, *on_device, self.tensor(model.opt.gravity))
        return self._link_places[id(columns)]

    def note_model_effect(self, effect: Effect, columns: torch.Tensor) -> None:
        """Note that an effect has written to the bodies of joints with these degrees of freedom."""

    def constants_changed(self) -> None:
        """Note that model fields were written: what derives from them is computed before the next step."""
        self._constants_changed = True

    def update_constants(self) -> None:
        """Compute now what derives from model fields that were written."""
        if self._constants_changed:
            self._update_constants()

    @property
    def state(self) -> list[torch.Tensor]:
        """Live tensors of all that :meth:`reset` puts back, (num_envs, ...) each."""
        return [*(self.bind(field) for field in _STATE), self.gained]

    def step(self) -> None:
        """Advance every simulation by one physics step."""
        self.update_constants()
        if self._drift is None:
            with self._in_joints():
                self._step()
        else:
            self._leap(self._drift)

    def _step(self, middle: torch.Tensor | None = None) -> None:
        """MuJoCo's own step, in the frame of a base that moves.

        Args:
            middle: Speeds at which gravity and Coriolis forces act, (num_envs, nv); ``None``: those before the step.
        """
        if middle is None and self._frame is None:
            self.batch.step()
            return
        applied, speed, own = self.qfrc_applied.clone(), self.qvel.clone(), self._own_bias
        if middle is not None:
            self.qvel.copy_(middle)
        self.batch.forward(None, stage=mujoco.mjtStage.mjSTAGE_VEL)
        with torch.inference_mode(False):  # it is written outside of a rollout too
            self._bias = own.clone() if self._frame is None else self._frame.next_bias(self.model)
        self.qvel.copy_(speed)
        self.batch.forward(None, stage=mujoco.mjtStage.mjSTAGE_VEL)
        self.qfrc_applied += own - self._bias
        self.batch.step()
        self.qfrc_applied.copy_(applied)

    def _leap(self, drift: Drift) -> None:
        """A step of second order around MuJoCo's, which moves the positions of its middle with the new speed.

        Half of the damping acts on the speed before the step, half on the speed after it. Soft friction follows the
        acceleration, and MuJoCo's constraints do not know of damping: there the second half stands as armature.
        """
        h, damping = self.cfg.dt, self.expand("dof_damping")
        whole, applied = damping.clone(), self.qfrc_applied.clone()
        damping *= 0.5
        if self.friction_time is None or self._as_armature is None:
            self.qfrc_applied.addcmul_(damping, self.qvel, value=-1)
        else:
            soft, armature = (self.friction_time > 0).any(dim=1, keepdim=True), self.expand("dof_armature")
            rotors = armature.clone()
            armature += torch.mul(damping * soft, h, out=self._as_armature)
            self.qfrc_applied.addcmul_(torch.where(soft, whole, damping), self.qvel, value=-1)
            damping *= ~soft
        drift(self.qpos, self.qvel, 0.5 * h)
        with self._in_joints():
            outcomes = self._outcomes if self.turns_friction else None  # bound before the step that computes them
            before = self.qvel.clone()
            self._step(before + 0.5 * self.gained)
            if outcomes is not None:
                self._turn_friction(before, outcomes, drift)
            torch.sub(self.qvel, before, out=self.gained)
        drift(self.qpos, self.qvel, -0.5 * h)
        damping.copy_(whole)
        if self._as_armature is not None:
            armature.copy_(rotors)
        self.qfrc_applied.copy_(applied)

    def _turn_friction(self, before: torch.Tensor, outcomes: Mapping[str, torch.Tensor], drift: Drift) -> None:
        """Let friction turn where the speed passed zero in MuJoCo's step.

        Args:
            before: Speeds before the step, (num_envs, nv).
            outcomes: What the step computed.
        """
        most, weight = self.expand("dof_frictionloss"), self.expand("dof_invweight0")
        force, free, constraints = (outcomes[name] for name in _FRICTION)
        soft = self.friction_time
        hard = most if soft is None else torch.where(soft > 0, 0.0, most)
        impulse = impulses(before, self.qvel, force, hard, weight, self.cfg.dt)
        alone = (free == (most > 0.0).sum(dim=1)) & (constraints == free)
        change = self._change_of_speeds(torch.where(alone[:, None], impulse, 0.0), before, force, most)
        self.qvel += change
        drift(self.qpos, change, self.cfg.dt)

    def _change_of_speeds(
        self, impulse: torch.Tensor, before: torch.Tensor, force: torch.Tensor, most: torch.Tensor
    ) -> torch.Tensor:
        """How the speeds change where frictions turn, by M⁻¹ of the step's middle, (num_envs, nv).

        Args:
            impulse: By what each friction alone differs, (num_envs, nv); zero where none turns.
            before: Speeds before the step.
        """
        hit, change = impulse.any(dim=1).nonzero()[:, 0], torch.zeros_like(impulse)
        if not len(hit):
            return change
        entries = torch.nn.functional.pad(self._outcomes["M"][hit], (0, 1))
        inertia, impulse = entries[:, self._place_in_inertia], impulse[hit]
        change[hit] = torch.linalg.solve(inertia, impulse)
        turns = (impulse.abs() > TURNS * self.cfg.dt * most[hit]).any(dim=1)
        if bool(turns.any()):
            those, inverse = hit[turns], torch.linalg.inv(inertia[turns])
            after, soft = self.qvel[those], None
            if (time := self.friction_time) is not None:
                rate, softness = step_of_constraint(time[those], self.cfg.dt)
                soft = rate, torch.where(time[those] > 0, softness * self.expand("dof_invweight0")[those], 0.0)
            new = settled(before[those], after, force[those], most[those], inverse, self.cfg.dt, soft)
            change[those] = new - after
        return change

    @cached_property
    def _outcomes(self) -> dict[str, torch.Tensor]:
        """What a step computes; bound before it."""
        return {field: self.bind(field) for field in ("M", *_FRICTION)}

    @cached_property
    def _place_in_inertia(self) -> torch.Tensor:
        """Where each entry of the inertia matrix is among MuJoCo's, (nv, nv); behind them where it is zero."""
        (rows, columns), model = self._entries_of_inertia, self.model
        place = torch.full((model.nv, model.nv), model.nM)
        place[rows, columns] = place[columns, rows] = torch.arange(model.nM)
        return place

    @cached_property
    def _entries_of_inertia(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows and columns of the entries that MuJoCo keeps of the inertia matrix, (nM,) each."""
        rows = np.repeat(np.arange(self.model.nv), self.model.M_rownnz)
        return torch.as_tensor(rows).long(), torch.as_tensor(self.model.M_colind).long()

    def forward(self, env_ids: EnvIds = None) -> None:
        """Compute everything that follows from the state, without advancing time."""
        self.update_constants()
        if self._as_armature is not None:
            self._as_armature[self.rows(env_ids)] = 0.0
        with self._in_joints():
            self.batch.forward(None if env_ids is None else self.resolve_env_ids(env_ids))
        if self._bias is not None and self._frame is None:
            rows = self.rows(env_ids)
            self._bias[rows] = self._own_bias[rows]

    def reset(self, env_ids: EnvIds = None) -> None:
        """Put the state of all or some simulations back to the model's (positions, speeds, forces, time)."""
        ids = None if env_ids is None else self.resolve_env_ids(env_ids)
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.gained[self.rows(env_ids)] = 0.0

    def tensor(self, value: object) -> torch.Tensor:
        """A value as a tensor where, and of the type that, the simulation's are."""
        return torch.as_tensor(value, dtype=self.dtype, device=self.device)

    def model_of(self, env_id: int) -> mujoco.MjModel:
        """A copy of the model as one environment has it."""
        return self.batch.get_model(env_id)

    def read_data(self, env_id: int, data: mujoco.MjData) -> None:
        """Read the state of one environment, such as to draw it."""
        self.batch.get_data(env_id, data)

    def rows(self, env_ids: EnvIds) -> torch.Tensor | slice:
        """What selects environments in tensors: all of them, or indices, sorted and unique."""
        return slice(None) if env_ids is None else torch.as_tensor(self.resolve_env_ids(env_ids)).long()

    def resolve_env_ids(self, env_ids: EnvIds) -> np.ndarray:
        """Environment indices, sorted and unique, as an int32 array, of indices or a mask of any kind.

        Raises:
            ValueError: If an index is out of range or a mask has the wrong length.
        """
        if env_ids is None:
            return np.arange(self.num_envs, dtype=np.int32)
        if isinstance(env_ids, slice):
            return np.sort(np.arange(self.num_envs, dtype=np.int32)[env_ids])
        ids = np.asarray(env_ids.cpu() if isinstance(env_ids, torch.Tensor) else env_ids)
        if ids.dtype == bool:
            if ids.shape != (self.num_envs,):
                raise ValueError(f"The mask env_ids has shape {ids.shape}, expected ({self.num_envs},).")
            return np.flatnonzero(ids).astype(np.int32)
        ids = np.unique(ids)
        if ids.size and (ids[0] < 0 or ids[-1] >= self.num_envs):
            raise ValueError(f"env_ids holds {ids[0]} to {ids[-1]}, expected 0 to {self.num_envs - 1}.")
        return ids.astype(np.int32)

    @cached_property
    def _stands_alone(self) -> torch.Tensor:
        """Which degrees of freedom follow no other, and are followed by none, (nv,) bool."""
        parents = self.model.dof_parentid
        return torch.as_tensor((parents < 0) & ~np.isin(np.arange(len(parents)), parents), device=self.device)

    def close(self) -> None:
        """Release the simulations."""
        self.batch = None

    def _update_constants(self) -> None:
        with self._in_joints():
            self.batch.set_const()
        self._constants_changed = False

    def _find_device(self) -> torch.device:
        """Where the tensors are to be; raises a ValueError where that cannot be."""
        return torch.device("cpu")

    def _start(self) -> None:
        """Make the copies of the model and their data."""
        check_memory(
            self.num_envs * bytes_per_env(self.model),
            f"num_envs = {self.num_envs}: that many simulations of this model",
            "Take fewer environments.",
        )
        keep_quiet()
        threads = self.cfg.num_threads or available_processors()
        self.batch = batch.Batch(self.model, self.num_envs, nthread=threads)

    def _compile(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        # the drive is pace_actuators' business, and keyframes have the size of the model as it was
        sensors = [s for s in spec.sensors if s.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR]
        for element in [*sensors, *spec.actuators, *spec.keys]:
            spec.delete(element)
        spec.option.timestep = self.cfg.dt
        spec.option.integrator = _INTEGRATORS[self.cfg.integrator]
        spec.option.gravity = self.cfg.gravity
        # a simulation that diverges must show it instead of starting again at rest
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        if not self.cfg.contacts:
            spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        if not self.cfg.sensors:
            spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
            leave_out_pictures(spec)
        for body in spec.bodies[1:]:
            body.simple = 0  # effects on the model move centres of mass; MuJoCo's short cut for balanced bodies cannot
        timeconst, impedance = self.cfg.friction_timeconst, self.cfg.friction_impedance
        for element in [*spec.joints, *spec.tendons]:
            element.solref_friction = [2 * self.cfg.dt if timeconst is None else timeconst, 1.0]
            element.solimp_friction = [impedance, impedance, 0.001, 0.5, 2.0]
        try:
            return spec.compile()
        except ValueError as error:
            raise ValueError(f"MuJoCo cannot compile the model: {error}") from None


@dataclass(kw_only=True)
class _Frame:
    """How the base moves in the physics steps to come."""

    motion: torch.Tensor
    """(steps, num_envs, 9)."""
    point: np.ndarray
    """(num_envs, 3) [m]."""
    fields: Sequence[np.ndarray]
    """Of :data:`FIELDS`, live."""
    step: int = 0
    """Of ``motion``, the one that comes next."""

    def next_bias(self, model: mujoco.MjModel) -> torch.Tensor:
        """Of the step that comes next, at the present state."""
        motion = self.motion[min(self.step, len(self.motion) - 1)].numpy()
        self.step += 1
        state = FrameState(**dict(zip(FIELDS, self.fields, strict=True)))
        return torch.from_numpy(bias_in_frame(model, state, motion, self.point))


class Drift:
    """Moves positions with the speeds alone, as MuJoCo's ``mj_integratePos``."""

    def __init__(self, model: mujoco.MjModel, device: torch.device):
        """Look up where positions and speeds are."""
        kinds = {name: model.jnt_type == getattr(mujoco.mjtJoint, f"mjJNT_{name}") for name in ("FREE", "BALL")}
        single = ~(kinds["FREE"] | kinds["BALL"])
        positions, speeds = model.jnt_qposadr, model.jnt_dofadr
        lines = [(positions[single], speeds[single])]
        lines += [(positions[kinds["FREE"]] + i, speeds[kinds["FREE"]] + i) for i in range(3)]
        turns = [(positions[kinds["FREE"]] + 3, speeds[kinds["FREE"]] + 3)]
        turns += [(positions[kinds["BALL"]], speeds[kinds["BALL"]])]
        self._all = model.nq == model.nv
        self._lines = [torch.as_tensor(np.concatenate(each), device=device).long() for each in zip(*lines, strict=True)]
        starts = zip(*(np.concatenate(each).tolist() for each in zip(*turns, strict=True)), strict=True)
        self._turns = [(slice(q, q + 4), slice(v, v + 3)) for q, v in starts]

    def __call__(self, qpos: torch.Tensor, qvel: torch.Tensor, time: float) -> None:
        """Move.

        Args:
            qpos: (num_envs, nq); it is changed.
            qvel: (num_envs, nv).
            time: For how long [s].
        """
        if self._all:
            qpos.add_(qvel, alpha=time)
            return
        q, v = self._lines
        qpos[:, q] += time * qvel[:, v]
        for place, speed in self._turns:
            qpos[:, place] = multiply(qpos[:, place], from_rotation_vector(time * qvel[:, speed]))


def bytes_per_env(model: mujoco.MjModel) -> int:
    """Memory that one more environment takes, with its drive and terms [bytes]; measured on the robots here."""
    return 4000 + 400 * model.nv
