"""The program on a tape, written as C: for a GPU, and for a processor where it is tested."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

from pace_envs.compiled_drive.tape import Node, Tape
from pace_envs.kernels.expressions import PRELUDE

_ARGUMENTS = (
    "int count, int first, int last, int steps, int stride, const int* place, const double* leaves, "
    "const double* rings, const double* series, const int* slot, double* out"
)
_END = """
#ifdef __CUDACC__
extern "C" __global__ void simulate(ARGUMENTS) {
  const int e = blockIdx.x * blockDim.x + threadIdx.x;
  if (e < count) joint(e, NAMES);
}
#else
extern "C" void simulate(ARGUMENTS) {
  for (int e = 0; e < count; ++e) joint(e, NAMES);
}
#endif
""".replace("ARGUMENTS", _ARGUMENTS).replace(
    "NAMES", ", ".join(part.split()[-1].lstrip("*") for part in _ARGUMENTS.split(","))
)


def source_of(tape: Tape, updates: Mapping[int, Node], shown: Node, entries: Sequence[int]) -> tuple[str, list[int]]:
    """The C source of a tape, and which leaves it reads, in order.

    The function ``simulate`` goes through the control steps ``first`` to ``last`` of ``count`` joints. A leaf's numbers
    follow those of the leaves before it, ``leaves[row * count + e]`` of joint e; what is shown at step k is written to
    ``out[slot[k] * count + e]`` unless the slot is negative; series are read at ``place[e]`` of ``stride`` numbers.
    What is not used changes nothing of it.

    Args:
        tape: What one control step does.
        updates: What becomes of leaves in a step, by index.
        shown: What is written to ``out`` at the beginning of each step.
        entries: How many numbers each leaf has.
    """
    updates, needed = needed_nodes(tape, updates, [shown, *(node for node in tape.nodes if node.operation == "push")])
    changing = changing_nodes(tape, updates)
    nodes = [node for node in tape.nodes if node.number in needed]
    used = list(dict.fromkeys(node.index for node in nodes if node.operation in ("leaf", "table")))
    begin = dict(zip(used, itertools.accumulate((entries[i] for i in used), initial=0), strict=False))
    names = Names(tape, nodes, begin)
    before, inside = [], []
    offset = 0
    for i, ring in enumerate(tape.rings):
        before += [
            f"double r{i}[{ring.length}]; int h{i} = 0;",
            f"for (int i = 0; i < {ring.length}; ++i) r{i}[i] = rings[(long long)({offset} + i) * count + e];",
        ]
        offset += ring.length
    for i, values in enumerate(tape.knots):
        before.append(f"const double k{i}[{len(values)}] = {{{', '.join(map(repr, values))}}};")
    before.append("const double* s = series + (long long)first * stride + place[e];")
    size = "(long long)steps * stride"
    before += [f"double s{i} = s[{i} * {size}];" for i in range(len(tape.series))]
    for node in nodes:
        if node.operation == "constant":
            continue
        if node.operation == "leaf":
            at = f"leaves[{begin[node.index]}LL * count + e]"
            text = f"{at} != 0.0" if node.kind == "bool" else at
            word = "" if node.index in updates else "const "
            before.append(f"{word}{node.kind} {names.of(node)} = {text};")
        elif node.operation == "push":
            i, length = node.index, tape.rings[node.index].length
            inside.append(f"h{i} = h{i} + 1 == {length} ? 0 : h{i} + 1; r{i}[h{i}] = {names.of(node.arguments[0])};")
        else:
            where = inside if node.number in changing else before
            where.append(f"const {node.kind} {names.of(node)} = {names.expression(node)};")
    leaf = {node.index: node for node in nodes if node.operation == "leaf"}
    inside = [
        "const long long ahead = k + 1 < last ? stride : 0;",
        *(f"const double t{i} = s[{i} * {size} + ahead];" for i in range(len(tape.series))),
        *inside,
        f"if (slot[k] >= 0) out[(long long)slot[k] * count + e] = {names.of(shown)};",
        *(f"const {node.kind} n{begin[i]} = {names.of(node)};" for i, node in updates.items()),
        *(f"{names.of(leaf[i])} = n{begin[i]};" for i in updates),
        *(f"s{i} = t{i};" for i in range(len(tape.series))),
        "s += ahead;",
    ]
    top, loop = "\n  ".join(before), "\n    ".join(inside)
    return (
        f"{PRELUDE}FUNCTION void joint(int e, {_ARGUMENTS}) {{\n  {top}\n"
        f"  for (int k = first; k < last; ++k) {{\n    {loop}\n  }}\n}}\n{_END}"
    ), used


class Names:
    """What nodes are called in C."""

    def __init__(self, tape: Tape, nodes: Sequence[Node], begin: Mapping[int, int]):
        """Number them."""
        self._tape, self._begin = tape, begin
        self._numbers = {node.number: i for i, node in enumerate(nodes)}

    def of(self, node: Node) -> str:
        """A variable, or a constant itself."""
        if node.operation == "constant":
            return node.text
        return f"v{self._numbers[node.number]}"

    def expression(self, node: Node) -> str:
        """What it is the result of."""
        names = [self.of(each) for each in node.arguments]
        if node.operation == "series":
            return f"s{node.index}"
        if node.operation == "ring":
            length = self._tape.rings[node.index].length
            back = f"h{node.index} - (int){names[0]}"
            return f"r{node.index}[{back} < 0 ? {back} + {length} : {back}]"
        if node.operation == "knot":
            return f"k{node.index}[{names[0]}]"
        if node.operation == "table":
            return f"leaves[(long long)({self._begin[node.index]} + {names[0]}) * count + e]"
        return node.operation.format(*names)


def needed_nodes(tape: Tape, updates: Mapping[int, Node], roots: Sequence[Node]) -> tuple[dict[int, Node], set[int]]:
    """The leaves that some nodes depend on at any later step, with their updates, and all nodes that this takes."""
    needed: set[int] = set()
    leaves: dict[int, Node] = {}
    left = list(roots)
    while left:
        node = left.pop()
        if node.number in needed:
            continue
        needed.add(node.number)
        left += node.arguments
        if node.operation == "leaf" and node.index in updates:
            leaves[node.index] = updates[node.index]
            left.append(updates[node.index])
    return {i: node for i, node in updates.items() if i in leaves}, needed


def changing_nodes(tape: Tape, updates: Mapping[int, Node]) -> set[int]:
    """Numbers of the nodes that change from step to step."""
    changing: set[int] = set()
    for node in tape.nodes:
        own = node.operation in ("series", "ring", "field") or (node.operation == "leaf" and node.index in updates)
        if own or any(each.number in changing for each in node.arguments):
            changing.add(node.number)
    return changing
