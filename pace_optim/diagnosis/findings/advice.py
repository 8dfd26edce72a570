"""What to do and to record next."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache

from pace_actuators.effects import Effect
from pace_optim.diagnosis.checks.data_check import DataCheck
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.verdict.names import curves_in, new_effects
from pace_optim.diagnosis.verdict.verdict import confounded
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import found_effects, whole_values
from pace_optim.motion.design.telling_apart import Rivals, RobotModel, next_experiments
from pace_optim.problem.problem import Problem
from pace_optim.run.result import drive_in_force


def advise(
    problem: Problem, outcome: Outcome, decision: str, data: DataCheck, absorbed: Iterable[type[Effect]]
) -> list[str]:
    """Sentences, the most useful first."""
    model = outcome.final.model
    found = [e for e, has in zip(model.effects, new_effects(outcome, model), strict=True) if bool(has.any())]
    result = [effect.remark for effect in found if effect.remark]
    result += next_experiments(problem, rivals(problem.joint_names, outcome), data.noise, outcome.cfg.menu)
    if data.loads == 1:
        result.append(
            "All recordings carry the same load: friction that grows with the load, and a wrong torque or mass, cannot "
            "be separated. Record once with a known added mass (added_mass in the recording)."
        )
    if data.gains == 1:
        has_stiffness = any(drive_in_force(problem).get("stiffness", {}).values())
        other_gain = "another proportional gain (stiffness" if has_stiffness else "another velocity gain (damping"
        result.append(
            "All recordings have the same gains: errors of the gains and some delays cannot be seen. Record once with "
            f"{other_gain} in the recording)."
        )
    result += [
        f"{effect.name} would not show in these recordings: the {effect.absorbed_by} absorbs it. To "
        f"separate them, you need {effect.separates}."
        for effect in absorbed
    ]
    if decision == "unknown" or bool(curves_in(model).any()):
        whose = "the error" if decision == "unknown" else "the error of some joints"
        result.append(
            f"None of the known effects explains {whose}. The report shows which variable carries it. Find "
            "the cause, write it as an effect (docs/your_own_effect.md) and diagnose again with --effects module:Class."
        )
    return result


def rivals(joint_names: Sequence[str], outcome: Outcome) -> list[Rivals]:
    """Effects that the recordings cannot separate, as models of the whole robot."""

    @cache
    def with_it(fitted: Fitted) -> RobotModel:
        model, values = fitted.model, whole_values(fitted.model, fitted.x, joint_names)
        return RobotModel(effects=found_effects(model, joint_names), values=values)

    result = []
    for pair in confounded(outcome):
        names, separates = (pair.chosen.name, pair.rival.name), pair.chosen.separates or pair.rival.separates
        models = with_it(pair.models[0]), with_it(pair.models[1])
        hint = f"To separate them, you need {separates}." if separates else ""
        result.append(Rivals(names=names, models=models, joints=pair.joints, hint=hint))
    return result
