"""What a diagnosis found, in words and tables."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from pace_actuators.drive_result import ALL
from pace_actuators.effects import Effect, get_effect
from pace_actuators.files import json_text
from pace_actuators.joint_units import units_for
from pace_actuators.text import conjoined
from pace_optim.diagnosis.checks.data_check import DataCheck
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT
from pace_optim.diagnosis.findings.advice import advise
from pace_optim.diagnosis.findings.result import Diagnosis
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.verdict.free_curves import Curves, error_map
from pace_optim.diagnosis.verdict.names import Hint
from pace_optim.diagnosis.verdict.sizes import factor_of, sizes
from pace_optim.diagnosis.verdict.verdict import likes, ranking
from pace_optim.diagnosis.wrong_links import LinkFindings
from pace_optim.joints.fits.fits import Fits
from pace_optim.problem.problem import Problem
from pace_optim.run.result import FitResult

_LEAST_TOLD = 0.1
"""Smaller shares are printed as below this [%]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """What the search on the twins found."""

    outcome: Outcome
    data: DataCheck
    absorbed: dict[type[Effect], torch.Tensor]
    """Effects that a base parameter absorbs, and on which joints (n,): these recordings would not show them there."""
    verdict: str
    explained: float
    """Part of the error above the floor that the effects found explain."""
    paying: list[str]
    """Effects of the final model, as ``fit.py --effects`` takes them, the largest share first: with the verdict
    ``unknown`` all that lower the error, though they are not what is missing."""
    shares: dict[type[Effect], float]
    """How much of what they explain is due to each, in the same order."""
    hints: Sequence[Hint] = ()
    """Effects that lower the error of joints and have not earned their names."""
    curves: Curves | None = None
    """Which variable carries what is missing; ``None`` where the effects found leave little."""

    @property
    def free_form(self) -> list[str]:
        """Those of them that are curves, where an effect is not known."""
        names = {e.name for e in self.shares if e.free_form}
        return [label for label in self.paying if label.partition("@")[0] in names]

    @property
    def added(self) -> list[str]:
        """Those that are what is missing."""
        return [label for label in self.paying if label not in self.free_form] if self.verdict == "effect" else []


def told(
    found: Findings,
    fits: Fits,
    problem: Problem,
    run: FitResult,
    folder: Path,
    candidates: Sequence[type[Effect]],
) -> Diagnosis:
    """What was found, as ``diagnosis.json`` has it."""
    cfg = found.outcome.cfg
    return Diagnosis(
        run=str(folder),
        verdict=found.verdict,
        summary=summary_of(found, problem),
        explained=found.explained,
        added=found.added,
        paying=found.paying,
        shares={effect.name: share for effect, share in found.shares.items()},
        free_form=found.free_form,
        ranking=ranking(
            found.outcome, problem.joint_names, found.verdict, list(found.shares), joint_types=problem.joint_types
        ),
        hints=[asdict(hint) | {"joint": problem.joint_names[hint.joint]} for hint in found.hints],
        sizes=sizes(fits, found.outcome, found.data.floor, problem.joint_names),
        likes=likes(found.outcome),
        joints=by_joint(found, problem),
        data=[*found.data.sentences, *_about_run(found, problem, run)],
        absorbed={effect.name: effect.absorbed_by for effect in found.absorbed},
        advice=advise(problem, found.outcome, found.verdict, found.data, found.absorbed),
        runs=[str(folder)],
        tried=[effect.name for effect in candidates],
        physics_dt=problem.physics_dt,
        ladder=ladder(found),
        error_map=error_map(
            found.curves,
            problem.joint_names,
            found.outcome.base_errors,
            joint_types=problem.joint_types,
            cfg=cfg.judging,
        ),
        cfg=json.loads(json_text(asdict(cfg))),
    )


def with_links(diagnosis: Diagnosis, wrong: LinkFindings, problem: Problem) -> Diagnosis:
    """The same with the links that the model file states wrongly; effects were then sought beside them."""
    if not wrong.wrong:
        return replace(diagnosis, data=[*wrong.sentences, *diagnosis.data])
    unit = units_for("mrad", problem.joint_types)
    said = [each.sentence for each in wrong.wrong]
    fall = (
        f"With {conjoined(each.label for each in wrong.wrong)} the validation error falls from "
        f"{1e3 * wrong.before:.3g} to {1e3 * wrong.after:.3g} {unit} at the diagnosis' physics step."
    )
    rest = [] if diagnosis.verdict == "nothing_missing" else [diagnosis.summary]
    return replace(
        diagnosis,
        verdict="link" if diagnosis.verdict == "nothing_missing" else diagnosis.verdict,
        summary=" ".join([*said, *rest]),
        data=[fall, *diagnosis.data],
        links=[asdict(each) | {"label": each.label} for each in wrong.wrong],
    )


def with_refit(diagnosis: Diagnosis, run: FitResult, refit: FitResult, folder: Path) -> Diagnosis:
    """The same with the whole robot's errors, before and with what was found.

    Args:
        diagnosis: Of the run.
        run: What was diagnosed.
        refit: The whole robot with what was found.
        folder: Of the refit.
    """
    names = [*(link["link"] for link in diagnosis.links), *diagnosis.paying]
    before, after = (each.rmse["validation"][ALL] for each in (run, refit))
    unit = units_for("mrad", run.joint_types)
    floors = {joint: own.get("floor", math.inf) for joint, own in diagnosis.joints.items()}
    alike, left = DEFAULT.judging.alike, refit.rmse["validation"]
    above = {joint for joint, floor in floors.items() if left.get(joint, 0.0) > alike * floor}
    fall = f"With it the whole robot's validation error falls from {1e3 * before:.3g} to {1e3 * after:.3g} {unit}."
    return replace(
        diagnosis,
        summary=f"{diagnosis.summary} {fall}",
        sizes=[_as_refitted(size, refit, above) for size in diagnosis.sizes],
        runs=[diagnosis.run, str(folder)],
        ladder=[
            {"model": "base model", "validation_rmse": before, "run": diagnosis.run},
            {"model": " + ".join(names), "validation_rmse": after, "run": str(folder)},
        ],
    )


def _as_refitted(size: dict[str, Any], refit: FitResult, above: Collection[str]) -> dict[str, Any]:
    """The size of an effect as the refit of the whole robot has it; stiff and ``above`` the floor: no error bar."""
    name, joint = f"{size['effect']}.{size['parameter']}", size["joint"]
    values = refit.parameters.get(name, {})
    if (key := joint if joint in values else ALL) not in values:
        return size
    effect = get_effect(size["effect"])
    (parameter,) = (each for each in effect.parameters if each.name == size["parameter"])
    return size | {
        "value": values[key],
        "std": None if refit.std_means_nothing or (effect.is_stiff and joint in above) else refit.std[name][key],
        "factor": None if size["factor"] is None else factor_of(effect, parameter, values[key]),
        "at_bound": f"{name}/{key}" in refit.at_bound,
    }


def _about_run(found: Findings, problem: Problem, run: FitResult) -> list[str]:
    """The run's effects, and why its error of the same model differs, if it does."""
    said = []
    if run.effects:
        said.append(f"The search began with what the run has: {', '.join(run.effects)}.")
    own, here = run.rmse["validation"].get("all"), float(found.outcome.base_errors.mse.mean().sqrt())
    if own is None or f"{1e3 * own:.3g}" == f"{1e3 * here:.3g}":
        return said
    ways = []
    if not math.isclose(run.physics_dt, problem.physics_dt):
        ways.append(f"the physics step is {1e3 * problem.physics_dt:g} instead of {1e3 * run.physics_dt:g} ms")
    ways.append("each joint is simulated alone with a separate delay, in blocks of up to one second")
    unit = units_for("mrad", problem.joint_types)
    return [
        *said,
        f"The run's validation error is {1e3 * own:.3g} {unit}, that of the joints simulated alone {1e3 * here:.3g} "
        f"{unit}: {', and '.join(ways)}.",
    ]


def summary_of(found: Findings, problem: Problem) -> str:
    """The verdict in a few sentences."""
    unit = units_for("mrad", problem.joint_types)
    before = 1e3 * float(found.outcome.base_errors.mse.mean().sqrt())
    alone = "" if len(problem.joint_names) == 1 else ", with each joint simulated alone"
    floor = 1e3 * float(found.data.floor.square().mean().sqrt())
    if found.verdict == "nothing_missing":
        return (
            f"Nothing is missing that these recordings could show: the validation error is {before:.3g} {unit}, the "
            f"floor of noise and numerics {floor:.3g} {unit}{alone}."
        )
    if found.verdict == "unknown":
        text = (
            f"Something is missing, and no known effect has earned its name: the validation error is {before:.3g} "
            f"{unit}, the floor {floor:.3g} {unit}{alone}."
        )
        if found.paying:
            what = "A curve" if len(found.free_form) == len(found.paying) else "What lowers it"
            part = 100 * max(0.0, found.explained)
            text += f" {what}, {', '.join(found.paying)}, explains {part:.0f} % of what lies between."
        return " ".join([text, *hint_sentences(found.hints, problem.joint_names)])
    what = "all of it" if found.free_form else "it"
    far = found.outcome.far(found.data.floor).tolist()
    percent = f"{100 * found.explained:.0f}"
    percent = "over 99" if any(far) and percent == "100" else percent
    summary = (
        f"{_missing(found)} On held-out recordings {what} explains {percent} % of what lies above the floor "
        f"({floor:.3g} {unit})."
    )
    if any(far) and not found.free_form:
        where = conjoined(name for name, is_far in zip(problem.joint_names, far, strict=True) if is_far)
        summary += f" Something else is missing on {where} too, which no known effect explains."
    return " ".join([summary, *hint_sentences(found.hints, problem.joint_names)])


def hint_sentences(hints: Sequence[Hint], joint_names: Sequence[str]) -> list[str]:
    """What comes nearest on joints where no effect has earned its name, and what speaks against it."""
    return [
        f"Nearest to it on {joint_names[hint.joint]} is {hint.effect}, but {' and '.join(hint.doubts)}."
        for hint in hints
    ]


def _missing(found: Findings) -> str:
    """The effects found; where there are several, what is due to each, and whether one of them stands out."""
    if found.free_form:
        return (
            f"Missing: {', '.join(found.added)}. On other joints no known effect explains the error; a curve takes its "
            f"place: {', '.join(found.free_form)}."
        )
    if len(found.added) < 2:
        return f"Missing: {found.added[0]}."
    parts = [f"{label} ({percent_text(s)} %)" for label, s in zip(found.added, found.shares.values(), strict=True)]
    if max(found.shares.values()) >= found.outcome.cfg.verdict.most:
        return f"Missing: {', '.join(parts)}."
    return f"Missing: several effects, none of which dominates: {', '.join(parts)}."


def percent_text(share: float) -> str:
    """A share in percent; one that is small beside another is not nothing."""
    percent = 100 * share
    if abs(percent) < _LEAST_TOLD:
        return f"below {_LEAST_TOLD}"
    return f"{percent:.0f}" if round(percent) else f"{percent:.1g}"


def ladder(found: Findings) -> list[dict[str, Any]]:
    """Validation RMSE of all joints from the base model to the last effect [rad]."""
    steps = [("base model", found.outcome.base_errors)]
    if found.paying:
        steps.append((" + ".join(found.paying), found.outcome.final_errors))
    return [{"model": model, "validation_rmse": float(errors.mse.mean().sqrt())} for model, errors in steps]


def by_joint(found: Findings, problem: Problem) -> dict[str, dict[str, Any]]:
    """Of each joint its errors, floor and effects."""
    outcome, model = found.outcome, found.outcome.final.model
    return {
        name: {
            "type": problem.joint_types[j],
            "validation_rmse_before": float(outcome.base_errors.mse[j].sqrt()),
            "validation_rmse_after": float(outcome.final_errors.mse[j].sqrt()),
            "floor": float(found.data.floor[j]),
            "effects": [e.name for e, has in zip(model.effects, model.has, strict=True) if bool(has[j])],
        }
        for j, name in enumerate(problem.joint_names)
    }
