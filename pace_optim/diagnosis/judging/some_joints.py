"""Some joints of a robot by themselves: nothing that is done with them costs, or changes, anything of the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.fitting.fits import Fits
from pace_optim.diagnosis.fitting.validation import BlockErrors
from pace_optim.diagnosis.judging.candidate_results import Round, Trial
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.diagnosis.model.model import BASE
from pace_optim.single_joint_model.problem import TwinProblem


@dataclass(frozen=True, eq=False)
class SomeJoints:
    """Takes some joints out of the robot, and puts back what came of them."""

    which: torch.Tensor
    """(n,) bool."""

    @property
    def indices(self) -> list[int]:
        """Where they are in the robot."""
        return self.which.nonzero()[:, 0].tolist()

    def of_problem(self, problem: TwinProblem) -> TwinProblem:
        """The problem of these joints."""
        return problem if bool(self.which.all()) else problem.on_joints(self.indices)

    def of_fit(self, fitted: Fitted) -> Fitted:
        """The model of these joints, with the effects that they have."""
        if bool(self.which.all()):
            return fitted
        model, entries = fitted.model.on_joints(self.which)

        def part(derivatives: torch.Tensor | None) -> torch.Tensor | None:
            return None if derivatives is None else derivatives[..., self.which]

        jacobian = None if fitted.jacobian is None else fitted.jacobian[entries]
        return replace(
            fitted,
            model=model,
            x=fitted.x[self.which][:, entries],
            score=fitted.score[self.which],
            jacobian=part(jacobian),
            error=part(fitted.error),
        )

    def of_errors(self, errors: BlockErrors) -> BlockErrors:
        """The errors of these joints."""
        return replace(errors, square=errors.square[:, self.which])

    def _fit_of_all(self, own: Fitted, now: Fitted) -> Fitted:
        """A model of all joints: these as they were fitted, the others as they are; without derivatives.

        Args:
            own: These joints' model.
            now: All joints' model.
        """
        if bool(self.which.all()):
            return own
        model = now.model
        for effect in own.model.effects:
            model = model.with_effect(effect, torch.zeros_like(self.which))
        has, lower, upper = model.has.clone(), model.lower.clone(), model.upper.clone()
        x = torch.cat([now.x, torch.zeros(len(now.x), model.size - now.model.size, dtype=now.x.dtype)], dim=1)
        places = list(range(len(BASE)))
        for row, effect in enumerate(own.model.effects):
            has[model.effects.index(effect), self.which] = own.model.has[row]
            columns = model.columns(effect)
            places += range(columns.start, columns.stop)
        at = torch.tensor(self.indices)[:, None], torch.tensor(places)[None]
        lower[at], upper[at], x[at] = own.model.lower, own.model.upper, own.x
        score = now.score.clone()
        score[self.which] = own.score
        return Fitted(model=replace(model, has=has, lower=lower, upper=upper), x=x, score=score, tried=own.tried)

    def refitted(
        self, fits: Fits, problem: TwinProblem, starts: Sequence[Fitted], errors: BlockErrors
    ) -> tuple[list[Fitted], list[BlockErrors]]:
        """Fit models of all joints on these, and their errors; the others stay as they are.

        Args:
            fits: Fits models.
            problem: All joints.
            starts: The models.
            errors: What the other joints' errors are.
        """
        own = self.of_problem(problem)
        fitted = fits.coarse_to_fine(own, [self.of_fit(start) for start in starts])
        after = [self._errors_of_all(each, errors) for each in fits.validation_errors(own, fitted)]
        return [self._fit_of_all(each, start) for each, start in zip(fitted, starts, strict=True)], after

    def _errors_of_all(self, own: BlockErrors, now: BlockErrors) -> BlockErrors:
        """Errors of all joints: of these as they are now known, of the others as before."""
        square = now.square.clone()
        square[:, self.which] = own.square
        return replace(now, square=square)

    def round_of_all(self, own: Round, now: Fitted) -> Round:
        """A round of all joints, in which nothing was tried on the others."""
        n = len(self.which)
        trials: list[Sequence[Trial]] = [()] * n
        chosen: list[type[Effect] | None] = [None] * n
        rivals: list[Sequence[type[Effect]]] = [()] * n
        for k, j in enumerate(self.indices):
            trials[j] = [replace(trial, joint=j) for trial in own.trials[k]]
            chosen[j], rivals[j] = own.chosen[k], own.rivals[k]
        models = {effect: self._fit_of_all(fitted, now) for effect, fitted in own.models.items()}
        return Round(trials=trials, chosen=chosen, rivals=rivals, models=models)
