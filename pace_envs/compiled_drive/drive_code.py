"""A drive's program as C: what one control step does to a joint, in parts between which MuJoCo steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch

from pace_envs.compiler.tape import Names, Node, Tape

Read = Callable[[], torch.Tensor]
Special = Callable[[Node], str]


@dataclass(frozen=True, kw_only=True)
class Program:
    """What one control step does to each joint of a drive."""

    tape: Tape
    """Where MuJoCo steps it has a ``"physics"`` node, with the index of a row of ``written``."""
    written: Sequence[Mapping[str, Node]]
    """What is written into MuJoCo's fields before each physics step, and after the last."""
    updates: Mapping[int, Node]
    """What becomes of leaves in a control step, by index."""
    shown: Mapping[str, Node]
    """By the array that gets it: what the encoders show before it (``"out"``); the motors' torques in its first physics
    step [N m] (``"effort"``), if they are wanted."""
    entries: Sequence[int]
    """How many numbers each leaf has."""
    leaves: Sequence[Read]
    """Read the first numbers of each leaf, (entries, rows, joints)."""
    rings: Sequence[Read]
    """Read the memory of each delay, (length, rows, joints), the newest first."""
    columns: torch.Tensor
    """The drive's joints among those of the robot, (joints,)."""


class DriveCode(Names):
    """Writes a program. What is not used changes nothing of it.

    Its lines expect ``e``, the joint, of ``count``; ``leaves``, whose numbers follow each other,
    ``leaves[row * count + e]``; and ``rings``, the memory of its delays, likewise.
    """

    def __init__(self, program: Program, own: str = "", prefix: str = ""):
        """Find what is needed.

        Args:
            own: Before the names of what is kept from part to part; it is declared there, else by :meth:`begin`.
        """
        self._program, self._own, self._prefix = program, own, prefix
        self.tape = tape = program.tape
        roots = [*program.shown.values(), *(node for node in tape.nodes if node.operation in ("push", "physics"))]
        self._updates, needed = _needed_nodes(program.updates, roots)
        super().__init__([node for node in tape.nodes if node.number in needed])
        self.used = list(dict.fromkeys(node.index for node in self.nodes if node.operation in ("leaf", "table")))
        """The leaves that it reads, in order."""
        *begins, self.first_ring = accumulate((program.entries[i] for i in self.used), initial=0)
        self._begin = dict(zip(self.used, begins, strict=True))
        self._leaf = {node.index: node for node in self.nodes if node.operation == "leaf"}
        self._part = self._parts()
        self.last = max(0, len(program.written) - 1)
        """The last part."""
        self.kept = self._to_keep()
        """What is used in another part than its own."""
        self.knots = [
            f"const double {prefix}k{i}[{len(values)}] = {{{', '.join(map(repr, values))}}};"
            for i, values in enumerate(tape.knots)
        ]
        """Numbers that are the same for all joints."""

    def of(self, node: Node) -> str:
        """A variable, or a constant itself."""
        return f"{self._own}{super().of(node)}" if self._own and node in self.kept else super().of(node)

    def expression(self, node: Node) -> str:
        """What it is the result of."""
        index = node.index
        names = [self.of(each) for each in node.arguments]
        if node.operation == "leaf":
            text = f"leaves[{self._begin[index]}LL * count + e]"
            return f"{text} != 0.0" if node.kind == "bool" else text
        if node.operation == "table":
            return f"leaves[({self._begin[index]}LL + {names[0]}) * count + e]"
        if node.operation == "knot":
            return f"{self._prefix}k{index}[{names[0]}]"
        if node.operation == "ring":
            back = f"{self._own}h{index} - (int){names[0]}"
            return f"{self._own}r{index}[{back} < 0 ? {back} + {self.tape.rings[index]} : {back}]"
        return super().expression(node)

    def begin(self) -> list[str]:
        """What is done once: leaves and rings are read, and what does not change is computed."""
        once = [node for node in self.nodes if self._part[node.number] == -1 and node.operation != "constant"]
        lines = [self._made(node) for node in once]
        offset, own = 0, self._own
        for i, length in enumerate(self.tape.rings):
            kept = f"{own}r{i}[i] = rings[({offset}LL + i) * count + e];"
            head = f"{own}h{i} = 0;" if own else f"double r{i}[{length}]; int h{i} = 0;"
            lines.append(f"{head} for (int i = 0; i < {length}; ++i) {kept}")
            offset += length
        return lines

    def part(self, part: int, special: Special, shown: Sequence[str]) -> list[str]:
        """What a part does.

        Args:
            special: Writes what series and MuJoCo's fields are, and what MuJoCo is given.
            shown: Writes what is shown, in the first part.
        """
        lines = []
        for node in self.nodes:
            if self._part[node.number] != part:
                continue
            if node.operation == "push":
                head, ring = f"{self._own}h{node.index}", f"{self._own}r{node.index}"
                turn = f"{head} = {head} + 1 == {self.tape.rings[node.index]} ? 0 : {head} + 1;"
                lines.append(f"{turn} {ring}[{head}] = {self.of(node.arguments[0])};")
            elif node.operation == "physics":
                lines.append(special(node))
            else:
                lines.append(self._made(node, special(node) if node.operation in ("series", "field") else None))
        lines += shown if part == 0 else []
        if part == self.last:
            lines += [f"const {node.kind} n{i} = {self.of(node)};" for i, node in self._updates.items()]
            lines += [f"{self.of(self._leaf[i])} = n{i};" for i in self._updates]
        return lines

    def memory(self) -> list[str]:
        """Declarations of what is kept; none is larger than a double."""
        kept = [f"{node.kind} {super(DriveCode, self).of(node)};" for node in self.kept]
        return [*kept, *(f"double r{i}[{length}]; int h{i};" for i, length in enumerate(self.tape.rings))]

    def size(self) -> int:
        """As many doubles have room for it."""
        return len(self.kept) + sum(length + 1 for length in self.tape.rings)

    def _made(self, node: Node, expression: str | None = None) -> str:
        if self._own and node in self.kept:
            return f"{self.of(node)} = {self.expression(node) if expression is None else expression};"
        line = self.line(node, expression)
        return line.removeprefix("const ") if node.operation == "leaf" else line

    def _parts(self) -> dict[int, int]:
        """In which part of a control step each node is computed; -1: once, at the beginning."""
        changing: set[int] = set()
        result, part = {}, 0
        for node in self.tape.nodes:
            own = node.operation in ("series", "ring", "field", "push", "physics")
            own = own or (node.operation == "leaf" and node.index in self._updates)
            if own or any(each.number in changing for each in node.arguments):
                changing.add(node.number)
            is_first = node.operation in ("leaf", "constant") or node.number not in changing
            result[node.number] = -1 if is_first else part
            part += node.operation == "physics"
        return result

    def _to_keep(self) -> dict[Node, None]:
        uses = [(each, self._part[node.number]) for node in self.nodes for each in node.arguments]
        uses += [(node, self.last) for node in self._updates.values()]
        uses += [(node, 0) for node in self._program.shown.values()]
        kept = {node: None for node, part in uses if self._part[node.number] != part and node.operation != "constant"}
        return dict.fromkeys(self._leaf[i] for i in self._updates) | kept


def _needed_nodes(updates: Mapping[int, Node], roots: Sequence[Node]) -> tuple[dict[int, Node], set[int]]:
    """The leaves that some nodes depend on at any later step, with their updates, and all nodes that this takes."""
    needed: set[int] = set()
    leaves: set[int] = set()
    left = list(roots)
    while left:
        node = left.pop()
        if node.number in needed:
            continue
        needed.add(node.number)
        left += node.arguments
        if node.operation == "leaf" and node.index in updates:
            leaves.add(node.index)
            left.append(updates[node.index])
    return {i: node for i, node in updates.items() if i in leaves}, needed
