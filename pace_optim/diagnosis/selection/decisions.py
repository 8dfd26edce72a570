"""What is decided on the way to a diagnosis, in numbers that the decision can be made from again."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from pace_optim.joints.fits.block_errors import BlockErrors

FILE = "decisions.jsonl"

Taken = list[str | None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Decision:
    """One decision about some joints; errors are of validation, and of these joints alone."""

    rule: str
    """Which move or rule decides: ``add``, or one of ``diagnosis_cfg.RULES``."""
    joints: list[int]
    """About which joints, by index."""
    before: BlockErrors
    """With the present model."""
    after: Mapping[str, BlockErrors]
    """With each that was tried; not a number on joints that it was not tried on."""
    facts: dict[str, Any] = field(default_factory=dict)
    """What else the rule needs."""
    taken: Taken = field(default_factory=list)
    """What each joint took."""

    @classmethod
    def of(
        cls,
        rule: str,
        joints: Sequence[int],
        before: BlockErrors,
        after: Mapping[str, BlockErrors],
        on: Mapping[str, Sequence[int]] | None = None,
        **facts: Any,
    ) -> Decision:
        """A decision to be made.

        Args:
            rule: Which rule decides.
            joints: About which joints, by index.
            before: The present model's errors, of all joints.
            after: Errors of all joints with each that was tried, or without.
            on: On which joints each was tried; all of them if not given.
            facts: What else the rule needs.
        """
        here = torch.tensor(joints, dtype=torch.long)
        tried = {name: own.on_joints(here) for name, own in after.items()}
        for name, own in tried.items():
            away = [place for place, j in enumerate(joints) if on is not None and j not in on[name]]
            own.square[:, away] = math.nan
        return cls(rule=rule, joints=list(joints), before=before.on_joints(here), after=tried, facts=facts)

    def places(self, name: str) -> list[int]:
        """Which of the joints something was tried on."""
        return (~self.after[name].square[0].isnan()).nonzero()[:, 0].tolist()

    @property
    def taken_by(self) -> dict[int, str]:
        """What joints took, by index, where they took something."""
        return {j: name for j, name in zip(self.joints, self.taken, strict=True) if name is not None}


Log = Callable[[Decision], None]


def unlogged(_: Decision) -> None:
    """Keeps nothing."""


def as_lines(decisions: Iterable[Decision]) -> bytes:
    """Decisions as a file, a line of JSON each."""
    return "".join(json.dumps(_content(each)) + "\n" for each in decisions).encode()


def read_decisions(text: str) -> list[Decision]:
    """The decisions of a file's text."""
    return [_decision(**json.loads(line)) for line in text.splitlines()]


def _content(each: Decision) -> dict[str, Any]:
    after = {
        name: [own if place in each.places(name) else None for place, own in enumerate(_digits(errors))]
        for name, errors in each.after.items()
    }
    return {
        "rule": each.rule,
        "joints": each.joints,
        "weight": each.before.weight.tolist(),
        "before": _digits(each.before),
        "after": after,
        "taken": each.taken,
        "facts": each.facts,
    }


def _digits(errors: BlockErrors) -> list[list[float | None]]:
    """Mean square error of each block [rad²], joint by joint; ``None`` for blocks that a joint does not have."""
    every = errors.square.T.tolist()
    return [[None if math.isnan(value) else float(f"{value:.8g}") for value in own] for own in every]


def _decision(weight: list[float], before: list, after: dict[str, list], **others: Any) -> Decision:
    def errors(square: list) -> BlockErrors:
        nothing = [None] * len(weight)
        rows = [[math.nan if value is None else value for value in own or nothing] for own in square]
        return BlockErrors(square=torch.tensor(rows).double().T, weight=torch.tensor(weight).double())

    return Decision(before=errors(before), after={name: errors(own) for name, own in after.items()}, **others)
