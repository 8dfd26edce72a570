"""What to do and to record next."""

from __future__ import annotations

from collections.abc import Iterable

from pace_actuators.effects import Effect
from pace_optim.diagnosis.beginning.data_check import DataCheck
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.telling.next_experiment import next_experiments
from pace_optim.diagnosis.verdict.proxy_effects import curves_in
from pace_optim.problem.problem import Problem


def advise(
    problem: Problem, outcome: Outcome, decision: str, data: DataCheck, absorbed: Iterable[type[Effect]]
) -> list[str]:
    """Sentences, the most useful first."""
    result = next_experiments(problem, outcome, data.noise)
    if data.loads == 1:
        result.append(
            "All recordings carry the same load: friction that grows with the load, and a wrong torque or mass, cannot "
            "be told from other things. Record once with a known added mass (added_mass in the recording)."
        )
    if data.gains == 1:
        result.append(
            "All recordings have the same gains: errors of the gains and some delays cannot be seen. Record once with "
            "another proportional gain (stiffness in the recording)."
        )
    result += [
        f"{effect.name} would not show in these recordings: the {effect.absorbed_by} absorbs it. What would tell "
        f"them apart: {effect.separates}."
        for effect in absorbed
    ]
    if decision == "unknown" or bool(curves_in(outcome.final.model).any()):
        whose = "the error" if decision == "unknown" else "the error of some joints"
        result.append(
            f"None of the known effects explains {whose}. The report says which variable carries it, and how: find "
            "what it is, write an effect of your own (docs/your_own_effect.md) and diagnose again with --effects "
            "module:Class."
        )
    return result
