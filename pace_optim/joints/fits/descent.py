"""Levenberg–Marquardt of one model with ``ask`` and ``tell``; each joint is an independent problem."""

from __future__ import annotations

import torch

from pace_optim.estimate.levenberg_marquardt import (
    DAMPING_TRIALS,
    FIRST_DAMPING,
    LinearModel,
    next_damping,
    rows_of,
    trial_rows,
)
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.fitting_cfg import FittingCfg

TRIALS = DAMPING_TRIALS[:-1]
"""Those of a whole robot's fit without the largest: a joint has few parameters."""


class JointDescent:
    """One model's descent: rows are the favoured step, its neighbours for the next Jacobian, and the other trials.

    In a neighbour every joint has another one of its free entries moved, so that there are as many as a joint has, and
    not as many as all joints have together.
    """

    def __init__(self, start: Fitted, samples: torch.Tensor, keep: bool, rough: bool, cfg: FittingCfg):
        """Begin at the model's x.

        Args:
            start: The model.
            samples: How many count for each joint, (n,).
            keep: Whether the last Jacobian is kept.
            rough: Whether derivatives are taken over wide steps first.
            cfg: Steps and tolerances.
        """
        self._cfg = cfg
        self.model, self.tried, self._samples, self._keep = start.model, start.tried, samples, keep
        n = len(start.x)
        self.x = start.x.clone()
        self.score = torch.full((n,), torch.inf, dtype=torch.float64)
        self._damping = torch.full((n,), FIRST_DAMPING, dtype=torch.float64)
        self._free = [own.nonzero()[:, 0] for own in start.model.free]
        most = start.model.most_free
        self._hessian = torch.zeros(n, most, most, dtype=torch.float64)
        self._gradient = torch.zeros(n, most, dtype=torch.float64)
        self._known = torch.zeros(n, dtype=torch.bool)
        self._still = torch.zeros(n, dtype=torch.long)
        self._converged = torch.zeros(n, dtype=torch.bool)
        self._widths = torch.tensor([*(cfg.wide if rough else ()), cfg.narrow], dtype=torch.float64)
        self._width = torch.zeros(n, dtype=torch.long)
        self._jacobian: torch.Tensor | None = None
        self._error: torch.Tensor | None = None
        self._led = torch.ones(n, dtype=torch.bool)
        self._scores: list[float] = []

    @property
    def finished(self) -> bool:
        """Whether every joint has once come to its end."""
        return bool(self._converged.all())

    def ask(self) -> torch.Tensor:
        """Normalised rows, (neighbours + trials, n, P)."""
        trials = self.x.repeat(len(TRIALS), 1, 1)
        for j in self._known.nonzero()[:, 0].tolist():
            at, linear = self._linear_model(j)
            trials[:, j, at] = linear.trials(self.x[j, at], float(self._damping[j]), TRIALS)
        favoured = trials[0]
        width = self._widths[self._width][:, None]
        self._step = torch.where(favoured > 0, -width, width)
        neighbours = favoured.repeat(self._gradient.shape[1], 1, 1)
        for j, at in enumerate(self._free):
            neighbours[torch.arange(len(at)), j, at] += self._step[j, at]
        return rows_of(trials, neighbours)

    def tell(self, x: torch.Tensor, error: torch.Tensor) -> None:
        """Take the best row of each joint."""
        size = self.x.shape[1]
        scores = error.square().sum(dim=(1, 2), dtype=torch.float64).cpu() / self._samples
        choice = trial_rows(len(x), len(TRIALS))
        best = scores[choice].argmin(dim=0)
        lowest = scores[choice].gather(0, best[None])[0]
        better = lowest < self.score
        # a joint whose Jacobian was not known has not moved: its favoured row is x itself, and shows no gain
        fresh = ~self._known
        gain = (self.score - lowest) / self.score
        self._still = torch.where(fresh, self._still, torch.where(gain > self._cfg.enough, 0, self._still + 1))
        narrower = (self._still > 0) & (self._width + 1 < len(self._widths))
        self._still[narrower] = 0
        self._converged |= self._still >= 2
        chosen = x[choice].gather(0, best[None, :, None].expand(1, -1, size))[0]
        moved = better & ~fresh
        self.x = torch.where(moved[:, None], chosen, self.x)
        self.score = torch.where(better, lowest, self.score)
        self._scores.append(float(self.score.sum()))
        for j in (~fresh).nonzero()[:, 0].tolist():
            self._damping[j] = next_damping(float(self._damping[j]), int(best[j]) if bool(moved[j]) else None)
        at_favoured = fresh | (moved & (best == 0))
        self._known = torch.where(at_favoured, True, torch.where(moved, False, self._known)) & ~narrower
        self._width += narrower
        self._damping = torch.where(narrower, FIRST_DAMPING, self._damping)
        if bool(at_favoured.any()):
            columns = error[1 : 1 + self._gradient.shape[1]] - error[:1]
            columns /= self._steps()[:, None, None, :].to(error.device, torch.float32)
            hessian = torch.einsum("pkrj,skrj->jps", columns, columns).cpu().double() / self._samples[:, None, None]
            gradient = torch.einsum("pkrj,krj->jp", columns, error[0]).cpu().double() / self._samples[:, None]
            self._hessian = torch.where(at_favoured[:, None, None], hessian, self._hessian)
            self._gradient = torch.where(at_favoured[:, None], gradient, self._gradient)
            self._converged |= at_favoured & ~narrower & self._at_the_bottom()
            if self._keep:
                self._keep_derivatives(columns, error[0], at_favoured)
        if self._error is not None:
            for j in moved.nonzero()[:, 0].tolist():
                self._error[..., j] = error[choice[int(best[j])], ..., j]

    @property
    def leads(self) -> bool:
        """Whether the last chord step has led a joint further."""
        return bool(self._led.any())

    def chord(self) -> torch.Tensor:
        """Where the derivatives that were kept lead from x, (1, n, P); joints that they led no further stay."""
        if self._jacobian is None or self._error is None:
            raise ValueError("Chord steps need a descent that keeps its Jacobian.")
        result = self.x.clone()
        for j in self._led.nonzero()[:, 0].tolist():
            at = self._free[j]
            columns = self._jacobian[at.to(self._jacobian.device), ..., j].flatten(1)
            gradient = (columns @ self._error[..., j].flatten()).cpu().double() / self._samples[j]
            linear = LinearModel(self._hessian[j, : len(at), : len(at)], gradient)
            result[j, at] = linear.step(self.x[j, at], 0.0)
        return result[None]

    def tell_chord(self, x: torch.Tensor, error: torch.Tensor) -> None:
        """Take the row (1, n, P) on joints where its error (1, K, R, n) is lower."""
        score = error[0].square().sum(dim=(0, 1), dtype=torch.float64).cpu() / self._samples
        self._led &= score < self.score
        self.x = torch.where(self._led[:, None], x[0], self.x)
        self.score = torch.where(self._led, score, self.score)
        if self._error is not None:
            self._error = torch.where(self._led.to(error.device), error[0], self._error)

    def _steps(self) -> torch.Tensor:
        """By how much each joint is moved in each neighbour, (neighbours, n); 1 where it is not."""
        result = torch.ones(self._gradient.T.shape, dtype=torch.float64)
        for j, at in enumerate(self._free):
            result[: len(at), j] = self._step[j, at]
        return result

    def _keep_derivatives(self, columns: torch.Tensor, error: torch.Tensor, joints: torch.Tensor) -> None:
        """Keep the errors of some joints, (n,) bool, and their derivatives by the entries that are free."""
        if self._jacobian is None or self._error is None:
            self._jacobian = torch.zeros(self.x.shape[1], *error.shape, dtype=error.dtype, device=error.device)
            self._error = torch.zeros_like(error)
        for j in joints.nonzero()[:, 0].tolist():
            at = self._free[j]
            self._jacobian[at.to(error.device), ..., j] = columns[: len(at), ..., j]
            self._error[..., j] = error[..., j]

    def _at_the_bottom(self) -> torch.Tensor:
        """Joints whose linear model, of the narrowest derivatives, promises next to nothing, (n,) bool."""
        result = self._width + 1 == len(self._widths)
        for j in result.nonzero()[:, 0].tolist():
            at, linear = self._linear_model(j)
            x = self.x[j, at]
            promised = linear.expected_gain(linear.step(x, FIRST_DAMPING) - x)
            result[j] = promised < self._cfg.enough / 10 * float(self.score[j])
        return result

    def _linear_model(self, joint: int) -> tuple[torch.Tensor, LinearModel]:
        """Free entries of a joint, and the linear model of its score by them."""
        at = self._free[joint]
        own = slice(len(at))
        return at, LinearModel(self._hessian[joint, own, own], self._gradient[joint, own])

    def result(self) -> Fitted:
        """Where it ended."""
        return Fitted(
            model=self.model,
            x=self.x,
            score=self.score,
            tried=self.tried,
            jacobian=None if self._jacobian is None else self._jacobian.cpu(),
            error=None if self._error is None else self._error.cpu(),
            falls=self._falls(),
        )

    def _falls(self) -> bool:
        """Whether the last steps have lowered the error."""
        last = self._scores[-1 - self._cfg.rounds :]
        return not self.finished and len(last) > 1 and last[-1] < (1 - self._cfg.falls) * last[0]
