"""A whole robot's recordings in a few calls: the drives' programs and MuJoCo's step, compiled into one loop."""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from pace_actuators import PaceDCMotor
from pace_envs.articulation import Articulation
from pace_envs.compiled_drive.drive_code import Program
from pace_envs.compiled_drive.one_joint import HELD, Commands, JointTracer, OneJoint, commands, position_term
from pace_envs.compiled_drive.robot_source import ARGUMENTS, STATE, WRITTEN, RobotSource, robot_source
from pace_envs.compiler.host import CannotCompileError, mujoco_kernels
from pace_envs.compiler.tape import Node, NotTraceableError
from pace_envs.manager_based_env import ManagerBasedEnv
from pace_envs.simulation import Simulation, available_processors

if TYPE_CHECKING:
    from pace_envs.moving_frame import Course

_BLOCK = 40_000
"""Steps of single robots in a call: between two calls an interruption is seen."""


class CompiledRobot:
    """A robot's recordings by compiled drives, where these can be compiled and that pays.

    Parameters have been written, and the first control step has been made. The numbers are those of stepping the
    environment itself, whose own state stays where it is.
    """

    def __init__(self, env: ManagerBasedEnv, dataset: Commands, course: Course | None = None):
        """Nothing is recorded yet; environment c * R + r follows recording r.

        Args:
            course: How bases move and joints are held; ``None``: they rest, and all joints are free.
        """
        self._env, self._dataset, self._course = env, dataset, course
        self._branches: object = None
        self._programs: list[Program] = []
        self._source: RobotSource
        self._series: torch.Tensor
        self._batch: _Batch | None = None
        self._refused = False

    def positions(
        self, at: torch.Tensor, state: torch.Tensor | None = None, torque: torch.Tensor | None = None
    ) -> torch.Tensor | None:
        """What the encoders show, without their bias, (len(at), num_envs, n) [rad]; ``None``: the drives must.

        Args:
            at: Control steps, ascending, all after the first, which has been made.
            state: Gets MuJoCo's positions and speeds at them, (len(at), num_envs, nq + nv) float64.
            torque: Gets the motors' torques at them, (len(at), num_envs, n) float64 [N m].
        """
        kernels = None if self._refused else mujoco_kernels()
        if kernels is None:
            return None
        try:
            self._record(torque is not None)
            source, end = self._source.source, int(at[-1])
            if not kernels.pays(source, end * self._env.cfg.decimation):
                return None
            kernels.compile([source])
            return self._simulated(kernels.address_of(source), at, state, torque)
        except CannotCompileError:
            self._refused = True
            return None

    def _record(self, with_torques: bool) -> None:
        """Record what the drives do, unless that was recorded with the same branches.

        Raises:
            NotTraceableError: If a kernel cannot do it.
        """
        env, robot, sim, course = self._env, self._env.scene["robot"], self._env.sim, self._course
        drives = robot.actuators.values()
        branches = [with_torques, *(actuator.branches() for actuator in drives)]
        if branches == self._branches:
            return
        own = type(robot) is Articulation and type(sim) is Simulation and type(env).simulate is ManagerBasedEnv.simulate
        holds_loops = course is not None and robot.closed_loops is not None
        if not own or holds_loops or sim.cfg.integrator == "implicit":
            raise NotTraceableError("a simulation of the user's own")
        self._branches = branches
        shift = None if course is None else course.shift
        self._programs = [record_drive(env, self._dataset, each, with_torques, shift) for each in drives]
        self._source = robot_source(
            self._programs,
            robot._layout.qpos_columns,
            robot._layout.dof_columns,
            robot.num_joints,
            mujoco.mj_versionString(),
            sim.coordinates,
            sim.carrying,
        )
        series = [self._one(name).double() for name in self._source.series]
        self._series = torch.stack(series).contiguous() if series else torch.zeros(1, dtype=torch.float64)

    def _one(self, name: str) -> torch.Tensor:
        """A series by name, (T, R, n)."""
        if name not in HELD or self._course is None:
            return commands(self._env, self._dataset, name)
        position, speed = self._course.held.unbind(dim=-1)
        return {HELD[0]: position.isnan(), HELD[1]: position.nan_to_num(), HELD[2]: speed.nan_to_num()}[name]

    def _simulated(
        self, function: int, at: torch.Tensor, state: torch.Tensor | None, torque: torch.Tensor | None
    ) -> torch.Tensor:
        """What :meth:`positions` gives, by the function at an address."""
        source, env, end = self._source, self._env, int(at[-1])
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
            "before": torch.zeros(env.num_envs, 7, env.sim.model.nv, dtype=torch.float64),
            "out": torch.empty(len(at), env.num_envs, env.scene["robot"].num_joints, dtype=torch.float64),
        }
        if (course := self._course) is not None:
            tensors |= {name: getattr(course, name) for name in ("motion", "point", "push")}
            tensors["room"] = torch.empty(env.num_envs, 12 * env.sim.model.nbody, dtype=torch.float64)
        tensors["before"][:, 5] = env.sim.gained
        if env.sim.friction_time is not None:
            tensors["soft"] = env.sim.friction_time
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
            self._batch.apply(function, np.array(told, dtype=np.int64))
        return tensors["out"]


def record_drive(
    env: ManagerBasedEnv,
    dataset: Commands,
    actuator: PaceDCMotor,
    with_torques: bool,
    shift: torch.Tensor | None = None,
) -> Program:
    """What a control step does to the joints of a drive, in all environments.

    Args:
        env: The environment; it has made a control step.
        dataset: The recordings whose commands it follows.
        actuator: One of its robot's drives.
        with_torques: Whether the motors' torques are shown, too.
        shift: Added to what encoders are held at, (num_envs, n, 2) [rad, rad/s]; ``None``: none is held.

    Raises:
        NotTraceableError: If a kernel cannot do it.
    """
    robot, stack = env.scene["robot"], actuator.effects
    if type(actuator) is not PaceDCMotor:
        raise NotTraceableError("a drive of the user's own")
    position_term(env)
    every = range(env.num_envs)
    if stack is not None and any(effect.rows.indices(env.num_envs) != (0, len(every), 1) for effect in stack.effects):
        raise NotTraceableError("effects of some environments only")
    joint = OneJoint(robot, actuator, every)
    with joint.noting():
        sim = _Physics(joint.tracer, env.sim)
        joint.in_robot(sim, dataset)
        hold = None if shift is None else partial(_hold, joint, sim, shift)
        shown = joint.control_step(env.cfg.decimation, dataset, with_torques, hold)
        sim.end()
        program = joint.program(shown, sim.written)
    return program


def _hold(joint: OneJoint, sim: _Physics, shift: torch.Tensor) -> None:
    columns = joint.columns
    own = [joint.leaf(lambda i=i: shift[None, :, columns, i]) for i in range(2)]  # type: ignore[misc]
    for field, held in zip((sim.qpos, sim.qvel), joint.held(*own), strict=True):
        field.copy_(held)


class _Physics:
    """Stands in for the robot's simulation: a step of it is a mark on the tape."""

    write_passive = Simulation.write_passive

    def __init__(self, tracer: JointTracer, sim: Simulation):
        """Read the state."""
        self.cfg, self.is_trapezoidal = sim.cfg, sim.is_trapezoidal
        self.written: list[dict[str, Node]] = []
        self._tracer = tracer
        self._fields = {name: tracer.tensor(self._read(name)) for name in (*STATE, *WRITTEN)}
        self.qpos, self.qvel, self.qfrc_bias, self.qfrc_applied = (
            self._fields[name] for name in (*STATE, "qfrc_applied")
        )
        self._before = self._nodes()

    def expand(self, field: str) -> torch.Tensor:
        """A field of the model."""
        if field not in self._fields:
            raise NotTraceableError(f"the model's {field}")
        return self._fields[field]

    def felt_link(self, columns: torch.Tensor) -> Any:
        """Needs more of MuJoCo's fields than are read.

        Raises:
            NotTraceableError: Always.
        """
        raise NotTraceableError("an effect that reads the link's inertia")

    def step(self) -> None:
        """Write what has changed, and read the state anew."""
        self.end()
        for name in STATE:
            self._tracer.put(self._fields[name], self._read(name))
        self._before = self._nodes()

    def end(self) -> None:
        """Write what has changed."""
        after = self._nodes()
        self.written.append({name: after[name] for name in WRITTEN if after[name] is not self._before[name]})
        self._tracer.tape.new("physics", *self.written[-1].values(), index=len(self.written) - 1)

    def _nodes(self) -> dict[str, Node]:
        return {name: self._tracer.node(self._fields[name]) for name in WRITTEN}

    def _read(self, name: str) -> Node:
        return self._tracer.tape.new("field", index=(*STATE, *WRITTEN).index(name))


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
        """Apply a function to each environment."""
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
