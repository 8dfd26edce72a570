"""What stands of a diagnosis once the whole robot is fitted with what joints alone showed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from pace_actuators.drive_result import ALL
from pace_actuators.effects import Effect
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.selection.naming import Evidence
from pace_optim.diagnosis.verdict.names import Hint, harm_of, hint
from pace_optim.diagnosis.verdict.sizes import error_bars_from_none
from pace_optim.estimate.error_bars.uncertainty import SURE
from pace_optim.joints.fits.block_errors import BlockErrors
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.run.result import FitResult

Evidences = Mapping[tuple[type[Effect], int], Evidence]


def on_whole_robot(outcome: Outcome, joint_names: Sequence[str], run: FitResult, refit: FitResult) -> Outcome:
    """The outcome with the whole robot's errors, and the effects' values of its fit."""
    final = outcome.final
    values = _entries(outcome, joint_names, refit.parameters, final.physical)
    refitted = replace(Fitted.start(final.model, values), jacobian=final.jacobian, error=final.error)
    base_errors, final_errors = (_errors(each, joint_names) for each in (run, refit))
    return replace(outcome, final=refitted, base_errors=base_errors, final_errors=final_errors)


def judged_again(
    outcome: Outcome, floor: torch.Tensor, named: Evidences, joint_names: Sequence[str], refit: FitResult
) -> tuple[Evidences, list[Hint]]:
    """The names that the whole robot's fit leaves, by the rule that they were earned by; others become hints.

    Errors, sizes and their error bars are those of that fit. The error without an effect is the lower one of the joint
    alone and the run. A fit far above the noise has no error bars; those of the joint alone stand then. A joint
    that is near the floor in the run needs no hint. Nor does one that ends there with a size that is not significant,
    where other effects stand: these explain its error.

    Args:
        outcome: With the whole robot's errors and values.
        floor: Of each joint, (n,) [rad].
        named: Effects that are named, with the evidence of each joint alone.
        joint_names: The joints.
        refit: The whole robot's fit.
    """
    now, before, after = outcome.final, outcome.base_errors.mse, outcome.final_errors.mse
    std = _entries(outcome, joint_names, refit.std, torch.zeros_like(now.physical))
    bars = error_bars_from_none(now, std)
    stuck, implausible = now.model.has_at_bounds(now.x, now.moves), now.model.implausible(now.physical)
    harm, (far, stays_far) = harm_of(outcome), (mse.sqrt() > outcome.cfg.judging.far * floor for mse in (before, after))
    stand: dict[tuple[type[Effect], int], Evidence] = {}
    hints: list[Hint] = []
    vanished: list[Hint] = []
    for row, effect in enumerate(now.model.effects):
        evidence = {
            j: replace(
                own,
                without=min(own.without, float(before[j])),
                left=float(after[j]),
                harm=float(harm[j]),
                bars=own.bars if refit.std_means_nothing else float(bars[row, j]),
                at_bound=bool(stuck[row, j]),
                implausible=bool(implausible[row, j]),
            )
            for (each, j), own in named.items()
            if each is effect
        }
        for j in evidence:
            told = hint(effect, j, evidence, outcome, replace(now, jacobian=None), std)
            if not told.doubts:
                stand[effect, j] = evidence[j]
            elif bool(far[j]):
                hints.append(told)
                if not stays_far[j] and 0 < evidence[j].bars < SURE:
                    vanished.append(told)
    return stand, [each for each in hints if not stand or each not in vanished]


def _errors(result: FitResult, joint_names: Sequence[str]) -> BlockErrors:
    """A fit's errors on what it did not train on, as one block."""
    rmse = torch.tensor([[result.rmse["validation"][name] for name in joint_names]], dtype=torch.float64)
    return BlockErrors(square=rmse.square(), weight=torch.ones(1, dtype=torch.float64))


def _entries(
    outcome: Outcome, joint_names: Sequence[str], values: Mapping[str, Mapping[str, float | None]], others: torch.Tensor
) -> torch.Tensor:
    """Values of a fit's effects as entries of the joints' model, (n, P), in place of ``others``."""
    model, result = outcome.final.model, others.clone()
    for effect, has in zip(model.effects, model.has, strict=True):
        for column, parameter in enumerate(effect.parameters, start=model.columns(effect).start):
            own = values.get(f"{effect.name}.{parameter.name}", {})
            for j in has.nonzero()[:, 0].tolist():
                value = own.get(joint_names[j], own.get(ALL))
                if value is not None:
                    result[j, column] = value
    return result
