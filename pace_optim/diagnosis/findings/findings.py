"""What a diagnosis found, in words and tables."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from pace_actuators.drive_result import ALL
from pace_actuators.effects import Effect, EffectCfg, get_effect
from pace_actuators.files import json_text
from pace_actuators.joint_units import units_for
from pace_actuators.text import conjoined, percent, size_text
from pace_optim.diagnosis.checks.data_check import DataCheck
from pace_optim.diagnosis.findings.advice import advise
from pace_optim.diagnosis.findings.result import Diagnosis
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.selection.naming import DIFFERS
from pace_optim.diagnosis.verdict.free_curves import Curves, error_map
from pace_optim.diagnosis.verdict.names import Hint, new_effects
from pace_optim.diagnosis.verdict.refit import Evidences, judged_again, on_whole_robot
from pace_optim.diagnosis.verdict.sizes import size_of, sizes, without_error_bars
from pace_optim.diagnosis.verdict.verdict import likes, part_explained, ranking, restricted, verdict
from pace_optim.diagnosis.wrong_links import LinkFindings
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.model import JointModel, labels
from pace_optim.problem.problem import Problem
from pace_optim.run.result import FitResult
from pace_optim.run.settings import FitSettings, command_line


@dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """What the search on the twins found, or what stands of it once the whole robot is fitted."""

    outcome: Outcome
    data: DataCheck
    absorbed: dict[type[Effect], torch.Tensor]
    """Effects that a base parameter absorbs, and on which joints (n,): these recordings would not show them there."""
    verdict: str
    joint_names: Sequence[str]
    explained: float
    """Part of the error above the floor that the effects found explain."""
    shares: dict[type[Effect], float]
    """How much of what the effects found explain is due to each, the largest first."""
    named: Evidences = field(default_factory=dict)
    """Effects that are what is missing, on each joint with the evidence of that joint."""
    trained: torch.Tensor | None = None
    """Training RMSE of each joint in the whole robot's fit, (n,) [rad]; ``None``: each joint was simulated alone."""
    hints: Sequence[Hint] = ()
    """Effects that lower the error of joints and have not earned their names."""
    curves: Curves | None = None
    """Which variable carries what is missing; ``None`` where the effects found leave little."""
    on_trial: Findings | None = None
    """The same with the hinted effects as if they were named: the fit of the whole robot may show that they are. Joints
    that move each other, each simulated alone beside others that are still wrong, may not."""

    @property
    def refitted(self) -> bool:
        """Whether errors and sizes are those of the whole robot's fit."""
        return self.trained is not None

    @property
    def paying(self) -> list[str]:
        """Effects of the final model, as ``fit.py --effects`` takes them, the largest share first.

        With the verdict ``unknown`` all that lower the error, though they are not what is missing.
        """
        return self._labels(self.outcome.final.model, self.shares)

    @property
    def free_form(self) -> list[str]:
        """Those of them that are curves, where an effect is not known."""
        names = {e.name for e in self.shares if e.free_form}
        return [label for label in self.paying if label.partition("@")[0] in names]

    @property
    def model(self) -> JointModel:
        """The final model; where effects are named, without the others that were found."""
        model, others = self.outcome.final.model, new_effects(self.outcome, self.outcome.final.model)
        if not self.named:
            return model
        for effect, j in self.named:
            others[model.effects.index(effect), j] = False
        return replace(model, has=model.has & ~others)

    @property
    def shares_named(self) -> dict[type[Effect], float]:
        """The shares of those that are what is missing."""
        named = {effect for effect, _ in self.named}
        return {effect: share for effect, share in self.shares.items() if effect in named}

    @property
    def added(self) -> list[str]:
        """Those that are what is missing, as ``fit.py --effects`` takes them."""
        return self._labels(self.model, self.shares_named)

    def _labels(self, model: JointModel, effects: Iterable[type[Effect]]) -> list[str]:
        order = list(effects)
        return labels(model, self.joint_names, order) if order else []


def told(
    found: Findings,
    fits: Fits,
    wrong: LinkFindings,
    problem: Problem,
    run: FitResult,
    settings: FitSettings,
    folder: Path,
    candidates: Sequence[type[Effect]],
) -> Diagnosis:
    """What was found, as ``diagnosis.json`` has it; effects were sought beside links that the file states wrongly."""
    cfg = found.outcome.cfg
    return Diagnosis(
        run=str(folder),
        **_judged(found, wrong, problem),
        links=[asdict(each) | {"label": each.label} for each in wrong.wrong],
        paying=found.paying,
        shares={effect.name: share for effect, share in found.shares.items()},
        free_form=found.free_form,
        sizes=sizes(fits, found.outcome, found.data.floor, problem.joint_names),
        likes=likes(found.outcome),
        data=[*_about_links(wrong, problem), *found.data.sentences, *_about_run(found, problem, run)],
        absorbed={effect.name: effect.absorbed_by for effect in found.absorbed},
        advice=[
            *to_try(found, run, settings.to_dict()),
            *advise(problem, found.outcome, found.verdict, found.data, found.absorbed),
        ],
        runs=[str(folder)],
        tried=[e.name for e in candidates if bool(found.outcome.base.model.allowed_joints(e).any())],
        physics_dt=problem.physics_dt,
        error_map=error_map(
            found.curves,
            problem.joint_names,
            found.outcome.base_errors,
            joint_types=problem.joint_types,
            cfg=cfg.judging,
        ),
        cfg=json.loads(json_text(asdict(cfg))),
    )


def with_refit(
    diagnosis: Diagnosis,
    found: Findings,
    wrong: LinkFindings,
    problem: Problem,
    run: FitResult,
    refit: FitResult,
    folder: Path,
) -> Diagnosis:
    """The same, judged again by the whole robot's fit with what was found.

    Args:
        diagnosis: Of joints that are simulated alone.
        found: What the search found, on those joints.
        wrong: Links that the model file states wrongly.
        problem: The whole robot.
        run: What was diagnosed.
        refit: The whole robot with what was found.
        folder: Of the refit.
    """
    names, paths = problem.joint_names, [diagnosis.run, str(folder)]
    found = as_refitted(found, run, refit)
    before, after = (each.rmse["validation"][ALL] for each in (run, refit))
    judged = _judged(found, wrong, problem)
    fall = (
        f"With {conjoined([*(each.link for each in wrong.wrong), *found.paying])} the whole robot's validation error "
        f"falls from {1e3 * before:.3g} to {1e3 * after:.3g} {units_for('mrad', run.joint_types)}."
    )
    steps = zip(judged["ladder"], (before, after), paths, strict=True)
    ladder_of_runs = [step | {"validation_rmse": rmse, "run": path} for step, rmse, path in steps]
    unsure = without_error_bars(found.outcome, found.data.floor).tolist()
    curves = {joint: own for by_joint in refit.curves.values() for joint, own in by_joint.items()}
    return replace(
        diagnosis,
        **judged | {"evidence": [*judged["evidence"], fall], "ladder": ladder_of_runs},
        sizes=[_as_refitted(size, refit, unsure[names.index(size["joint"])]) for size in diagnosis.sizes],
        error_map={
            joint: each | ({"curve": {key: curves[joint][key] for key in ("at", "torque")}} if joint in curves else {})
            for joint, each in diagnosis.error_map.items()
        },
        runs=paths,
    )


def as_refitted(found: Findings, run: FitResult, refit: FitResult) -> Findings:
    """What stands once the whole robot is fitted with it: the same rules, with that fit's errors and sizes."""
    floor, names = found.data.floor, found.joint_names
    outcome = on_whole_robot(found.outcome, names, run, refit)
    named, hints = judged_again(outcome, floor, found.named, names, refit)
    with_name, with_hint, before = (
        torch.tensor([j in joints for j in range(len(names))])
        for joints in ({j for _, j in named}, {each.joint for each in hints}, {j for _, j in found.named})
    )
    needs_none = before & ~with_name & ~with_hint
    return replace(
        found,
        outcome=outcome,
        named=named,
        hints=[*found.hints, *hints],
        verdict=verdict(restricted(outcome, ~needs_none), floor, with_name)[0],
        explained=part_explained(outcome, floor),
        trained=torch.tensor([refit.rmse["train"][name] for name in names], dtype=torch.float64),
    )


def _judged(found: Findings, wrong: LinkFindings, problem: Problem) -> dict[str, Any]:
    """The fields of a diagnosis that its last fit decides."""
    only_links = bool(wrong.wrong) and found.verdict == "nothing_missing"
    said = [each.sentence for each in wrong.wrong]
    outcome = replace(found.outcome, final=replace(found.outcome.final, model=found.model))
    return {
        "verdict": "link" if only_links else found.verdict,
        "summary": " ".join([*said, *([] if only_links else [verdict_of(found, problem)])]),
        "evidence": [] if only_links else evidence_of(found, problem),
        "more": more_missing(found, problem),
        "explained": found.explained,
        "added": found.added,
        "hints": [asdict(hint) | {"joint": problem.joint_names[hint.joint]} for hint in found.hints],
        "joints": by_joint(found, problem),
        "ladder": ladder(found, wrong),
        "ranking": ranking(
            outcome, problem.joint_names, found.verdict, list(found.shares), joint_types=problem.joint_types
        ),
    }


def _about_links(wrong: LinkFindings, problem: Problem) -> list[str]:
    """By how much the error falls with the links that the model file states wrongly."""
    if not wrong.wrong:
        return wrong.sentences
    return [
        f"With {conjoined(each.label for each in wrong.wrong)} the validation error falls from "
        f"{1e3 * wrong.before:.3g} to {1e3 * wrong.after:.3g} {units_for('mrad', problem.joint_types)} at the "
        "diagnosis' physics step."
    ]


def _as_refitted(size: dict[str, Any], refit: FitResult, unsure: bool) -> dict[str, Any]:
    """The size of an effect as the refit of the whole robot has it; where that is ``unsure`` without error bar."""
    name, joint = f"{size['effect']}.{size['parameter']}", size["joint"]
    values = refit.parameters.get(name, {})
    if (key := joint if joint in values else ALL) not in values:
        return size
    effect = get_effect(size["effect"])
    (parameter,) = (each for each in effect.parameters if each.name == size["parameter"])
    std = None if refit.std_means_nothing or unsure else refit.std[name][key]
    at_bound = f"{name}/{key}" in refit.at_bound
    return size | size_of(effect, parameter, values[key], std, refit.joint_type(joint), at_bound)


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


def verdict_of(found: Findings, problem: Problem) -> str:
    """What is missing, and where more is, in a sentence or two."""
    if found.verdict == "nothing_missing":
        return "Nothing is missing that these recordings could show."
    none = "Something is missing, and no known effect has earned its name."
    said = [_missing(found) if found.verdict == "effect" else none]
    if more := more_missing(found, problem):
        said.append(f"More is missing on {conjoined(f'{joint} ({left})' for joint, left in more.items())}.")
    return " ".join(said)


def evidence_of(found: Findings, problem: Problem) -> list[str]:
    """The errors behind the verdict, and what comes nearest where no effect has earned its name."""
    unit = units_for("mrad", problem.joint_types)
    before = 1e3 * float(found.outcome.base_errors.mse.mean().sqrt())
    alone = "" if len(problem.joint_names) == 1 or found.refitted else ", with each joint simulated alone"
    floor = 1e3 * float(found.data.floor.square().mean().sqrt())
    explained, hints = percent(max(0.0, found.explained)), hint_sentences(found.hints, problem.joint_names)
    if found.verdict == "effect":
        what = "all of it" if found.free_form else "it"
        return [
            f"On held-out recordings {what} explains {explained} of what lies above the floor ({floor:.3g} {unit}).",
            *hints,
        ]
    said = [f"The validation error is {before:.3g} {unit}, the floor of noise and numerics {floor:.3g} {unit}{alone}."]
    if found.verdict == "unknown" and found.paying:
        what = "A curve" if len(found.free_form) == len(found.paying) else "What lowers it"
        said.append(f"{what}, {', '.join(found.paying)}, explains {explained} of what lies between.")
    return [*said, *(hints if found.verdict == "unknown" else [])]


def more_missing(found: Findings, problem: Problem) -> dict[str, str]:
    """Joints that end far from their floor in validation or in training, with what is left: "0.54 mrad, 5 floors"."""
    result, far = {}, found.outcome.cfg.judging.far
    parts = [("", found.outcome.final_errors.mse.sqrt())]
    parts += [] if found.trained is None else [(" in training", found.trained)]
    for j, (name, floor) in enumerate(zip(problem.joint_names, found.data.floor.tolist(), strict=True)):
        for where, rmse in parts:
            if name not in result and (left := float(rmse[j])) > far * floor:
                unit = units_for("mrad", [problem.joint_types[j]])
                result[name] = f"{1e3 * left:.3g} {unit}{where}, {left / floor:.2g} floors"
    return result


def hint_sentences(hints: Sequence[Hint], joint_names: Sequence[str]) -> list[str]:
    """What comes nearest on joints where no effect has earned its name, how large, and what speaks against it."""
    said = []
    for hint in hints:
        sizes = ", ".join(f"{size['parameter']} {size_text(size)}" for size in hint.sizes)
        apart = [
            f"{size['parameter']} {size['apart'][0]:.3g} to {size['apart'][1]:.3g} {size['unit']}".removesuffix(" 1")
            for size in hint.sizes
            if size["apart"]
        ]
        doubts = [f"{d} ({', '.join(apart)})" if d == DIFFERS and apart else d for d in hint.doubts]
        what = f"{hint.effect} ({sizes})" if sizes else hint.effect
        part = f" explains {percent(max(0.0, hint.explained))}"
        said.append(f"Hint on {joint_names[hint.joint]}: {what}{part}. It is not named, as {' and '.join(doubts)}.")
    return said


def to_try(found: Findings, run: FitResult, settings: Mapping[str, Any]) -> list[str]:
    """The command that fits the whole robot with the hints too."""
    if not found.hints:
        return []
    joints = {
        effect.effect_class.name: list(effect.joints(found.joint_names))
        for effect in map(EffectCfg.parse, [*run.effects, *found.added])
    }
    for hint in found.hints:
        joints.setdefault(hint.effect, []).append(found.joint_names[hint.joint])
    effects = [
        EffectCfg(effect=name, joint_names_expr="|".join(own), shared=get_effect(name).shared).label
        for name, own in joints.items()
    ]
    return [f"To try the hints on the whole robot: {command_line({**settings, 'effects': effects, 'start': None})}"]


def _missing(found: Findings) -> str:
    """The effects found; where there are several, what is due to each, and whether one of them stands out."""
    if found.free_form:
        return f"Missing: {', '.join(found.added)}. Covered by a curve, without a name: {', '.join(found.free_form)}."
    if len(found.added) < 2:
        return f"Missing: {found.added[0]}."
    shares = found.shares_named.values()
    parts = [f"{label} ({percent(s)})" for label, s in zip(found.added, shares, strict=True)]
    if max(shares) >= found.outcome.cfg.verdict.most:
        return f"Missing: {', '.join(parts)}."
    return f"Missing: several effects, none of which dominates: {', '.join(parts)}."


def ladder(found: Findings, wrong: LinkFindings) -> list[dict[str, Any]]:
    """Validation RMSE of all joints from the base model to the last effect [rad]; links count in the whole robot."""
    steps = [("base model", found.outcome.base_errors)]
    if names := [*(each.link for each in wrong.wrong if found.refitted), *found.paying]:
        steps.append((" + ".join(names), found.outcome.final_errors))
    return [{"model": model, "validation_rmse": float(errors.mse.mean().sqrt())} for model, errors in steps]


def by_joint(found: Findings, problem: Problem) -> dict[str, dict[str, Any]]:
    """Of each joint its errors, floor and effects."""
    outcome, model = found.outcome, found.model
    return {
        name: {
            "type": problem.joint_types[j],
            "validation_rmse_before": float(outcome.base_errors.mse[j].sqrt()),
            "validation_rmse_after": float(outcome.final_errors.mse[j].sqrt()),
            "training_rmse": None if found.trained is None else float(found.trained[j]),
            "floor": float(found.data.floor[j]),
            "effects": [e.name for e, has in zip(model.effects, model.has, strict=True) if bool(has[j])],
        }
        for j, name in enumerate(problem.joint_names)
    }
