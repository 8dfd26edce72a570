"""Where else to start, when a descent may have ended in a wrong valley."""

from __future__ import annotations

import torch

from pace_optim.problem.parameter_space import ParameterSpace

_EDGE = 0.9
"""Random starts keep this far from the middle, at most; normalised."""


def other_valleys(space: ParameterSpace, best: torch.Tensor) -> list[torch.Tensor]:
    """A vector with another delay, and with neither bias nor friction: where least squares can get stuck.

    Args:
        space: The parameters.
        best: Normalised, (size,).
    """
    starts = []
    for delay in (-0.5, 0.5):
        other = best.clone()
        other[space["delay"]] = delay
        starts.append(other)
    other = best.clone()
    other[space["encoder_bias"]] = 0.0
    other[space["friction"]] = 0.0
    return [*starts, other]


def scattered(space: ParameterSpace, count: int, seed: int) -> list[torch.Tensor]:
    """Some vectors anywhere between the bounds, normalised (size,) each."""
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, space.size, generator=generator, dtype=torch.float64)
    return list(_EDGE * (2 * uniform - 1))
