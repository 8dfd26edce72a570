"""Effects that facts exclude: they would say that what was measured is wrong, or follow what was not logged."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch

from pace_actuators.effects import Effect
from pace_optim.recording import Recording
from pace_optim.recording.dataset import Dataset
from pace_optim.terminal.choices import MEASURED_FACTS


def excluded_effects(
    recordings: Sequence[Recording], effects: Sequence[type[Effect]], measured: Iterable[str], num_joints: int
) -> tuple[dict[type[Effect], torch.Tensor], list[str]]:
    """Effects that measured facts exclude, on which joints (n,) bool, and why, a sentence each.

    Loads were weighed where recordings state several (``load_mass``): no common factor of them is tried then.

    Args:
        recordings: The recordings.
        effects: The candidates.
        measured: What the user measured, of ``MEASURED_FACTS``.
        num_joints: Number of joints n.
    """
    facts = {fact: f"{fact} was measured" for fact in measured}
    masses = {recording.load.load_mass for recording in recordings}
    if len(masses) > 1:
        facts["load"] = f"recordings state {len(masses)} loads"
    by_effect = {MEASURED_FACTS[fact]: why for fact, why in facts.items()}
    every = torch.ones(num_joints, dtype=torch.bool)
    found = [effect for effect in effects if effect.name in by_effect]
    return (
        {effect: every for effect in found},
        [f"{effect.name} was not tried: {by_effect[effect.name]}." for effect in found],
    )


def unlogged_effects(dataset: Dataset, effects: Iterable[type[Effect]]) -> dict[type[Effect], torch.Tensor]:
    """Effects of a condition that was not logged or does not change, with the joints where that is so, (n,) bool."""
    result: dict[type[Effect], torch.Tensor] = {}
    for effect in (each for each in effects if each.condition):
        logged = dataset.condition(effect.condition)
        every = torch.ones(dataset.measured.shape[-1], dtype=torch.bool)
        result[effect] = every if logged is None else ~logged.varies
    return result
