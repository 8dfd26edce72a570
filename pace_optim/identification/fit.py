"""A fit from settings to a run's folder: load, search, refine, conclude, write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pace_actuators.effects import effect_modules
from pace_envs.task_source import EnvironmentRecord
from pace_optim.estimate.own_objective import optimizer_modules, use_recorded_optimizer
from pace_optim.estimate.search import agree_to_stop, search
from pace_optim.identification.conclude import conclude
from pace_optim.identification.optimization import Optimization, with_structures
from pace_optim.identification.own_objective import conclude_own
from pace_optim.identification.setup import load_for_fit, make_optimizer, make_searcher
from pace_optim.problem.recordings import tell_nobody, tell_on_stderr
from pace_optim.report import check_folder, write_report
from pace_optim.run.folder import RunFolder
from pace_optim.run.inputs import (
    check_same_configuration,
    check_unchanged,
    input_digests,
    recording_digests,
    with_absolute_paths,
)
from pace_optim.run.open import Run
from pace_optim.run.result import FitResult, assumptions
from pace_optim.run.settings import FitSettings
from pace_optim.run.tensors import read_bounds
from pace_optim.terminal.processes import Processes
from pace_optim.terminal.progress import ProgressLine

_NOTE = "note: "
_NOISY = 1.5
"""Times the noise above which a fit leaves something that other facts may explain."""
_BETTER = 0.9
"""Part of the error that facts from torques must leave at most, to be used instead of those that are stated."""


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
        progress: Shows how far it is.
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
    """Identify a robot; where recordings' torques contradict what is stated, by that which fits better.

    A fit with what is stated comes first. If it ends at the noise, the torques are not needed. Else another one takes
    the facts from the torques, and is kept if it leaves less.

    Args:
        settings: As for :func:`fit`; so are the others.
        progress: Shows how far it is.
        processes: Who shares the search's candidates; where there are several, only the first fit is made.
    """
    progress = progress or ProgressLine()
    result, folder = fit(settings, progress, processes=processes, tell=progress.tell)
    alone = processes is None or processes.count == 1
    if not result.contested or not alone or "interrupted" in result.stop_reasons or (result.times_noise or 0) < _NOISY:
        return result, folder
    facts = ", ".join(result.contested)
    progress.tell(f"The torques in the recordings contradict stated facts ({facts}): fitting with the torques' values.")
    unknown = [*settings.unknown, *(fact for fact in result.contested if fact not in settings.unknown)]
    other, other_folder = fit(replace(settings, unknown=unknown), progress, tell=tell_nobody)
    before, after = (1e3 * each.rmse["train"]["all"] for each in (result, other))
    if after < _BETTER * before:
        progress.tell(f"With {facts} from the torques the error is {after:.4g}, not {before:.4g} mrad: they are used.")
        return other, other_folder
    progress.tell(f"With {facts} from the torques the error is {after:.4g}, not {before:.4g} mrad: they are not used.")
    return result, folder


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
        path: The run's folder.
        max_iteration: Another largest number of generations.
        progress: Shows how far it is.
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
    if (folder.path / "result.json").exists():  # of a fit that had ended: its report is made of more
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
    return _finished(run, before.record)


def help_fit(processes: Processes, device: str, path: str | None = None, task: str | None = None) -> None:
    """Simulate this process's share of the search's candidates, for the process that fits and writes.

    Args:
        processes: All of them.
        device: Where this one simulates.
        path: The run's folder, if it is resumed.
        task: As for :func:`resume`.

    Raises:
        ValueError: If another process is lost, or there is nothing here of what it fits.
    """
    start: Any = processes.agree(None)
    if start is None:
        return
    settings, around, history, line_generation, loop = start
    settings = replace(settings, device=device)
    env_cfg = None if path is None else _reopened(Path(path), settings, task).load_cfg()
    problem = load_for_fit(settings, env_cfg, tell_nobody)
    problem = problem if loop in (None, problem.loop_dt) else problem.with_loop(loop)
    if len(around):
        problem = with_structures(problem, None, around)
    searcher = make_searcher(problem.for_search(device), settings)
    optimizer = make_optimizer(problem, settings, processes, around if len(around) else None)
    optimizer.restore(history, line_generation)
    search(optimizer, searcher.rollout(optimizer.num_shown), lambda _: agree_to_stop(optimizer, processes))


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
