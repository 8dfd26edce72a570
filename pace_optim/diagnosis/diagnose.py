"""A diagnosis from a run's folder to ``diagnosis.json``: look at the data, search, judge, refit, advise."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from pace_actuators.effects import Effect, available_effects, get_effect
from pace_actuators.files import json_text, write_together
from pace_optim.diagnosis.beginning.base_fit import fit_base
from pace_optim.diagnosis.beginning.data_check import FLOOR_MARGIN, DataCheck, check_data
from pace_optim.diagnosis.beginning.shared_delay import hold_late_joints
from pace_optim.diagnosis.candidates.screening import absorbed_effects
from pace_optim.diagnosis.fitting.denormals import flushed_denormals
from pace_optim.diagnosis.fitting.reference_update import OwnMotion
from pace_optim.diagnosis.judging.acceptance import check_long_enough
from pace_optim.diagnosis.model.labels import labels
from pace_optim.diagnosis.model.model import whole_values
from pace_optim.diagnosis.search.pooling import share
from pace_optim.diagnosis.search.search import Outcome, add_effects
from pace_optim.diagnosis.settings import DiagnosisSettings
from pace_optim.diagnosis.telling.advice import advise
from pace_optim.diagnosis.telling.result import FILE, Diagnosis
from pace_optim.diagnosis.verdict.contributions import DOMINANT, shares
from pace_optim.diagnosis.verdict.free_curves import Curves, error_map, fit_curves, take_curves
from pace_optim.diagnosis.verdict.proxy_effects import UNKNOWN_RATIO, curves_in, stand_ins, varying
from pace_optim.diagnosis.verdict.sizes import sizes
from pace_optim.diagnosis.verdict.verdict import explained_joints, keep_on, likes, ranking, verdict
from pace_optim.fit import fit
from pace_optim.problem.problem import Problem
from pace_optim.report import check_folder, report_text
from pace_optim.run.open import Run
from pace_optim.run.result import FitResult
from pace_optim.terminal.cli import command
from pace_optim.terminal.progress import ProgressLine


@dataclass(kw_only=True, eq=False)
class Findings:
    """What the search on the twins found."""

    outcome: Outcome
    data: DataCheck
    absorbed: dict[type[Effect], torch.Tensor]
    """Effects that a base parameter takes up, and on which joints (n,): these recordings would not show them there."""
    verdict: str
    explained: float
    """Part of the error above the floor that the effects found explain."""
    paying: list[str]
    """Effects of the final model, as ``fit.py --effects`` takes them, the largest share first: with the verdict
    ``unknown`` all that lower the error, though they are not what is missing."""
    shares: dict[type[Effect], float]
    """How much of what they explain is due to each, in the same order."""
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


def diagnose(
    settings: DiagnosisSettings,
    progress: ProgressLine | None = None,
    on_verdict: Callable[[Diagnosis], None] = lambda _: None,
) -> Diagnosis:
    """Find out which physical effect a run's model lacks; writes ``diagnosis.json`` into the run's folder.

    Args:
        settings: What to diagnose, and how.
        progress: Shows how far it is.
        on_verdict: Gets the diagnosis as soon as it is written, before the robot is fitted with what was found. An
            interruption ends that fit and nothing else.

    Raises:
        ValueError: If the run cannot be read, or anything does not fit; nothing has been written then.
    """
    begin = time.monotonic()
    progress = progress or ProgressLine()
    run = Run.open(settings.run, settings.task)
    folder = run.folder
    check_folder(folder, anew=FILE)
    result = FitResult.load(folder)
    candidates = candidate_effects(settings.effects, only=settings.only)
    physics_dt = settings.physics_dt or min(result.physics_dt, 0.5 * result.control_dt)
    problem = run.problem(physics_dt=physics_dt, effects=())
    base = {name: result.parameters[name] for name in problem.space.slices}
    found = search_effects(
        problem, problem.space.from_dict(base), candidates, settings.max_effects, progress.say, result
    )
    if result.effects:
        found.data.sentences.append(
            f"The run has {', '.join(result.effects)}: the search started from the base model, and looked for it again."
        )
    found.data.sentences += _other_error(found, problem, result)
    diagnosis = Diagnosis(
        run=str(folder),
        verdict=found.verdict,
        summary=summary_of(found, problem),
        explained=found.explained,
        added=found.added,
        paying=found.paying,
        shares={effect.name: share for effect, share in found.shares.items()},
        free_form=found.free_form,
        ranking=ranking(found.outcome, problem.joint_names, found.verdict, list(found.shares)),
        sizes=sizes(found.outcome, problem.joint_names),
        likes=likes(found.outcome),
        joints=_joints(found, problem),
        data=found.data.sentences,
        absorbed={effect.name: effect.absorbed_by for effect in found.absorbed},
        advice=advise(problem, found.outcome, found.verdict, found.data, found.absorbed),
        runs=[str(folder)],
        tried=[effect.name for effect in candidates],
        physics_dt=physics_dt,
        ladder=_ladder(found),
        error_map=error_map(found.curves, problem.joint_names, found.outcome.base_errors),
        wall_time_s=time.monotonic() - begin,
    )
    _save(diagnosis)
    progress.close()
    on_verdict(diagnosis)
    explains = found.verdict == "effect" or bool(found.free_form)
    refit = explains if settings.refit is None else settings.refit
    if refit and found.paying and (path := _refit(found, problem, run, diagnosis, progress)) is not None:
        diagnosis = replace(diagnosis, runs=[str(folder), str(path)], wall_time_s=time.monotonic() - begin)
        _save(diagnosis)
    return diagnosis


def _save(diagnosis: Diagnosis) -> None:
    """Write the diagnosis and the report of each of its runs, all or nothing."""
    files: dict[Path, bytes] = {}
    for run in map(Path, diagnosis.runs):
        files[run / FILE] = json_text(asdict(diagnosis))
        files[run / "report.html"] = report_text(run, {FILE: asdict(diagnosis)})
    write_together(files)


def _other_error(found: Findings, problem: Problem, run: FitResult) -> list[str]:
    """Why the run tells another error of the same model, where it does."""
    own, here = run.rmse["validation"].get("all"), float(found.outcome.base_errors.mse.mean().sqrt())
    if own is None or run.effects or f"{1e3 * own:.3g}" == f"{1e3 * here:.3g}":
        return []
    ways = []
    if not math.isclose(run.physics_dt, problem.physics_dt):
        ways.append(f"the physics step is {1e3 * problem.physics_dt:g} instead of {1e3 * run.physics_dt:g} ms")
    ways.append("each joint is simulated alone with a delay of its own, in blocks of up to one second")
    return [
        f"The run's own validation error of the base model is {1e3 * own:.3g} mrad, here it is {1e3 * here:.3g} mrad: "
        f"{', and '.join(ways)}."
    ]


def _refit(found: Findings, problem: Problem, run: Run, diagnosis: Diagnosis, progress: ProgressLine) -> Path | None:
    """Fit the whole robot with what was found, from where the search ended; returns the new run's folder.

    ``None`` if the user breaks it off: the new folder keeps what it needs to go on, and the diagnosis.
    """
    progress.say(f"fitting the whole robot with {', '.join(found.paying)}")
    final = found.outcome.final
    settings = replace(
        run.settings,
        effects=found.paying,
        optimizer="least_squares",
        physics_dt=problem.physics_dt,
        start=whole_values(final.model, final.x, problem.joint_names),
        check_consistency=False,  # the run has done it
        log_dir=str(run.folder.absolute().parent.parent),
    )
    progress.restart()
    begun: list[Path] = []

    def keep(path: Path) -> None:
        diagnosis.save(path)
        begun.append(path)

    try:
        _, path = fit(settings, progress, before=run, on_start=keep, assess_interrupted=False)
    except KeyboardInterrupt:
        how = f": {command('fit')} --resume {begun[0]} goes on with it" if begun else ""
        progress.close()
        progress.say(f"the fit of the whole robot was broken off{how}; the diagnosis above stands")
        return None
    progress.close()
    return path


def candidate_effects(extra: Sequence[str] = (), *, only: bool = False) -> list[type[Effect]]:
    """What is tried: all registered effects but curves of any form and special cases, and the user's; or only those.

    Raises:
        ValueError: If the user names a curve.
    """
    own = [get_effect(name) for name in extra]
    curves = [name for name, effect in zip(extra, own, strict=True) if effect.free_form]
    if curves:
        raise ValueError(
            f"{curves[0]} is a curve of any form: a diagnosis holds it against the effects that it finds without being "
            f"told to. Leave it out, or fit it: scripts/fit.py --effects {curves[0]}."
        )
    every = [] if only else [get_effect(name) for name in available_effects()]
    return list(dict.fromkeys([*(e for e in every if not e.free_form and not e.special_case_of), *own]))


@flushed_denormals()
def search_effects(
    problem: Problem,
    physical: torch.Tensor,
    candidates: Sequence[type[Effect]],
    max_effects: int,
    say: Callable[[str], None] = lambda _: None,
    run: FitResult | None = None,
) -> Findings:
    """Look for missing effects, each joint simulated alone.

    Args:
        problem: The whole robot with the base model.
        physical: A first guess of its parameters, (size,).
        candidates: What is tried.
        max_effects: Most effects of a joint.
        say: Shows how far it is.
        run: The whole robot's own fit, if there is one.

    Raises:
        ValueError: If the validation recordings are too short to judge by.
    """
    check_long_enough(problem.dataset.validation, problem.control_dt)
    twins, base, effort = fit_base(problem, physical, candidates, say)
    data = check_data(problem, twins, base, run)
    base, sentences = hold_late_joints(twins, base)
    data.sentences += sentences
    absorbed = absorbed_effects(twins.with_physics_dt(twins.coarsest_dt), base, candidates, effort)
    base.model = replace(base.model, barred=absorbed)

    floor = FLOOR_MARGIN * data.floor
    follow = OwnMotion(problem=problem, candidates=candidates, enough=floor, say=say).follow
    outcome = add_effects(twins, base, candidates, effort, floor, max_effects, say, follow)
    share(outcome)
    if (curves := fit_curves(outcome, data.floor, say)) is not None:
        take_curves(outcome, curves)
    decision, explained = verdict(outcome, data.floor)
    if decision != "unknown":
        with_curve = curves_in(outcome.final.model).any(dim=0)
        keep_on(outcome, with_curve | (explained_joints(outcome, data.floor) & (decision == "effect")))
        _, explained = verdict(outcome, data.floor)
    each = shares(outcome)
    return Findings(
        outcome=outcome,
        data=data,
        absorbed=absorbed,
        verdict=decision,
        explained=explained,
        paying=labels(outcome.final.model, problem.joint_names, list(each)),
        shares=each,
        curves=curves,
    )


def summary_of(found: Findings, problem: Problem) -> str:
    """The verdict in a sentence or two."""
    before = 1e3 * float(found.outcome.base_errors.mse.mean().sqrt())
    after = 1e3 * float(found.outcome.final_errors.mse.mean().sqrt())
    floor = 1e3 * float(found.data.floor.square().mean().sqrt())
    about = (found.outcome, problem.joint_names, found.data.floor)
    if found.verdict == "nothing_missing":
        return (
            f"Nothing is missing that these recordings could show: the validation error is {before:.3g} mrad, the "
            f"floor of noise and numerics {floor:.3g} mrad."
        )
    if found.verdict == "unknown":
        text = (
            f"Something is missing, and none of the known effects explains it: the validation error is {before:.3g} "
            f"mrad, the floor {floor:.3g} mrad, and {_what_pays(found)} {100 * max(0.0, found.explained):.0f} % of "
            "what lies between."
        )
        return " ".join([text, *stand_ins(*about), *varying(*about)])
    all_of_it = "all of it" if found.free_form else "it"
    summary = (
        f"{_missing(found)} With {all_of_it} the validation error falls from {before:.3g} to {after:.3g} mrad "
        f"(floor {floor:.3g} mrad); it explains {100 * found.explained:.0f} % of what lies above the floor."
    )
    if after > UNKNOWN_RATIO * floor and not found.free_form:
        summary += " Something else is missing too, which no known effect explains."
    return " ".join([summary, *varying(*about)])


def _what_pays(found: Findings) -> str:
    """What lowers the error without being what is missing."""
    if not found.paying:
        return "the effects tried explain"
    if len(found.free_form) == len(found.paying):
        return f"a curve in its place, {', '.join(found.paying)}, explains"
    curves = ", with a curve where none is known" if found.free_form else ""
    return f"what pays{curves}, {', '.join(found.paying)}, explains"


def _missing(found: Findings) -> str:
    """The effects found; where there are several, what is due to each, and whether one of them stands out."""
    if found.free_form:
        return (
            f"Missing: {', '.join(found.added)}. On other joints no known effect explains the error; a curve takes its "
            f"place: {', '.join(found.free_form)}."
        )
    if len(found.added) < 2:
        return f"Missing: {found.added[0]}."
    parts = [f"{label} ({100 * s:.0f} %)" for label, s in zip(found.added, found.shares.values(), strict=True)]
    if max(found.shares.values()) >= DOMINANT:
        return f"Missing: {', '.join(parts)}."
    return f"Missing: several effects, none of which dominates: {', '.join(parts)}."


def _ladder(found: Findings) -> list[dict]:
    steps = [("base model", found.outcome.base_errors)]
    if found.paying:
        steps.append((" + ".join(found.paying), found.outcome.final_errors))
    return [{"model": model, "validation_rmse": float(errors.mse.mean().sqrt())} for model, errors in steps]


def _joints(found: Findings, problem: Problem) -> dict[str, dict]:
    outcome, model = found.outcome, found.outcome.final.model
    return {
        name: {
            "validation_rmse_before": float(outcome.base_errors.mse[j].sqrt()),
            "validation_rmse_after": float(outcome.final_errors.mse[j].sqrt()),
            "floor": float(found.data.floor[j]),
            "effects": [e.name for e, has in zip(model.effects, model.has, strict=True) if bool(has[j])],
        }
        for j, name in enumerate(problem.joint_names)
    }
