"""A whole robot's recordings in a few calls: the drives' programs and MuJoCo's step, compiled into one loop."""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from pace_actuators import PaceDCMotor
from pace_envs.articulation import Articulation
from pace_envs.compiled_drive.drive_code import DriveCode, Program
from pace_envs.compiled_drive.one_joint import HELD, Commands, JointTracer, OneJoint, commands, position_term
from pace_envs.compiler.host import CannotCompileError, mujoco_kernels
from pace_envs.compiler.operations import PRELUDE
from pace_envs.compiler.tape import Node, NotTraceableError
from pace_envs.coulomb import SOURCE as TURN_FRICTION
from pace_envs.manager_based_env import ManagerBasedEnv
from pace_envs.motor_coordinates import MotorCoordinates
from pace_envs.moving_frame import COLUMNS, SOURCE
from pace_envs.simulation import Simulation, available_processors

if TYPE_CHECKING:
    from pace_envs.moving_frame import Course


STATE = ("qpos", "qvel", "qfrc_bias")
"""Fields of MuJoCo's data that drives and effects read."""
WRITTEN = ("qpos", "qvel", "qfrc_applied", "dof_armature", "dof_frictionloss", "dof_damping")
"""Fields of MuJoCo's data and model that they write before a physics step."""
ARGUMENTS = {
    # MuJoCo's functions
    "step1": "void (*step1)(const mjModel*, mjData*)",
    "step2": "void (*step2)(const mjModel*, mjData*)",
    "com_vel": "void (*com_vel)(const mjModel*, mjData*)",
    "rne": "void (*rne)(const mjModel*, mjData*, int, mjtNum*)",
    "tendon_bias": "void (*tendon_bias)(const mjModel*, mjData*, mjtNum*)",
    "drift": "Drift drift",  # mj_integratePos where steps are those of Simulation._leap, else 0
    "solve": "Solve solve",  # mj_solveM where friction turns, else 0
    # sizes
    "robots": "long long robots",  # environments
    "recordings": "long long recordings",
    "first": "long long first",  # control step that it takes first
    "last": "long long last",  # control step before which it ends
    "end": "long long end",  # control step at which joints are only shown
    "commands": "long long commands",  # control steps that commands last
    # arrays
    "slot": "const long long* slot",  # to which row of ``out`` each control step is shown (-1: none)
    "series": "const double* series",  # (names, steps, recordings, joints)
    "memory": "double* memory",  # of the drives of each environment
    "bias": "double* bias",  # forces of gravity and motion (environments, nv)
    "before": "double* before",  # room for a step (environments, 6, nv); its last row: what speeds gained
    "out": "double* out",  # what is shown (rows, environments, joints)
    "effort": "double* effort",  # the motors' torques there, where they are recorded
    "state": "double* state",  # MuJoCo's positions and speeds there (rows, environments, nq + nv), or 0
    # a base that moves, or 0
    "motion": "const double* motion",  # (commands, physics steps of a control step, recordings, 9)
    "point": "const double* point",  # where the specific force was measured (recordings, 3)
    "push": "const double* push",  # what is added to it and to the angular acceleration (environments, 6)
    "room": "double* room",  # (environments, 12 nbody)
}
"""What ``simulate`` gets, eight bytes each. Then the leaves of each drive, with the memory of its delays behind it."""

_WHERE = {name: "d" for name in (*STATE, "qfrc_applied")} | {name: "m" for name in WRITTEN if name.startswith("dof")}
_BEGIN = "#include <mujoco/mjdata.h>\n#include <math.h>\n#include <stdlib.h>\n#include <string.h>\n" + PRELUDE


@dataclass(frozen=True, kw_only=True)
class RobotSource:
    """A source, and what it needs."""

    source: str
    """With the function ``simulate``, which MuJoCo's batch applies to each environment."""
    memory: int
    """Numbers that an environment keeps from step to step."""
    series: tuple[str, ...]
    """Names of the series that it reads, in order."""
    leaves: tuple[tuple[int, ...], ...]
    """For each drive, the leaves that it reads, in order."""


def robot_source(
    programs: Sequence[Program],
    qpos: torch.Tensor,
    dof: torch.Tensor,
    num_joints: int,
    version: str,
    coordinates: MotorCoordinates | None = None,
) -> RobotSource:
    """C of all drives of a robot.

    Args:
        qpos: Where each joint's position is in MuJoCo's arrays, (n,).
        dof: Where its speed is, (n,).
        version: MuJoCo's, whose structures are used.
        coordinates: Of motors that move several joints, if any do.
    """
    turns = "" if coordinates is None else coordinates.c_source()
    there, back = ("to_joints(m, d);", "to_motors(m, d);") if turns else ("", "")
    series = tuple(dict.fromkeys(name for program in programs for name in program.tape.series))
    drives = [_Drive(i, program, series, num_joints) for i, program in enumerate(programs)]
    *begins, memory = accumulate((drive.memory for drive in drives), initial=0)
    parts, names = len(programs[0].written), [drive.name for drive in drives]
    loop = []
    for part in range(parts):
        loop += [f"{name}_{part}(x, robot, m, d, k, a);" for name in names]
        loop += ["keep(m, d, robot, k, a);", "if (k == a->end) break;"] if part == 0 else []
        loop += [f"advance(m, d, robot, k, {part}, a);"] if part + 1 < parts else []
    functions = "\n".join(drive.functions(at, qpos, dof) for drive, at in zip(drives, begins, strict=True))
    begin = "\n    ".join(f"{name}_begin(x, robot, m, d, 0, a);" for name in names)
    steps = "\n    ".join(loop)
    arguments = ";\n  ".join(ARGUMENTS.values())
    text = f"""// MuJoCo {version}
{_BEGIN}
{TURN_FRICTION}
typedef struct {{
  {arguments};
  const double* leaves[{len(names)}];
}} Arguments;
static void keep(const mjModel* m, const mjData* d, long long robot, long long k, const Arguments* a) {{
  if (!a->state || a->slot[k] < 0) return;
  double* kept = a->state + (a->slot[k] * a->robots + robot) * (m->nq + m->nv);
  memcpy(kept, d->qpos, m->nq * sizeof(double));
  memcpy(kept + m->nq, d->qvel, m->nv * sizeof(double));
}}
static long long row(long long robot, long long k, long long parts, long long part, const Arguments* a) {{
  return ((k < a->commands ? k : a->commands - 1) * parts + part) * a->recordings + robot % a->recordings;
}}
{SOURCE}
{turns}
static void step(mjModel* m, mjData* d, long long robot, long long k, int part, const Arguments* a) {{
  {there}
  const int n = m->nv, leaps = a->drift != 0;
  double *before = a->before + (6 * robot + 2) * n, *gained = before + 3 * n;
  memcpy(before, d->qvel, n * sizeof(double));
  a->step1(m, d);
  if (leaps) {{
    for (int i = 0; i < n; ++i) d->qvel[i] += 0.5 * gained[i];
    a->com_vel(m, d);
  }}
  if (a->motion) {{
    double motion[{COLUMNS}];
    memcpy(motion, a->motion + row(robot, k, {parts - 1}, part, a) * {COLUMNS}, sizeof motion);
    for (int i = 0; i < 6; ++i) motion[{COLUMNS - 6} + i] += a->push[robot * 6 + i];
    bias_in_frame(m, d, motion, a->point + robot % a->recordings * 3, a->room + robot * 12 * m->nbody);
  }} else if (leaps) {{
    a->rne(m, d, 0, d->qfrc_bias);
    a->tendon_bias(m, d, d->qfrc_bias);
  }}
  memcpy(d->qvel, before, n * sizeof(double));
  a->step2(m, d);
  if (a->solve) turn_friction(m, d, before, before + n, a->solve, a->drift);
  for (int i = 0; i < n; ++i) gained[i] = d->qvel[i] - before[i];
  {back}
}}
static void advance(mjModel* m, mjData* d, long long robot, long long k, int part, const Arguments* a) {{
  if (!a->drift) {{
    step(m, d, robot, k, part, a);
    return;
  }}
  const int n = m->nv;
  const double h = m->opt.timestep;
  double *applied = a->before + 6 * robot * n, *damping = applied + n;
  memcpy(applied, d->qfrc_applied, n * sizeof(double));
  memcpy(damping, m->dof_damping, n * sizeof(double));
  for (int i = 0; i < n; ++i) {{
    m->dof_damping[i] = 0.5 * damping[i];
    d->qfrc_applied[i] -= m->dof_damping[i] * d->qvel[i];
  }}
  a->drift(m, d->qpos, d->qvel, 0.5 * h);
  step(m, d, robot, k, part, a);
  a->drift(m, d->qpos, d->qvel, -0.5 * h);
  memcpy(m->dof_damping, damping, n * sizeof(double));
  memcpy(d->qfrc_applied, applied, n * sizeof(double));
}}
{functions}
extern "C" void simulate(const mjModel* model, mjData* d, int robot, void* arguments) {{
  mjModel* m = (mjModel*)model;
  const Arguments* a = (const Arguments*)arguments;
  double* x = a->memory + robot * {max(1, memory)}LL;
  double* bias = a->bias + (long long)robot * m->nv;
  memcpy(d->qfrc_bias, bias, m->nv * sizeof(double));
  if (a->first == 1) {{
    {begin}
  }}
  for (long long k = a->first; k < a->last; ++k) {{
    {steps}
  }}
  memcpy(bias, d->qfrc_bias, m->nv * sizeof(double));
}}
"""
    return RobotSource(source=text, memory=memory, series=series, leaves=tuple(drive.used for drive in drives))


class _Drive:
    """Writes one drive's functions; what it keeps is one structure for each joint."""

    def __init__(self, number: int, program: Program, series: Sequence[str], num_joints: int):
        """Lay out its memory."""
        self.name = f"d{number}"
        self._number, self._program, self._series, self._num_joints = number, program, series, num_joints
        self._code = DriveCode(program, "own->", f"{self.name}_")
        self.used = tuple(self._code.used)
        """The leaves that it reads, in order."""
        self.memory = len(program.columns) * self._code.size()
        """Numbers that it keeps."""

    def functions(self, begin: int, qpos: torch.Tensor, dof: torch.Tensor) -> str:
        """Its beginning, and each part of a control step that ends with a step of MuJoCo or the next control step.

        Args:
            qpos: Where each joint's position is, (n,).
            dof: Where its speed is, (n,).
        """
        code, columns = self._code, self._program.columns
        places = {"Q": qpos[columns], "V": dof[columns], "C": columns}
        tables = [
            f"static const int {self.name}_{key}[{len(columns)}] = {{{', '.join(map(str, values.tolist()))}}};"
            for key, values in places.items()
        ]
        kept = f"typedef struct {{ {' '.join(code.memory())} }} {self.name}_Own;"
        functions = [self._function(part, begin) for part in range(-1, code.last + 1)]
        return "\n".join([*tables, *(f"static {knots}" for knots in code.knots), kept, *functions])

    def _function(self, part: int, begin: int) -> str:
        code, joints = self._code, len(self._program.columns)
        place = f"(a->slot[k] * a->robots + robot) * {self._num_joints} + {self.name}_C[j]"
        results = self._program.shown.items()
        shown = [f"if (a->slot[k] >= 0) a->{to}[{place}] = {code.of(node)};" for to, node in results]
        body = "\n    ".join(code.begin() if part < 0 else code.part(part, self._special, shown))
        return f"""static void {self.name}_{"begin" if part < 0 else part}(
    double* x, long long robot, mjModel* m, mjData* d, long long k, const Arguments* a) {{
  const long long count = a->robots * {joints};
  const double *leaves = a->leaves[{self._number}], *rings = leaves + {code.first_ring} * count;
  const double* s = a->series + row(robot, k, 1, 0, a) * {self._num_joints};
  for (int j = 0; j < {joints}; ++j) {{
    {self.name}_Own* own = ({self.name}_Own*)(x + {begin}) + j;
    const long long e = robot * {joints} + j;
    {body}
  }}
}}"""

    def _special(self, node: Node) -> str:
        if node.operation == "series":
            i = self._series.index(self._program.tape.series[node.index])
            return f"s[{i} * a->commands * a->recordings * {self._num_joints} + {self.name}_C[j]]"
        if node.operation == "physics":
            written = self._program.written[node.index].items()
            return " ".join(
                f"{_WHERE[name]}->{name}[{self._place(name)}] = {self._code.of(value)};" for name, value in written
            )
        name = (*STATE, *WRITTEN)[node.index]
        if name not in STATE:
            raise NotTraceableError(f"MuJoCo's {name}, which is read")
        return f"d->{name}[{self._place(name)}]"

    def _place(self, field: str) -> str:
        return f"{self.name}_{'Q' if field == 'qpos' else 'V'}[j]"


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
