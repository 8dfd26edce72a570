"""A model of the joints, fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.model.model import JointModel


@dataclass(kw_only=True, eq=False)
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

    def take(self, other: Fitted, joints: torch.Tensor) -> None:
        """Take over another fit of the same effects on some joints, (n,) bool, and what is known of it there."""
        lower, upper = (
            torch.where(joints[:, None], getattr(other.model, side), getattr(self.model, side))
            for side in ("lower", "upper")
        )
        self.model = replace(self.model, lower=lower, upper=upper)
        self.x = torch.where(joints[:, None], other.x, self.x)
        self.score = torch.where(joints, other.score, self.score)
        if self.jacobian is not None and other.jacobian is not None:
            self.jacobian = torch.where(joints, other.jacobian, self.jacobian)
        if self.error is not None and other.error is not None:
            self.error = torch.where(joints, other.error, self.error)
