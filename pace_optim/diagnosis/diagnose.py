"""A diagnosis from a run's folder to ``diagnosis.json``, and to a fit of the robot with what was found."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from pace_actuators.effects import EffectCfg
from pace_actuators.files import json_text, write_together
from pace_optim.diagnosis.candidates.library import candidate_effects
from pace_optim.diagnosis.findings.findings import Findings, as_refitted, told, with_refit
from pace_optim.diagnosis.findings.result import FILE, Diagnosis
from pace_optim.diagnosis.method import search_effects
from pace_optim.diagnosis.selection.decisions import FILE as DECISIONS
from pace_optim.diagnosis.selection.decisions import Decision, as_lines
from pace_optim.diagnosis.settings import DiagnosisSettings
from pace_optim.diagnosis.wrong_links import LinkFindings, find_wrong_links
from pace_optim.identification.fit import fit
from pace_optim.joints.fits.fits import fits_on
from pace_optim.joints.fits.model import labels, whole_values
from pace_optim.problem.problem import Problem
from pace_optim.problem.unknown_facts import started_from
from pace_optim.report import check_folder, report_text
from pace_optim.run.open import Run
from pace_optim.run.result import FitResult
from pace_optim.terminal.choices import UNKNOWN_FACTS
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
        on_verdict: Gets the diagnosis where a fit of the robot with what was found follows, before it. An interruption
            ends that fit and nothing else.

    Raises:
        ValueError: If the run cannot be read, or anything does not fit; nothing has been written then.
    """
    begin = time.monotonic()
    progress = progress or ProgressLine()
    progress.wait_for("reading the run and its recordings")
    run = Run.open(settings.run, settings.task)
    folder = run.folder
    check_folder(folder, anew=FILE)
    result = FitResult.load(folder)
    candidate_effects(settings.effects, only=settings.only)  # before the work: complains about names
    fits = fits_on(settings.device, settings.cfg.fitting)
    physics_dt = settings.physics_dt or min(result.physics_dt, 0.5 * result.control_dt)
    whole = run.problem(physics_dt=physics_dt).with_links(result.links)
    values = {name: result.parameters[name] for name in whole.space.slices}
    wrong = LinkFindings()
    if settings.links and not whole.joints_stand_alone:  # there an effect on the joint says the same
        wrong = find_wrong_links(whole, whole.space.from_dict(values), progress.say, cfg=settings.cfg)
    problem = whole.as_found(result.parameters, result.undetermined)
    problem = problem.with_effects(()).with_links(wrong.links).on_positions()
    base = {name: (wrong.values or values)[name] for name in problem.space.slices}
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
        own=_own_effects(problem, result),
        measured=settings.measured,
        log=decisions.append,
        cfg=settings.cfg,
        fits=fits,
    )
    diagnosis = told(found, fits, wrong, problem, result, run.settings, folder, candidates)
    diagnosis = replace(diagnosis, wall_time_s=time.monotonic() - begin)
    _save(diagnosis, decisions)
    progress.close()
    explains = found.verdict == "effect" or bool(found.free_form)
    refit = explains if settings.refit is None else settings.refit
    refit = refit or (bool(wrong.wrong) and settings.refit is None)
    fitted_with = [None if settings.refit is False else found.on_trial, found if refit else None]
    to_fit = [each for each in fitted_with if each is not None and (each.paying or wrong.wrong)]
    if to_fit:
        on_verdict(diagnosis)
    for tried in to_fit:
        if (path := _refit(tried, wrong, problem, run, diagnosis, progress)) is None:
            break
        fitted = FitResult.load(path)
        if not _stands(tried, found, result, fitted):
            continue
        if tried is not found:
            diagnosis = told(tried, fits, wrong, problem, result, run.settings, folder, candidates)
        diagnosis = with_refit(diagnosis, tried, wrong, problem, result, fitted, path)
        diagnosis = replace(diagnosis, wall_time_s=time.monotonic() - begin)
        _save(diagnosis, decisions)
        break
    return diagnosis


def _stands(tried: Findings, found: Findings, run: FitResult, refit: FitResult) -> bool:
    """Whether a fit of the whole robot is the diagnosis' own: of hints on trial, if one has become a name."""
    return tried is found or bool(as_refitted(tried, run, refit).named.keys() - found.named.keys())


def _own_effects(problem: Problem, result: FitResult) -> list[EffectCfg]:
    """The run's effects with its values, except those for unknown facts: the problem has these."""
    found = {UNKNOWN_FACTS[fact] for fact in problem.unknown}
    cfgs = [EffectCfg.parse(effect) for effect in result.effects]
    return [
        replace(cfg, values={p.name: _by_joint(result, cfg, p.name) for p in cfg.effect_class.parameters})
        for cfg in cfgs
        if cfg.effect_class.name not in found
    ]


def _by_joint(result: FitResult, cfg: EffectCfg, parameter: str) -> dict[str, float]:
    """A run's values of an effect's parameter, by joint."""
    own = result.parameters[f"{cfg.effect_class.name}.{parameter}"]
    return {joint: own[joint] if joint in own else own["all"] for joint in cfg.joints(result.joint_names)}


def _save(diagnosis: Diagnosis, decisions: Sequence[Decision]) -> None:
    """Write the diagnosis, its decisions, and the report of each of its runs, all or nothing."""
    files: dict[Path, bytes] = {Path(diagnosis.run) / DECISIONS: as_lines(decisions)}
    for run in map(Path, diagnosis.runs):
        files[run / FILE] = json_text(asdict(diagnosis))
        files[run / "report.html"] = report_text(run, {FILE: asdict(diagnosis)})
    write_together(files)


def _refit(
    found: Findings, wrong: LinkFindings, problem: Problem, run: Run, diagnosis: Diagnosis, progress: ProgressLine
) -> Path | None:
    """Fit the whole robot with what was found, from where the search ended; returns the new run's folder.

    ``None`` if the user breaks it off: the new folder keeps what it needs to go on, and the diagnosis.
    """
    progress.say(f"fitting the whole robot with {', '.join([*(each.link for each in wrong.wrong), *found.paying])}")
    final, before = found.outcome.final, FitResult.load(run.folder)
    links = {name: dict(before.parameters[name]) for name in (*before.link_parameters, *before.sensor_parameters)}
    for each in wrong.wrong:
        for value in each.values:
            links.setdefault(value["parameter"], {})[each.link] = value["found"]
    settings = replace(
        run.settings,
        effects=labels(final.model, problem.joint_names),
        links=[*run.settings.links, *(each.label for each in wrong.wrong)],
        optimizer="least_squares",
        physics_dt=problem.physics_dt,
        start=started_from(
            whole_values(final.model, final.x, problem.joint_names) | links, before.parameters, problem.unknown
        ),
        check_consistency=False,  # the run has done it
        instead_of=None,
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
        how = f": {command('fit')} --resume {shlex.quote(str(begun[0]))} goes on with it" if begun else ""
        progress.close()
        progress.say(f"the fit of the whole robot was broken off{how}; the diagnosis stands")
        progress.close()
        return None
    progress.close()
    return path
