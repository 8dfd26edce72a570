"""A model of the joints, fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.estimate.error_bars.uncertainty import AT_BOUND
from pace_optim.joints.fits.model import JointModel


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
    steps: torch.Tensor | None = None
    """Normalised steps that its next derivatives are taken over, (n, P); ``None``: those of the fit."""
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

    @property
    def free_jacobian(self) -> torch.Tensor:
        """The Jacobian, zero where a parameter is held or at a bound.

        Raises:
            ValueError: If it was not kept.
        """
        if self.jacobian is None:
            raise ValueError("This needs a model that was fitted with keep_jacobian.")
        moves = self.model.free & (self.x.abs() <= 1 - AT_BOUND)
        return self.jacobian * moves.T[:, None, None]

    @property
    def moves(self) -> torch.Tensor | None:
        """Which entries move their joint, (n, P) bool; ``None`` without a Jacobian."""
        return None if self.jacobian is None else (self.jacobian != 0).any(dim=1).any(dim=1).T

    def on_joints(self, joints: torch.Tensor) -> Fitted:
        """The fit of some joints, (n,) bool, with the effects that any of them has."""
        if bool(joints.all()):
            return self
        model, entries = self.model.on_joints(joints)
        return replace(
            self,
            model=model,
            x=self.x[joints][:, entries],
            score=self.score[joints],
            jacobian=None if self.jacobian is None else self.jacobian[entries][..., joints],
            error=None if self.error is None else self.error[..., joints],
            steps=None if self.steps is None else self.steps[joints][:, entries],
        )

    def with_joints(self, joints: torch.Tensor, own: Fitted) -> Fitted:
        """The same with some joints, (n,) bool, as another fit has them; derivatives stay where no effect comes along.

        Args:
            own: Of these joints alone, or of all.
        """
        if bool(joints.all()):
            return replace(own, tried=self.tried)
        own = own.on_joints(joints) if own.model.num_joints == len(joints) else own
        model, entries = self.model.with_joints(joints, own.model)
        more = torch.zeros(len(self.x), model.size - self.model.size, dtype=self.x.dtype)
        x, score = torch.cat([self.x, more], dim=1), self.score.clone()
        x[joints.nonzero(), torch.tensor(entries)] = own.x
        score[joints] = own.score
        result = Fitted(model=model, x=x, score=score, tried=self.tried)
        if self.jacobian is None or self.error is None or own.jacobian is None or own.error is None or more.numel():
            return result
        part = torch.zeros_like(self.jacobian[..., joints])
        part[entries] = own.jacobian
        jacobian, error = self.jacobian.clone(), self.error.clone()
        jacobian[..., joints], error[..., joints] = part, own.error
        return replace(result, jacobian=jacobian, error=error)
