"""A model of the joints, fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.model.model import JointModel


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """A model fitted to the training recordings."""

    model: JointModel
    x: torch.Tensor
    """Normalised, (n, P)."""
    score: torch.Tensor
    """Mean square error of each joint, (n,) [rad²]; infinite where it is not known yet."""
    tried: type[Effect] | None = None
    """The effect that is tried in it."""
    jacobian: torch.Tensor | None = None
    """Derivatives of the errors at x (P, K, R, n) float32, where wanted."""
    error: torch.Tensor | None = None
    """At x, (K, R, n) float32, where wanted."""
    falls: bool = False
    """Whether its error was still falling when its iterations were over."""

    @classmethod
    def start(cls, model: JointModel, physical: torch.Tensor, tried: type[Effect] | None = None) -> Fitted:
        """A model at physical values (n, P), not fitted yet."""
        unknown = torch.full((model.num_joints,), torch.inf, dtype=torch.float64)
        return cls(model=model, x=model.to_normalised(physical), score=unknown, tried=tried)

    @property
    def physical(self) -> torch.Tensor:
        """Physical values, (n, P)."""
        return self.model.to_physical(self.x)

    def merged(self, other: Fitted, joints: torch.Tensor) -> Fitted:
        """The same with another fit of the same effects on some joints, (n,) bool, and what is known of it there."""

        def either(one: torch.Tensor | None, two: torch.Tensor | None) -> torch.Tensor | None:
            return one if one is None or two is None else torch.where(joints, two, one)

        lower, upper = (
            torch.where(joints[:, None], getattr(other.model, side), getattr(self.model, side))
            for side in ("lower", "upper")
        )
        return replace(
            self,
            model=replace(self.model, lower=lower, upper=upper),
            x=torch.where(joints[:, None], other.x, self.x),
            score=torch.where(joints, other.score, self.score),
            jacobian=either(self.jacobian, other.jacobian),
            error=either(self.error, other.error),
        )
