"""A diagnosis from a run's folder to ``diagnosis.json``: look at the data, search, judge, refit, advise."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch

from pace_actuators.effects import Effect, available_effects, get_effect
from pace_actuators.files import json_text, write_together
from pace_optim.diagnosis.beginning.data_check import check_data
from pace_optim.diagnosis.beginning.shared_delay import hold_late_joints
from pace_optim.diagnosis.candidates.screening import absorbed_effects
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg
from pace_optim.diagnosis.judging.decisions import FILE as DECISIONS
from pace_optim.diagnosis.judging.decisions import Decision, Log, as_lines, unlogged
from pace_optim.diagnosis.search.pooling import pool
from pace_optim.diagnosis.search.search import add_effects
from pace_optim.diagnosis.search.state import Search
from pace_optim.diagnosis.settings import DiagnosisSettings
from pace_optim.diagnosis.telling.advice import advise
from pace_optim.diagnosis.telling.findings import Findings, by_joint, ladder, summary_of
from pace_optim.diagnosis.telling.result import FILE, Diagnosis
from pace_optim.diagnosis.verdict.contributions import contributions
from pace_optim.diagnosis.verdict.free_curves import error_map, fit_curves, take_curves
from pace_optim.diagnosis.verdict.proxy_effects import curves_in
from pace_optim.diagnosis.verdict.sizes import sizes
from pace_optim.diagnosis.verdict.verdict import explained_joints, likes, ranking, restrict_to, verdict
from pace_optim.fit import fit
from pace_optim.problem.problem import Problem
from pace_optim.problem.unknown_facts import started_from
from pace_optim.report import check_folder, report_text
from pace_optim.run.open import Run
from pace_optim.run.result import FitResult
from pace_optim.single_joint_fits.base_fit import fit_base
from pace_optim.single_joint_fits.block_errors import check_long_enough
from pace_optim.single_joint_fits.denormals import flushed_denormals
from pace_optim.single_joint_fits.fits import Fits, fits_on
from pace_optim.single_joint_fits.labels import labels
from pace_optim.single_joint_fits.model import whole_values
from pace_optim.single_joint_fits.reference_update import ReferenceUpdate
from pace_optim.terminal.cli import command
from pace_optim.terminal.progress import ProgressLine


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
    candidate_effects(settings.effects, only=settings.only)  # before the work: complains about names
    fits = fits_on(settings.device, settings.cfg.fitting)
    physics_dt = settings.physics_dt or min(result.physics_dt, 0.5 * result.control_dt)
    problem = run.problem(physics_dt=physics_dt, effects=())
    base = {name: result.parameters[name] for name in problem.space.slices}
    off = any(r.torque_enable is not None and not r.torque_enable.all() for r in problem.dataset.recordings)
    candidates = candidate_effects(settings.effects, only=settings.only, switched_off=off)
    decisions: list[Decision] = []
    found = search_effects(
        problem,
        problem.space.from_dict(base),
        candidates,
        settings.max_effects,
        progress.say,
        result,
        log=decisions.append,
        cfg=settings.cfg,
        fits=fits,
    )
    diagnosis = _told(found, fits, settings.cfg, problem, result, folder, candidates)
    diagnosis = replace(diagnosis, wall_time_s=time.monotonic() - begin)
    _save(diagnosis, decisions)
    progress.close()
    on_verdict(diagnosis)
    explains = found.verdict == "effect" or bool(found.free_form)
    refit = explains if settings.refit is None else settings.refit
    if refit and found.paying and (path := _refit(found, problem, run, diagnosis, progress)) is not None:
        diagnosis = replace(diagnosis, runs=[str(folder), str(path)], wall_time_s=time.monotonic() - begin)
        _save(diagnosis, decisions)
    return diagnosis


def _told(
    found: Findings,
    fits: Fits,
    cfg: DiagnosisCfg,
    problem: Problem,
    run: FitResult,
    folder: Path,
    candidates: Sequence[type[Effect]],
) -> Diagnosis:
    """What was found, in the words and tables of ``diagnosis.json``."""
    return Diagnosis(
        run=str(folder),
        verdict=found.verdict,
        summary=summary_of(found, problem),
        explained=found.explained,
        added=found.added,
        paying=found.paying,
        shares={effect.name: share for effect, share in found.shares.items()},
        free_form=found.free_form,
        ranking=ranking(found.outcome, problem.joint_names, found.verdict, list(found.shares)),
        sizes=sizes(fits, found.outcome, problem.joint_names),
        likes=likes(found.outcome),
        joints=by_joint(found, problem),
        data=[*found.data.sentences, *_about_run(found, problem, run)],
        absorbed={effect.name: effect.absorbed_by for effect in found.absorbed},
        advice=advise(problem, found.outcome, found.verdict, found.data, found.absorbed),
        runs=[str(folder)],
        tried=[effect.name for effect in candidates],
        physics_dt=problem.physics_dt,
        ladder=ladder(found),
        error_map=error_map(found.curves, problem.joint_names, found.outcome.base_errors, cfg=cfg.verdict),
        cfg=json.loads(json_text(asdict(cfg))),
    )


def _save(diagnosis: Diagnosis, decisions: Sequence[Decision]) -> None:
    """Write the diagnosis, its decisions, and the report of each of its runs, all or nothing."""
    files: dict[Path, bytes] = {Path(diagnosis.run) / DECISIONS: as_lines(decisions)}
    for run in map(Path, diagnosis.runs):
        files[run / FILE] = json_text(asdict(diagnosis))
        files[run / "report.html"] = report_text(run, {FILE: asdict(diagnosis)})
    write_together(files)


def _about_run(found: Findings, problem: Problem, run: FitResult) -> list[str]:
    """What the run has, and why it tells another error of the same model, where it does."""
    if run.effects:
        return [
            f"The run has {', '.join(run.effects)}: the search started from the base model, and looked for it again."
        ]
    own, here = run.rmse["validation"].get("all"), float(found.outcome.base_errors.mse.mean().sqrt())
    if own is None or f"{1e3 * own:.3g}" == f"{1e3 * here:.3g}":
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
        start=started_from(
            whole_values(final.model, final.x, problem.joint_names),
            FitResult.load(run.folder).parameters,
            problem.unknown,
        ),
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


def candidate_effects(
    extra: Sequence[str] = (), *, only: bool = False, switched_off: bool = True
) -> list[type[Effect]]:
    """What is tried: all registered effects but curves of any form and special cases, and the user's; or only those.

    Args:
        extra: The user's.
        only: Whether only those are tried.
        switched_off: Whether a recording has its drives switched off, so that effects of that show.

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
    every = [effect for effect in every if switched_off or not effect.acts_while_off]
    return list(dict.fromkeys([*(e for e in every if not e.free_form and not e.special_case_of), *own]))


@flushed_denormals()
def search_effects(
    problem: Problem,
    physical: torch.Tensor,
    candidates: Sequence[type[Effect]],
    max_effects: int,
    say: Callable[[str], None] = lambda _: None,
    run: FitResult | None = None,
    *,
    log: Log = unlogged,
    cfg: DiagnosisCfg = DEFAULT,
    fits: Fits | None = None,
) -> Findings:
    """Look for missing effects, each joint simulated alone.

    Args:
        problem: The whole robot with the base model.
        physical: A first guess of its parameters, (size,).
        candidates: What is tried.
        max_effects: Most effects of a joint.
        say: Shows how far it is.
        run: The whole robot's own fit, if there is one.
        log: Gets every decision.
        cfg: By what numbers it is decided.
        fits: Fits models; ``None``: on the processor.

    Raises:
        ValueError: If the validation recordings are too short to judge by.
    """
    fits = fits or fits_on("cpu", cfg.fitting)
    check_long_enough(problem.dataset.validation, problem.control_dt, cfg.judging.fewest, cfg=cfg.fitting)
    twins, base, effort = fit_base(fits, problem, physical, candidates, say)
    data = check_data(fits, problem, twins, base, run, cfg=cfg.judging)
    if cfg.has("late_joints"):
        base, sentences = hold_late_joints(fits, twins, base, cfg=cfg)
        data = replace(data, sentences=[*data.sentences, *sentences])
    absorbed = absorbed_effects(
        fits, twins.with_physics_dt(twins.coarsest_dt), base, candidates, effort, cfg.candidates
    )
    base = replace(base, model=replace(base.model, barred=absorbed))

    search = Search(
        effects=candidates,
        effort=effort,
        floor=data.floor,
        max_effects=max_effects,
        fits=fits,
        cfg=cfg,
        say=say,
        log=log,
    )
    reference = ReferenceUpdate(fits=fits, problem=problem, candidates=candidates, enough=search.at_floor, say=say)
    outcome = add_effects(replace(search, follow=reference.follow), twins, base)
    if cfg.has("pool"):
        outcome = pool(fits, outcome, log)
    curves = fit_curves(fits, outcome, data.floor, say, log) if cfg.has("curves") else None
    if curves is not None:
        outcome = take_curves(outcome, curves)
    decision, explained = verdict(outcome, data.floor)
    if decision != "unknown":
        with_curve = curves_in(outcome.final.model).any(dim=0)
        known = explained_joints(outcome, data.floor) & (decision == "effect")
        outcome = restrict_to(outcome, with_curve | known)
        _, explained = verdict(outcome, data.floor)
    each = contributions(fits, outcome)
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
