"""Which effects found are really there, and which are a proxy for something that is not known."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pace_optim.diagnosis.search.state import Outcome
from pace_optim.single_joint_fits.model import JointModel


def above_floor(outcome: Outcome, floor: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Squared error above the floor before and after, (n,) each [rad²].

    Args:
        outcome: Where the search ended.
        floor: Of each joint, (n,) [rad].
    """
    before, after = ((errors.mse - floor**2).clamp(min=0.0) for errors in (outcome.base_errors, outcome.final_errors))
    return before, after


def near_floor(outcome: Outcome, floor: torch.Tensor) -> torch.Tensor:
    """Joints whose error is near the floor in the end, (n,) bool."""
    return outcome.final_errors.mse.sqrt() <= outcome.cfg.judging.far * floor


def real_effects(outcome: Outcome, floor: torch.Tensor) -> torch.Tensor:
    """Effects that are no proxies, (effects, n) bool."""
    model = outcome.final.model
    return model.has & ~curves_in(model) & ~_at_bounds(outcome) & ~_uneven(outcome, floor)


def curves_in(model: JointModel) -> torch.Tensor:
    """Curves of any form that stand where an effect is not known, (effects, n) bool."""
    return model.has & torch.tensor([effect.free_form for effect in model.effects], dtype=torch.bool)[:, None]


def counts_as_missing(outcome: Outcome, floor: torch.Tensor) -> torch.Tensor:
    """Effects that count as missing, (effects, n) bool: no curves, no smoothing of friction where it hardly shows."""
    model = outcome.final.model
    smooths = torch.tensor([effect.smooths_friction for effect in model.effects], dtype=torch.bool)[:, None]
    hardly_shows = outcome.base_errors.mse.sqrt() <= outcome.cfg.judging.far * floor
    return model.has & ~curves_in(model) & ~(smooths & hardly_shows)


def proxies(outcome: Outcome, names: Sequence[str], floor: torch.Tensor) -> list[str]:
    """Effects that are proxies for something else, and what shows it: a sentence each."""
    stuck, uneven = (_said(outcome, names, which) for which in (_at_bounds(outcome), _uneven(outcome, floor)))
    return [
        *([f"{stuck} is at a bound, so it is probably a proxy for another effect."] if stuck else []),
        *([f"{uneven} needs a different value in each recording, so it is probably a proxy."] if uneven else []),
    ]


def varying(outcome: Outcome, names: Sequence[str], floor: torch.Tensor) -> list[str]:
    """Effects of the right form whose size differs between recordings, in a sentence."""
    said = _said(outcome, names, _much_left(outcome, floor) & (outcome.unevenness >= outcome.cfg.verdict.most))
    return [f"Its size differs between recordings, so it depends on something more: {said}."] if said else []


def _said(outcome: Outcome, names: Sequence[str], which: torch.Tensor) -> str:
    """Effects on some joints, (effects, n) bool, in words."""
    return ", ".join(
        f"{effect.name} ({', '.join(name for name, yes in zip(names, joints.tolist(), strict=True) if yes)})"
        for effect, joints in zip(outcome.final.model.effects, which & outcome.final.model.has, strict=True)
        if bool(joints.any())
    )


def _at_bounds(outcome: Outcome) -> torch.Tensor:
    model = outcome.final.model
    return model.at_bounds(outcome.final.x) & ~curves_in(model)


def _uneven(outcome: Outcome, floor: torch.Tensor) -> torch.Tensor:
    share = outcome.unevenness
    return _much_left(outcome, floor) & (share > outcome.cfg.verdict.uneven) & (share < outcome.cfg.verdict.most)


def _much_left(outcome: Outcome, floor: torch.Tensor) -> torch.Tensor:
    """Joints whose effects do not explain nearly all, so that their sizes matter, (n,) bool."""
    before, after = above_floor(outcome, floor)
    return (after > (1 - outcome.cfg.verdict.nearly_all) * before) & ~near_floor(outcome, floor)
