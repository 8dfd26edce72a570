"""What was decided on the way to a diagnosis, in numbers that the decision can be made from again."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from pace_optim.diagnosis.fitting.validation import BlockErrors

FILE = "decisions.jsonl"


@dataclass(frozen=True, kw_only=True)
class Decision:
    """One decision about some joints; errors are of validation."""

    rule: str
    """Which move or rule decided: ``add``, or one of ``diagnosis_cfg.RULES``."""
    joints: list[int]
    """About which joints, by index."""
    weight: list[float]
    """Samples of each block."""
    before: list[list[float]]
    """Mean square error of each block [rad²], joint by joint, with the present model."""
    after: dict[str, list[list[float] | None]]
    """The same with each that was tried; ``None`` for joints it was not tried on."""
    taken: list[str | None]
    """What each joint took."""
    facts: dict[str, Any] = field(default_factory=dict)
    """What else the rule needs."""


Log = Callable[[Decision], None]


def unlogged(_: Decision) -> None:
    """Keeps nothing."""


def decision(
    rule: str,
    joints: Sequence[int],
    before: BlockErrors,
    after: Mapping[str, BlockErrors],
    taken: Mapping[int, str],
    on: Mapping[str, Sequence[int]] | None = None,
    **facts: Any,
) -> Decision:
    """A decision in numbers.

    Args:
        rule: Which rule decided.
        joints: About which joints, by index.
        before: The present model's errors, of all joints.
        after: Errors with each that was tried, or without.
        taken: What joints took.
        on: On which joints each was tried; all of them if not given.
        facts: What else the rule needs.
    """
    return Decision(
        rule=rule,
        joints=list(joints),
        weight=before.weight.tolist(),
        before=[_digits(before.square[:, j]) for j in joints],
        after={
            name: [_digits(own.square[:, j]) if on is None or j in on[name] else None for j in joints]
            for name, own in after.items()
        },
        taken=[taken.get(j) for j in joints],
        facts=facts,
    )


def _digits(values: torch.Tensor) -> list[float]:
    return [float(f"{value:.8g}") for value in values.tolist()]


def as_lines(decisions: Iterable[Decision]) -> bytes:
    """Decisions as a file, a line of JSON each."""
    return "".join(json.dumps(asdict(each)) + "\n" for each in decisions).encode()


def read_decisions(path: Path) -> list[Decision]:
    """The decisions of a file."""
    return [Decision(**json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]
