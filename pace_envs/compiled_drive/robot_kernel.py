"""A whole robot's recordings in a few calls: the drives' programs and MuJoCo's step, compiled into one loop."""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from pace_envs.articulation import Articulation
from pace_envs.compiled_drive.drive_code import Program
from pace_envs.compiled_drive.one_joint import HELD, Commands, commands
from pace_envs.compiled_drive.robot import record_drive
from pace_envs.compiled_drive.robot_source import ARGUMENTS, RobotSource, robot_source
from pace_envs.compiler.host import CannotCompileError, HostKernels, mujoco_kernels
from pace_envs.compiler.tape import NotTraceableError
from pace_envs.manager_based_env import ManagerBasedEnv
from pace_envs.simulation import Simulation, available_processors

if TYPE_CHECKING:
    from pace_envs.moving_frame import Course

_BLOCK = 40_000
"""Steps of single robots in a call: between two calls an interruption is seen."""


class CompiledRobot:
    """A robot's recordings by compiled drives, where these can be compiled and that pays."""

    def __init__(self, env: ManagerBasedEnv, dataset: Commands, course: Course | None = None):
        """Nothing is recorded yet; environment c * R + r follows recording r.

        Args:
            env: The environment.
            dataset: The recordings.
            course: How bases move and joints are held; ``None``: they rest, and all joints are free.
        """
        self._env, self._dataset, self._course = env, dataset, course
        self._kernel: RobotKernel | None = None
        self._refused = False

    def positions(
        self, at: torch.Tensor, state: torch.Tensor | None = None, torque: torch.Tensor | None = None
    ) -> torch.Tensor | None:
        """What the encoders show, without their bias, (len(at), num_envs, n) [rad]; ``None``: the drives must.

        Args:
            at: Control steps, ascending, all after the first, which has been made.
            state: Gets MuJoCo's positions and speeds at them, (len(at), num_envs, nq + nv) float64.
            torque: Gets the motors' torques at them, (len(at), num_envs, n) float64 [N m].

        Raises:
            ValueError: If MuJoCo refuses to step a robot.
        """
        kernels = None if self._refused else mujoco_kernels()
        if kernels is None:
            return None
        try:
            if self._kernel is None:
                self._kernel = RobotKernel(self._env, self._dataset, kernels, self._course)
            self._kernel.record(torque is not None)
            return self._kernel.positions(at, state, torque) if self._kernel.pays(int(at[-1])) else None
        except CannotCompileError:
            self._refused = True
            return None


class RobotKernel:
    """Simulates environments whose parameters have been written and whose first control step has been made.

    The numbers are those of stepping the environment itself. Its own state stays where it is.
    """

    def __init__(self, env: ManagerBasedEnv, dataset: Commands, kernels: HostKernels, course: Course | None = None):
        """Record what the drives do.

        Args:
            env: The environment; environment c * R + r follows recording r.
            dataset: The recordings.
            kernels: Compiles.
            course: How bases move and joints are held.

        Raises:
            NotTraceableError: If a kernel cannot do it.
        """
        robot, sim = env.scene["robot"], env.sim
        own = type(robot) is Articulation and type(sim) is Simulation and type(env).simulate is ManagerBasedEnv.simulate
        holds_loops = course is not None and robot.closed_loops is not None
        if not own or holds_loops or sim.cfg.integrator == "implicit":
            raise NotTraceableError("a simulation of the user's own")
        self._env, self._dataset, self._kernels, self._course = env, dataset, kernels, course
        self._branches: object = None
        self._programs: list[Program] = []
        self._source: RobotSource
        self._series: torch.Tensor
        self._batch: _Batch | None = None
        self.record()

    def pays(self, steps: int) -> bool:
        """Whether it is worth compiling for so many control steps more."""
        return self._kernels.pays(self._source.source, steps * self._env.cfg.decimation)

    def record(self, with_torques: bool = False) -> None:
        """Record what the drives do, unless that was recorded with the same branches.

        Args:
            with_torques: Whether the motors' torques are shown, too.
        """
        robot = self._env.scene["robot"]
        branches = [with_torques, *(actuator.branches() for actuator in robot.actuators.values())]
        if branches == self._branches:
            return
        self._branches = branches
        drives = robot.actuators.values()
        shift = None if self._course is None else self._course.shift
        self._programs = [record_drive(self._env, self._dataset, each, with_torques, shift) for each in drives]
        self._source = robot_source(
            self._programs,
            robot._layout.qpos_columns,
            robot._layout.dof_columns,
            robot.num_joints,
            mujoco.mj_versionString(),
            self._env.sim.coordinates,
        )
        series = [self._one(name).double() for name in self._source.series]
        self._series = torch.stack(series).contiguous() if series else torch.zeros(1, dtype=torch.float64)

    def _one(self, name: str) -> torch.Tensor:
        """A series by name, (T, R, n)."""
        if name not in HELD or self._course is None:
            return commands(self._env, self._dataset, name)
        position, speed = self._course.held.unbind(dim=-1)
        return {HELD[0]: position.isnan(), HELD[1]: position.nan_to_num(), HELD[2]: speed.nan_to_num()}[name]

    def positions(
        self, at: torch.Tensor, state: torch.Tensor | None = None, torque: torch.Tensor | None = None
    ) -> torch.Tensor:
        """What the encoders show, without their bias, at control steps after the first, (len(at), num_envs, n) [rad].

        Args:
            at: Control steps, ascending, all above 0.
            state: Gets MuJoCo's positions and speeds at them, (len(at), num_envs, nq + nv) float64.
            torque: Gets the motors' torques at them, (len(at), num_envs, n) float64 [N m].

        Raises:
            CannotCompileError: If what was recorded cannot be compiled.
            ValueError: If MuJoCo refuses to step a robot.
        """
        source, env, end = self._source, self._env, int(at[-1])
        self._kernels.compile([source.source])
        if self._batch is None:
            self._batch = _Batch(env.sim)
        self._batch.begin(env.sim)
        slot = torch.full((end + 1,), -1, dtype=torch.int64)
        slot[at] = torch.arange(len(at))
        reads_load = any(actuator.needs_load for actuator in env.scene["robot"].actuators.values())
        tensors = {
            "slot": slot,
            "series": self._series,
            "memory": torch.empty(env.num_envs, max(1, source.memory), dtype=torch.float64),
            "bias": env.sim.qfrc_bias.clone() if reads_load else torch.zeros_like(env.sim.qvel),
            "before": torch.zeros(env.num_envs, 6, env.sim.model.nv, dtype=torch.float64),
            "out": torch.empty(len(at), env.num_envs, env.scene["robot"].num_joints, dtype=torch.float64),
        }
        if (course := self._course) is not None:
            tensors |= {name: getattr(course, name) for name in ("motion", "point", "push")}
            tensors["room"] = torch.empty(env.num_envs, 12 * env.sim.model.nbody, dtype=torch.float64)
        tensors["before"][:, 5] = env.sim.gained
        leaves = [_leaves_of(program, used) for program, used in zip(self._programs, source.leaves, strict=True)]
        arguments: dict[str, int] = {
            **dict.fromkeys(ARGUMENTS, 0),
            **{name: self._batch.address_of(function) for name, function in _FUNCTIONS.items()},
            "drift": self._batch.address_of("mj_integratePos") if env.sim.is_trapezoidal else 0,
            "solve": self._batch.address_of("mj_solveM") if env.sim.turns_friction else 0,
            "robots": env.num_envs,
            "recordings": self._dataset.num_recordings,
            "end": end,
            "commands": len(self._dataset.command),
            **{name: tensor.data_ptr() for name, tensor in tensors.items()},
            "state": 0 if state is None else state.data_ptr(),
            "effort": 0 if torque is None else torque.data_ptr(),
        }
        block = max(1, _BLOCK // env.num_envs)
        for first in range(1, end + 1, block):
            arguments |= {"first": first, "last": min(first + block, end + 1)}
            told = [*(arguments[name] for name in ARGUMENTS), *(leaf.data_ptr() for leaf in leaves)]
            self._batch.apply(self._kernels.address_of(source.source), np.array(told, dtype=np.int64))
        return tensors["out"]


def _leaves_of(program: Program, used: Sequence[int]) -> torch.Tensor:
    """The first numbers of a drive: of the leaves that are read, then the memory of its delays."""
    reads = [*(program.leaves[i] for i in used), *program.rings]
    return torch.cat([torch.zeros(0, dtype=torch.float64), *(read().double().reshape(-1) for read in reads)])


class _Batch:
    """MuJoCo's own batch, reached by its address, with the models and states of a simulation."""

    def __init__(self, sim: Simulation):
        """Start its threads."""
        self._library, config, error = _mujoco(), _Config(), ctypes.create_string_buffer(1000)
        self._library.mjb_defaultConfig(ctypes.byref(config))
        config.nthread = sim.cfg.num_threads or available_processors()
        self._batch = ctypes.c_void_p(
            self._library.mjb_makeBatch(
                ctypes.c_void_p(sim.model._address), sim.num_envs, ctypes.byref(config), error, len(error)
            )
        )
        if not self._batch.value:
            raise NotTraceableError(error.value.decode())
        weakref.finalize(self, self._library.mjb_deleteBatch, self._batch)
        self._models: list[mujoco.MjModel] = [sim.model_of(i) for i in range(sim.num_envs)]
        pointers = (ctypes.c_void_p * sim.num_envs)(*(model._address for model in self._models))
        self._library.mjb_setModels(self._batch, pointers)
        size = self._library.mjb_nstate(self._batch)
        address = self._library.mjb_state(self._batch)
        self._state = np.ctypeslib.as_array(ctypes.cast(address, ctypes.POINTER(ctypes.c_double)), (sim.num_envs, size))

    def address_of(self, function: str) -> int:
        """Where a function of MuJoCo is."""
        return ctypes.cast(getattr(self._library, function), ctypes.c_void_p).value or 0

    def begin(self, sim: Simulation) -> None:
        """Take over models and states."""
        for i, model in enumerate(self._models):
            sim.batch.get_model(i, model)
        self._state[:] = sim.batch.state

    def apply(self, function: int, arguments: np.ndarray) -> None:
        """Apply a function to each environment.

        Raises:
            ValueError: If MuJoCo refuses to step one.
        """
        pointer = ctypes.c_void_p(arguments.ctypes.data)
        if self._library.mjb_apply(self._batch, None, 0, ctypes.c_void_p(function), pointer, 1):
            status = self._library.mjb_status(self._batch)
            failed = next(i for i in range(len(self._models)) if ctypes.cast(status, ctypes.POINTER(ctypes.c_int))[i])
            raise ValueError(f"MuJoCo: {ctypes.string_at(self._library.mjb_error(self._batch, failed)).decode()}")


_FUNCTIONS = {
    "step1": "mj_step1",
    "step2": "mj_step2",
    "com_vel": "mj_comVel",
    "rne": "mj_rne",
    "tendon_bias": "mj_tendonBias",
}
"""Of MuJoCo, which every step calls."""


class _Config(ctypes.Structure):
    """MuJoCo's ``mjBatchConfig``."""

    _fields_ = (("nthread", ctypes.c_int), ("persistent", ctypes.c_bool))


@cache
def _mujoco() -> Any:
    """MuJoCo's library, which is loaded already.

    Raises:
        NotTraceableError: If it is not where it is expected, or has no batches.
    """
    try:
        (path,) = Path(mujoco.__file__).parent.glob("libmujoco.*")
        library = ctypes.CDLL(str(path))
        for name in ("mjb_makeBatch", "mjb_state", "mjb_status", "mjb_error"):
            getattr(library, name).restype = ctypes.c_void_p
    except (OSError, AttributeError, ValueError) as error:
        raise NotTraceableError(f"MuJoCo's library: {error}") from error
    return library
