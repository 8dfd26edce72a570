"""The programs of a robot's drives, written as C around MuJoCo's step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch

from pace_envs.compiled_drive.drive_code import DriveCode, Program
from pace_envs.compiler.operations import PRELUDE
from pace_envs.compiler.tape import Node, NotTraceableError
from pace_envs.coulomb import SOURCE as TURN_FRICTION
from pace_envs.motor_coordinates import MotorCoordinates
from pace_envs.moving_frame import COLUMNS, SOURCE

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
    "soft": "const double* soft",  # time constants of soft frictions (environments, nv), or 0
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
    "before": "double* before",  # room for a step (environments, 7, nv); row 5: what speeds gained
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
    coordinates: MotorCoordinates | None,
    carrying: torch.Tensor | None,
) -> RobotSource:
    """C of all drives of a robot.

    Args:
        qpos: Where each joint's position is in MuJoCo's arrays, (n,).
        dof: Where its speed is, (n,).
        version: MuJoCo's, whose structures are used.
        coordinates: Of motors that move several joints, if any do.
        carrying: What driven joints carry of joints that follow them, (nv, nv), if any do.
    """
    turns = "" if coordinates is None else coordinates.c_source()
    there, back = ("to_joints(m, d);", "to_motors(m, d);") if turns else ("", "")
    if carrying is not None:
        shares = carrying - torch.eye(len(carrying), dtype=carrying.dtype)
        places = [(i, j, float(shares[i, j])) for i, j in shares.nonzero().tolist()]
        back = " ".join(f"d->qfrc_bias[{i}] += {share!r} * d->qfrc_bias[{j}];" for i, j, share in places) + back
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
  double *before = a->before + (7 * robot + 2) * n, *gained = before + 3 * n;
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
  if (a->solve) turn_friction(m, d, before, before + n, a->soft ? a->soft + robot * n : 0, a->solve, a->drift);
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
  double *applied = a->before + 7 * robot * n, *damping = applied + n, *armature = applied + 6 * n;
  memcpy(applied, d->qfrc_applied, n * sizeof(double));
  memcpy(damping, m->dof_damping, n * sizeof(double));
  memcpy(armature, m->dof_armature, n * sizeof(double));
  int soft = 0;
  for (int i = 0; a->soft && i < n; ++i) soft |= a->soft[robot * n + i] > 0.0;
  for (int i = 0; i < n; ++i) {{
    m->dof_damping[i] = soft ? 0.0 : 0.5 * damping[i];
    m->dof_armature[i] += soft ? 0.5 * h * damping[i] : 0.0;
    d->qfrc_applied[i] -= (soft ? damping[i] : m->dof_damping[i]) * d->qvel[i];
  }}
  a->drift(m, d->qpos, d->qvel, 0.5 * h);
  step(m, d, robot, k, part, a);
  a->drift(m, d->qpos, d->qvel, -0.5 * h);
  memcpy(m->dof_damping, damping, n * sizeof(double));
  memcpy(m->dof_armature, armature, n * sizeof(double));
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
