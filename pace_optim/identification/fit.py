"""A fit from settings to a run's folder: load, search, refine, conclude, write; with torques where these decide."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from pace_actuators.effects import effect_modules
from pace_actuators.text import listed
from pace_envs.task_source import EnvironmentRecord
from pace_optim.estimate.own_objective import optimizer_modules, use_recorded_optimizer
from pace_optim.estimate.search import search
from pace_optim.identification.conclude import conclude, conclude_own
from pace_optim.identification.optimization import Optimization, with_structures
from pace_optim.identification.setup import load_for_fit, make_optimizer, make_searcher
from pace_optim.problem.recordings import tell_nobody, tell_on_stderr
from pace_optim.recording.torque import NoTorqueError
from pace_optim.report import check_folder, write_report
from pace_optim.run.folder import RunFolder
from pace_optim.run.open import (
    Run,
    check_same_configuration,
    check_unchanged,
    input_digests,
    recording_digests,
    with_absolute_paths,
)
from pace_optim.run.result import FitResult, assumptions
from pace_optim.run.settings import FitSettings
from pace_optim.run.tensors import read_bounds
from pace_optim.terminal.cli import command
from pace_optim.terminal.processes import Processes
from pace_optim.terminal.progress import ProgressLine

_NOTE = "note: "
_NOISY = 1.5
"""Times the noise above which a fit leaves something that torques may explain."""
_BETTER = 0.9
"""Part of the error that a fit by torques must leave at most, to be kept."""
_WHITE = 1.5
"""Times their own noise that is left of torques at most, where the fit's drives are theirs."""


def fit(
    settings: FitSettings,
    progress: ProgressLine | None = None,
    before: Run | None = None,
    on_start: Callable[[Path], None] = lambda _: None,
    assess_interrupted: bool = True,
    processes: Processes | None = None,
    tell: Callable[[str], None] = tell_on_stderr,
) -> tuple[FitResult, Path]:
    """Identify a robot.

    Args:
        settings: What to fit, and how; its task and effects are known (:func:`pace_envs.task_source.use_task`).
        before: The run whose robot is fitted anew, if there is one.
        on_start: Gets the run's folder before the first simulation.
        assess_interrupted: Whether an interrupted fit still assesses and writes the best so far; otherwise the
            interruption is passed on at once, and the folder has what ``resume`` needs.
        processes: Who shares the search's candidates; this one writes, the others call :func:`help_fit`.
        tell: Gets what is assumed and how the recordings are understood, each sentence once; not those of ``before``.

    Returns:
        The result and the run's folder.

    Raises:
        ValueError: If anything does not fit; nothing has been written then.
    """
    RunFolder.refuse_file(settings.log_dir)
    tell, shown = tell if before is None else tell_nobody, set[str]()

    def tell_while_reading(text: str) -> None:
        shown.add(text.strip().removeprefix(_NOTE))
        tell(text)

    problem = load_for_fit(settings, None if before is None else before.load_cfg(), tell_while_reading)
    for note in assumptions(problem, shown):
        tell(f"{_NOTE}{note}")
    if before is None and problem.logged_rate:
        settings = replace(settings, control_dt=problem.control_dt)
    settings = with_absolute_paths(settings, problem.plain_cfg)
    own_code = [*effect_modules(problem.effects), *optimizer_modules(settings.optimizer)]
    place = None if before is None else before.record.folder
    record = EnvironmentRecord.of(settings.task, problem.env_cfg, own_code, place)
    digests, inputs = recording_digests(settings), input_digests(settings, record)
    folder = RunFolder.create(settings.log_dir, problem.env_cfg.sim2real.robot_name)
    folder.write_start(settings.to_dict(), digests, problem, inputs=inputs, environment=record.to_dict())
    on_start(folder.path)
    run = Optimization(settings, problem, folder, progress or ProgressLine(), processes)
    return _finished(run, record, assess_interrupted)


def fit_with_torques(
    settings: FitSettings, progress: ProgressLine | None = None, processes: Processes | None = None
) -> tuple[FitResult, Path]:
    """Identify a robot; by its torques too, where facts of its drives depend on them and the fit is better so.

    A fit of positions comes first. If it ends at the noise, it is the result. Else, where facts were read from the
    torques or contradict these, another fit follows the torques beside the positions. It is kept if positions are
    followed better, and what is left of the torques is their own noise: a filtered torque is not the drive's. Facts
    that contradict it are then tried with the torques' values alone.

    Args:
        settings: As for :func:`fit`; so are the others.
        processes: Who shares the search's candidates; where there are several, only the first fit is made.
    """
    progress = progress or ProgressLine()
    result, folder = fit(settings, progress, processes=processes, tell=progress.tell)
    return _by_torques(result, folder, settings, progress, processes)


def _by_torques(
    first: FitResult,
    folder: Path,
    settings: FitSettings,
    progress: ProgressLine,
    processes: Processes | None,
    beside: bool = True,
) -> tuple[FitResult, Path]:
    """A fit of positions, or the better one by its torques: ``beside`` the positions, then by their values alone."""
    several = processes is not None and processes.count > 1
    depends = bool(first.contested or first.from_torques)
    if several or not depends or first.is_interrupted or (first.times_noise or 0.0) < _NOISY:
        return first, folder
    for facts, other in _attempts(first, folder, settings, beside):
        progress.tell(f"The fit is at {first.times_noise:.3g} times the noise: fitting with {facts}.")
        try:
            result, path = fit(other, progress, tell=tell_nobody)
        except NoTorqueError:
            continue
        if result.is_interrupted:
            progress.tell(f"The fit with {facts} was broken off: {command('fit')} --resume {shlex.quote(str(path))}.")
            return first, folder
        if _is_better(result, first, facts, progress):
            return result, path
    return first, folder


def _attempts(first: FitResult, folder: Path, settings: FitSettings, beside: bool) -> Iterator[tuple[str, FitSettings]]:
    """What is fitted by torques, in words and as settings."""
    unknown = [*settings.unknown, *(fact for fact in first.contested if fact not in settings.unknown)]
    other = replace(settings, unknown=unknown, instead_of=str(folder.absolute()))
    if beside and not settings.residual and not settings.only_searches:
        facts = listed([*first.contested, *first.from_torques])
        yield f"torques beside positions, as {facts} depend on them", replace(other, residual=["position", "effort"])
    if first.contested:
        yield f"{listed(first.contested)} by the torques, which contradict what is stated", other


def _is_better(result: FitResult, first: FitResult, facts: str, progress: ProgressLine) -> bool:
    """Whether a fit by torques replaces that of positions; a line states the reason."""
    before, after = (1e3 * each.rmse["train"]["all"] for each in (first, result))
    said = f"With {facts.split(',')[0]} the error is {after:.4g}, not {before:.4g} mrad"
    floors = result.torque_floor
    most = max((noise / max(floors[joint], 1e-300) for joint, noise in result.torque_noise.items()), default=0.0)
    if after >= _BETTER * before:
        progress.tell(f"{said}: the fit of positions is kept.")
    elif most > _WHITE:
        progress.tell(f"{said}, but {most:.3g} times the torques' noise is left of them: the fit of positions is kept.")
    else:
        progress.tell(f"{said}{', and their noise is left of the torques' if most else ''}: this fit is kept.")
        return True
    return False


def resume(
    path: str | Path,
    max_iteration: int | None = None,
    progress: ProgressLine | None = None,
    task: str | None = None,
    device: str | None = None,
    processes: Processes | None = None,
) -> tuple[FitResult, Path]:
    """Go on with an interrupted fit; the result is that of one that was never interrupted.

    Args:
        max_iteration: Another largest number of generations.
        task: Where the run's environment is found now, if it has been moved.
        device: Where the search simulates; ``None``: as before.
        processes: As for :func:`fit`.

    Raises:
        ValueError: If the run cannot be resumed, or anything that it was started with has changed.
    """
    settings, _ = FitSettings.load(Path(path) / "settings.json")
    folder = RunFolder(Path(path))
    checkpoint = folder.read_checkpoint()
    read_bounds(folder.path)
    ended = (folder.path / "result.json").exists() and not FitResult.load(folder.path).is_interrupted
    if (folder.path / "result.json").exists():  # its report is made of more
        check_folder(folder.path)
    before = _reopened(folder.path, settings, task)
    check_unchanged(before)
    settings = before.settings if max_iteration is None else replace(before.settings, max_iteration=max_iteration)
    if device is not None:
        settings = replace(settings, device=device)
    problem = load_for_fit(settings, before.load_cfg(), tell_nobody)
    check_same_configuration(before, problem)
    run = Optimization(settings, problem, folder, progress or ProgressLine(), processes)
    run.restore(checkpoint)
    result, path = _finished(run, before.record)
    if ended or result.is_interrupted:
        return result, path
    if settings.instead_of is None:
        return _by_torques(result, path, settings, run.progress, processes)
    first, place = FitResult.load(settings.instead_of), Path(settings.instead_of)
    if _is_better(result, first, "torques", run.progress):
        return result, path
    stated = FitSettings.load(place / "settings.json")[0].residual
    if stated == settings.residual:
        return first, place
    return _by_torques(first, place, replace(settings, residual=stated), run.progress, processes, beside=False)


def help_fit(processes: Processes, device: str, path: str | None = None, task: str | None = None) -> None:
    """Simulate this process's share of the search's candidates, for the process that fits and writes.

    Args:
        path: The run's folder, if it is resumed.
        task: As for :func:`resume`.
    """
    start: Any = processes.agree(None, at_leisure=True)
    if start is None:
        return
    settings, around, history, line_generation, max_iteration, loop = start
    settings = replace(settings, device=device)
    env_cfg = None if path is None else _reopened(Path(path), settings, task).load_cfg()
    problem = load_for_fit(settings, env_cfg, tell_nobody)
    problem = problem if loop in (None, problem.loop_dt) else problem.with_loop(loop)
    if len(around):
        problem = with_structures(problem, None, around)
    searcher = make_searcher(problem, settings)
    optimizer = make_optimizer(problem, settings, processes, around if len(around) else None)
    optimizer.cfg = replace(optimizer.cfg, max_iteration=max_iteration)
    optimizer.restore(history, line_generation)
    search(optimizer, searcher.rollout(optimizer.num_shown))


def _reopened(path: Path, settings: FitSettings, task: str | None) -> Run:
    """A run, its objective made known again too."""
    before = Run.open(path, task)
    if settings.has_own_objective:
        use_recorded_optimizer(settings.optimizer, before.record.code, str(path / "settings.json"))
    return before


def _finished(run: Optimization, record: EnvironmentRecord, keep_interrupted: bool = True) -> tuple[FitResult, Path]:
    """Search, refine, conclude, write."""
    outcome = run.run(keep_interrupted)
    if run.settings.has_own_objective:
        result = conclude_own(run, record, outcome)
    else:
        result = conclude(run, record, outcome, keep_interrupted)
    run.progress.close()
    run.log.log_result(result)
    run.log.close()
    write_report(run.folder.path)
    return result, run.folder.path
