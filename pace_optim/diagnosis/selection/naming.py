"""The one rule for a name: what an effect must show before a diagnosis says that it is missing."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg
from pace_optim.estimate.error_bars.uncertainty import SURE


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What is known of one effect on one joint; errors are squared and of validation [rad²]."""

    without: float
    """The joint's error without it, all else fitted again."""
    left: float
    """With it."""
    floor: float
    """Below this there is nothing to explain."""
    harm: float
    """What the joint's effects add to the errors of other joints of its tree."""
    larger: float
    """What the largest effect on its joint's tree explains, if that is another one; else 0."""
    slight: bool
    """Whether it counts only where the joint is far from the floor without it: it only smooths friction."""
    bars: float
    """How many of its error bars its size is away from none; 0 where it has none."""
    uneven: float
    """What a size for each recording would explain of what is left (``unevenness``)."""
    at_bound: bool
    """Whether a parameter of it has run into a bound."""
    implausible: bool
    """Whether its size is one that no drive has."""

    @property
    def rise(self) -> float:
        """By how much the joint's squared error rises without it [rad²]."""
        return self.without - self.left

    @property
    def explained(self) -> float:
        """Part that it explains of what lies above the floor without it."""
        before, after = (max(0.0, each - self.floor) for each in (self.without, self.left))
        return 1 - (after + self.harm) / max(before, 1e-30)

    @property
    def scatter(self) -> float:
        """RMS by which its sizes in single recordings differ from its size, as a part of that.

        Separate sizes would explain a part u of what is left, e². The effect explains g² - e² of the g² without it, and
        a size that differs by a part s explains s² of that:

            s = √(u e² / (g² - e²))
        """
        return math.sqrt(max(0.0, self.uneven) * self.left / max(self.rise, 1e-30))


DIFFERS = "its size differs between recordings"
CURVE_LEAVES_LESS = "a curve leaves less than half of its error"


def doubts(evidence: Evidence, *, cfg: DiagnosisCfg = DEFAULT) -> list[str]:
    """What speaks against naming an effect, each to be read after "as"; none where its name is earned.

    An effect is named where it explains more than it leaves of what lies above the floor. Its size must be one that
    drives have, and surely not zero by its error bars. Where its joint does not end near the floor, its size must also
    have an error bar, be the same in every recording, and be away from its bounds. Beside a larger effect it counts
    only on what that leaves far from the floor: effects there, also on other joints of its tree, take up what the model
    of the larger one gets wrong.
    """
    near = cfg.judging.far**2 * evidence.floor
    if (evidence.larger or evidence.slight) and evidence.without <= near:
        return ["the error is near the floor without it"]
    if evidence.explained < 0.5:
        return ["it leaves more than it explains"]
    far = evidence.left > near
    return [
        *(["its size is not significant"] if evidence.bars < SURE and (far or evidence.bars > 0) else []),
        *([DIFFERS] if far and evidence.scatter > cfg.verdict.scatter else []),
        *(["it is at a bound"] if far and evidence.at_bound else []),
        *(["no drive has such a value"] if evidence.implausible else []),
    ]
