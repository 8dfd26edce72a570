"""Solutions that fit as well as the best but lie elsewhere: what an error bar at one optimum cannot know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pace_optim.optimizers.least_squares import Descent
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.uncertainty.uncertainty import Uncertainty

AS_GOOD = 1e-3
_APART = 0.02
_APART_STD = 5.0


def with_other_solutions(uncertainty: Uncertainty, descents: Sequence[Descent], space: ParameterSpace) -> Uncertainty:
    """Add, joint by joint, the parameters in which another start ended as low but far away.

    A solution counts whose score is within 0.1 % of the best one's. A parameter is far when it differs by more than 2 %
    of its bound range and by five standard deviations.

    Args:
        uncertainty: At the best.
        descents: All, the best first.
        space: The parameters.
    """
    if not descents:
        return uncertainty
    best, groups = descents[0], list(uncertainty.indistinguishable)
    half_range = np.maximum(space.slope(best.x).numpy(), 1e-300)
    std = np.nan_to_num(uncertainty.std / half_range)  # at a bound there is none
    for other in descents[1:]:
        if not other.score <= (1 + AS_GOOD) * best.score:
            continue
        difference = np.abs((other.x - best.x).numpy())
        apart = np.flatnonzero((difference > 2 * _APART) & (difference > _APART_STD * std))
        by_key: dict[str, list[str]] = {}
        for i in apart.tolist():
            by_key.setdefault(space.labels[i].split("/", 1)[1], []).append(space.labels[i])
        groups += [tuple(labels) for labels in by_key.values() if len(labels) > 1 and tuple(labels) not in groups]
    return replace(uncertainty, indistinguishable=tuple(groups))
