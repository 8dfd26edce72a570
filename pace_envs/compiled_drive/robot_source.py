"""The programs of a robot's drives, written as C around MuJoCo's step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch

from pace_envs.compiled_drive.robot import STATE, WRITTEN, DriveProgram
from pace_envs.compiled_drive.source import Names, changing_nodes, needed_nodes
from pace_envs.compiled_drive.tape import Node, NotTraceableError
from pace_envs.coulomb import SOURCE as TURN_FRICTION
from pace_envs.kernels.expressions import PRELUDE
from pace_envs.motor_coordinates import MotorCoordinates
from pace_envs.moving_frame import COLUMNS, SOURCE

ARGUMENTS = {
    "step": "void (*step)(const mjModel*, mjData*)",
    "step1": "void (*step1)(const mjModel*, mjData*)",
    "step2": "void (*step2)(const mjModel*, mjData*)",
    "drift": "Drift drift",
    "solve": "Solve solve",
    "robots": "long long robots",
    "recordings": "long long recordings",
    "first": "long long first",
    "last": "long long last",
    "end": "long long end",
    "commands": "long long commands",
    "slot": "const long long* slot",
    "series": "const double* series",
    "memory": "double* memory",
    "bias": "double* bias",
    "before": "double* before",
    "out": "double* out",
    "effort": "double* effort",
    "state": "double* state",
    "motion": "const double* motion",
    "point": "const double* point",
    "push": "const double* push",
    "room": "double* room",
    "held": "const double* held",
    "shift": "const double* shift",
}
"""What ``simulate`` gets, eight bytes each: MuJoCo's step and its halves, its ``mj_integratePos`` where steps are
those of ``Simulation._leap``, else 0, and its ``mj_solveM`` where friction turns, else 0; environments and recordings;
the control steps from ``first`` to before ``last`` that it takes, and the one at which joints are only shown; how many
steps commands last; to which row of ``out`` each step is shown (-1: none); series (names, steps, recordings, joints);
the drives' memory and the forces of gravity and motion of each environment; room for what was before a step, and for
its friction (environments, 5, nv); what is shown (rows, environments, joints), where they are recorded the motors'
torques there (the same), and unless it is 0 MuJoCo's positions and speeds there (rows, environments, nq + nv). Unless
it is 0, the motion of a base that moves (commands, physics steps of a control step, recordings, 9), where its specific
force was measured (recordings, 3), what is added to that (environments, 3), and room to compute with (environments, 12
nbody); unless it is 0, positions and speeds at which joints are held (commands, recordings, joints, 2; NaN: free), and
what is added to them (environments, joints, 2). Then the leaves of each drive, each with the memory of its delays
behind it."""

_WHERE = {name: "d" for name in (*STATE, "qfrc_applied")} | {name: "m" for name in WRITTEN if name.startswith("dof")}
_BEGIN = "#include <mujoco/mujoco.h>\n#include <math.h>\n#include <string.h>\n" + PRELUDE


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
    programs: Sequence[DriveProgram],
    qpos: torch.Tensor,
    dof: torch.Tensor,
    num_joints: int,
    version: str,
    coordinates: MotorCoordinates | None = None,
) -> RobotSource:
    """C of all drives of a robot.

    Args:
        programs: Of its drives.
        qpos: Where each joint's position is in MuJoCo's arrays, (n,).
        dof: Where its speed is, (n,).
        num_joints: Of a recording.
        version: MuJoCo's, whose structures are used.
        coordinates: Of motors that move several joints; ``None``: there are none.
    """
    turns = "" if coordinates is None else coordinates.c_source()
    there, back = ("to_joints(m, d);", "to_motors(m, d);") if turns else ("", "")
    series = tuple(dict.fromkeys(name for program in programs for name in program.tape.series))
    drives, memory = [], 0
    for i, program in enumerate(programs):
        drives.append(_Drive(f"d{i}", program, series, memory, num_joints, qpos, dof))
        memory += drives[-1].memory
    parts, names = len(programs[0].written), [drive.name for drive in drives]
    loop = []
    for part in range(parts):
        loop += ["hold(d, robot, k, a);", "keep(m, d, robot, k, a);"] if part == 0 else []
        loop += [f"{name}_{part}(x, robot, m, d, k, a);" for name in names]
        loop += ["if (k == a->end) break;"] if part == 0 else []
        loop += [f"advance(m, d, robot, k, {part}, a);"] if part + 1 < parts else []
    functions = "\n".join(drive.functions(parts) for drive in drives)
    begin = "\n    ".join(f"{name}_begin(x, robot, a, a->leaves[{i}]);" for i, name in enumerate(names))
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
static const int Q[{num_joints}] = {{{", ".join(map(str, qpos.tolist()))}}};
static const int V[{num_joints}] = {{{", ".join(map(str, dof.tolist()))}}};
static long long row(long long robot, long long k, long long parts, long long part, const Arguments* a) {{
  return ((k < a->commands ? k : a->commands - 1) * parts + part) * a->recordings + robot % a->recordings;
}}
static void hold(mjData* d, long long robot, long long k, const Arguments* a) {{
  if (!a->held) return;
  const double* held = a->held + row(robot, k, 1, 0, a) * {2 * num_joints};
  const double* shift = a->shift + robot * {2 * num_joints};
  for (int j = 0; j < {num_joints}; ++j, held += 2, shift += 2) {{
    if (held[0] != held[0]) continue;
    d->qpos[Q[j]] = held[0] + shift[0];
    d->qvel[V[j]] = held[1] + shift[1];
  }}
}}
{SOURCE}
{turns}
static void step(mjModel* m, mjData* d, long long robot, long long k, int part, const Arguments* a) {{
  {there}
  double* before = a->before + (5 * robot + 2) * m->nv;
  memcpy(before, d->qvel, m->nv * sizeof(double));
  if (!a->motion) {{
    a->step(m, d);
    if (a->solve) turn_friction(m, d, before, before + m->nv, a->solve, a->drift);
    {back}
    return;
  }}
  double motion[{COLUMNS}];
  memcpy(motion, a->motion + row(robot, k, {parts - 1}, part, a) * {COLUMNS}, sizeof motion);
  for (int i = 0; i < 6; ++i) motion[{COLUMNS - 6} + i] += a->push[robot * 6 + i];
  a->step1(m, d);
  bias_in_frame(m, d, motion, a->point + robot % a->recordings * 3, a->room + robot * 12 * m->nbody);
  a->step2(m, d);
  if (a->solve) turn_friction(m, d, before, before + m->nv, a->solve, a->drift);
  {back}
}}
static void advance(mjModel* m, mjData* d, long long robot, long long k, int part, const Arguments* a) {{
  if (!a->drift) {{
    step(m, d, robot, k, part, a);
    return;
  }}
  const int n = m->nv;
  const double h = m->opt.timestep;
  double *applied = a->before + 5 * robot * n, *damping = applied + n;
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
    return RobotSource(source=text, memory=memory, series=series, leaves=tuple(tuple(d.used) for d in drives))


class _Drive:
    """Writes one drive's functions."""

    def __init__(
        self,
        name: str,
        program: DriveProgram,
        series: Sequence[str],
        memory: int,
        num_joints: int,
        qpos: torch.Tensor,
        dof: torch.Tensor,
    ):
        """Lay out its memory.

        Args:
            name: Of its functions.
            program: What it does.
            series: All that there are.
            memory: Where its own begins.
            num_joints: Of a recording.
            qpos: Where each joint's position is, (n,).
            dof: Where its speed is, (n,).
        """
        self.name, self._program, self._series, self._num_joints = name, program, series, num_joints
        tape = program.tape
        self._shown = {"out": program.shown} | ({} if program.torque is None else {"effort": program.torque})
        roots = [*self._shown.values(), *(node for node in tape.nodes if node.operation in ("push", "physics"))]
        self._updates, needed = needed_nodes(tape, program.updates, roots)
        changing = changing_nodes(tape, self._updates)
        self._nodes = [node for node in tape.nodes if node.number in needed]
        self.used = list(dict.fromkeys(node.index for node in self._nodes if node.operation in ("leaf", "table")))
        counts = accumulate((program.entries[i] for i in self.used), initial=0)
        self._begin = dict(zip(self.used, counts, strict=False))
        self._names = Names(tape, self._nodes, self._begin)
        self._part = self._parts_of(changing)
        self._kept = {node.number: i for i, node in enumerate(self._to_keep())}
        joints = len(program.columns)
        lengths = [ring.length for ring in tape.rings]
        self._ring = [memory + joints * (len(self._kept) + r) for r in accumulate(lengths, initial=0)]
        self._head, self._memory = self._ring[-1], memory
        self.memory = joints * (len(self._kept) + sum(lengths)) + len(lengths)
        columns = program.columns
        places = {"Q": qpos[columns], "V": dof[columns], "C": columns}
        self._tables = "\n".join(
            f"static const int {name}_{key}[{joints}] = {{{', '.join(map(str, values.tolist()))}}};"
            for key, values in places.items()
        )
        self._loop = f"for (int j = 0; j < {joints}; ++j)"
        self._count = f"(a->robots * {joints})"
        self._joint = f"robot * {joints} + j"

    def functions(self, parts: int) -> str:
        """Its beginning, and each part of a control step that ends with a step of MuJoCo or the next control step."""
        knots = [
            f"static const double {self.name}_k{i}[{len(values)}] = {{{', '.join(map(repr, values))}}};"
            for i, values in enumerate(self._program.tape.knots)
        ]
        return "\n".join([self._tables, *knots, self._start(), *(self._function(part) for part in range(parts))])

    def _parts_of(self, changing: set[int]) -> dict[int, int]:
        """In which part of a control step each node is computed; -1: once, at the beginning."""
        result, part = {}, 0
        for node in self._program.tape.nodes:
            result[node.number] = part if node.number in changing or node.operation in ("push", "physics") else -1
            part += node.operation == "physics"
        return result

    def _uses(self) -> list[tuple[Node, int]]:
        """Nodes, and in which part each is used."""
        last = max(self._part.values())
        uses = [(each, self._part[node.number]) for node in self._nodes for each in node.arguments]
        leaf = {node.index: node for node in self._nodes if node.operation == "leaf"}
        uses += [(node, last) for node in self._updates.values()]
        uses += [(leaf[i], last) for i in self._updates]
        return [*uses, *((node, 0) for node in self._shown.values())]

    def _to_keep(self) -> list[Node]:
        """Nodes that are used in another part than their own."""
        kept = {node.number: node for node, part in self._uses() if self._part[node.number] != part}
        updated = {n.number: n for n in self._nodes if n.operation == "leaf" and n.index in self._updates}
        return [node for node in {**updated, **kept}.values() if node.operation != "constant"]

    def _memory_of(self, node: Node) -> str:
        joints = len(self._program.columns)
        return f"x[{self._memory + self._kept[node.number] * joints} + j]"

    def _start(self) -> str:
        lines = []
        for node in self._nodes:
            if node.operation == "leaf":
                text = f"leaves[{self._begin[node.index]} * {self._count} + {self._joint}]"
                lines.append(f"const {node.kind} {self._names.of(node)} = {_as(node, text)};")
            elif self._part[node.number] == -1 and node.operation != "constant":
                lines.append(f"const {node.kind} {self._names.of(node)} = {self._expression(node)};")
            if node.number in self._kept and (node.operation == "leaf" or self._part[node.number] == -1):
                lines.append(f"{self._memory_of(node)} = {self._names.of(node)};")
        first, joints = sum(self._program.entries[i] for i in self.used), len(self._program.columns)
        for r, ring in enumerate(self._program.tape.rings):
            lines.append(
                f"for (int i = 0; i < {ring.length}; ++i) x[{self._ring[r]} + i * {joints} + j] = "
                f"leaves[({first} + i) * {self._count} + {self._joint}];"
            )
            first += ring.length
        heads = "".join(f"x[{self._head + r}] = 0.0; " for r in range(len(self._program.tape.rings)))
        return self._as_function("begin", "const Arguments* a, const double* leaves", "", lines, heads)

    def _function(self, part: int) -> str:
        program, names = self._program, self._names
        own = [node for node in self._nodes if self._part[node.number] == part]
        wanted = {node.number: node for node, where in self._uses() if where == part}
        lines = [
            f"const {node.kind} {names.of(node)} = {_as(node, self._memory_of(node))};"
            for node in wanted.values()
            if node.number in self._kept and (self._part[node.number] != part or node.operation == "leaf")
        ]
        rings = sorted({node.index for node in own if node.operation in ("push", "ring")})
        lines += [f"int h{r} = g{r};" for r in rings]
        for node in own:
            if node.operation == "push":
                r, length = node.index, program.tape.rings[node.index].length
                at = f"x[{self._ring[r]} + h{r} * {len(program.columns)} + j]"
                lines.append(f"h{r} = h{r} + 1 == {length} ? 0 : h{r} + 1; {at} = {names.of(node.arguments[0])};")
            elif node.operation == "physics":
                for name, value in program.written[node.index].items():
                    lines.append(f"{_WHERE[name]}->{name}[{self.name}_V[j]] = {names.of(value)};")
            elif node.operation != "leaf":
                lines.append(f"const {node.kind} {names.of(node)} = {self._expression(node)};")
                if node.number in self._kept:
                    lines.append(f"{self._memory_of(node)} = {names.of(node)};")
        if part == 0:
            shown = f"(a->slot[k] * a->robots + robot) * {self._num_joints} + {self.name}_C[j]"
            lines += [f"if (a->slot[k] >= 0) a->{to}[{shown}] = {names.of(node)};" for to, node in self._shown.items()]
        if part + 1 == len(program.written):
            leaf = {node.index: node for node in self._nodes if node.operation == "leaf"}
            lines += [f"const {node.kind} n{self._begin[i]} = {names.of(node)};" for i, node in self._updates.items()]
            lines += [f"{self._memory_of(leaf[i])} = n{self._begin[i]};" for i in self._updates]
        lines += [f"f{r} = h{r};" for r in rings]
        at = "(k < a->commands ? k : a->commands - 1) * a->recordings + robot % a->recordings"
        before = f"const double* s = a->series + ({at}) * {self._num_joints};\n"
        before += "".join(f"  const int g{r} = (int)x[{self._head + r}]; int f{r} = g{r};\n" for r in rings)
        after = "".join(f"x[{self._head + r}] = f{r}; " for r in rings)
        arguments = "mjModel* m, mjData* d, long long k, const Arguments* a"
        return self._as_function(str(part), arguments, before, lines, after)

    def _as_function(self, name: str, arguments: str, before: str, lines: Sequence[str], after: str) -> str:
        body = "\n    ".join(lines)
        head = f"static void {self.name}_{name}(double* x, long long robot, {arguments})"
        return f"{head} {{\n  {before}  {self._loop} {{\n    {body}\n  }}\n  {after}\n}}"

    def _expression(self, node: Node) -> str:
        program, names = self._program, self._names
        if node.operation == "field":
            name = (*STATE, *WRITTEN)[node.index]
            if name not in STATE:
                raise NotTraceableError(f"MuJoCo's {name}, which is read")
            return f"d->{name}[{self.name}_{'Q' if name == 'qpos' else 'V'}[j]]"
        if node.operation == "series":
            i = self._series.index(program.tape.series[node.index])
            return f"s[{i} * a->commands * a->recordings * {self._num_joints} + {self.name}_C[j]]"
        if node.operation == "ring":
            length, r = program.tape.rings[node.index].length, node.index
            back = f"h{r} - (int){names.of(node.arguments[0])}"
            return f"x[{self._ring[r]} + ({back} < 0 ? {back} + {length} : {back}) * {len(program.columns)} + j]"
        if node.operation == "knot":
            return f"{self.name}_k{node.index}[{names.of(node.arguments[0])}]"
        if node.operation == "table":
            index = f"({self._begin[node.index]} + {names.of(node.arguments[0])})"
            return f"a->leaves[{self.name[1:]}][{index} * {self._count} + {self._joint}]"
        return names.expression(node)


def _as(node: Node, text: str) -> str:
    """A number in memory as what it stands for."""
    return {"bool": f"{text} != 0.0", "int": f"(int){text}"}.get(node.kind, text)
