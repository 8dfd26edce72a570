"""A fit from settings to a run's folder: load, search, refine, conclude, write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pace_actuators.effects import effect_modules
from pace_envs import load_env_cfg
from pace_envs.task_source import EnvironmentRecord
from pace_optim.identification.beginning import load_for_fit, logged_control_dt, make_optimizer, make_searcher
from pace_optim.identification.conclusion import conclude
from pace_optim.identification.optimization import Optimization
from pace_optim.optimizers.search import agree_to_stop, search
from pace_optim.problem.processes import Processes
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
from pace_optim.run.result import FitResult
from pace_optim.run.settings import FitSettings
from pace_optim.run.tensors import read_bounds
from pace_optim.terminal.progress import ProgressLine


def fit(
    settings: FitSettings,
    progress: ProgressLine | None = None,
    before: Run | None = None,
    on_start: Callable[[Path], None] = lambda _: None,
    assess_interrupted: bool = True,
    processes: Processes | None = None,
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

    Returns:
        The result and the run's folder.

    Raises:
        ValueError: If anything does not fit; nothing has been written then.
    """
    if before is None:
        env_cfg, place = load_env_cfg(settings.task, settings.control_dt), None
    else:
        env_cfg, place = before.load_cfg(), before.record.folder
    problem = load_for_fit(settings, env_cfg, told=before is not None)
    if before is None and (control_dt := logged_control_dt(settings, problem)) is not None:
        settings = replace(settings, control_dt=control_dt)
        env_cfg = load_env_cfg(settings.task, control_dt)
        problem = load_for_fit(settings, env_cfg, told=True)
    settings = with_absolute_paths(settings, env_cfg)
    record = EnvironmentRecord.of(settings.task, problem.env_cfg, effect_modules(problem.effects), place)
    digests, inputs = recording_digests(settings), input_digests(settings, record)
    folder = RunFolder.create(settings.log_dir, problem.env_cfg.sim2real.robot_name)
    folder.write_start(settings.to_dict(), digests, problem, inputs=inputs, environment=record.to_dict())
    on_start(folder.path)
    run = Optimization(settings, problem, folder, progress or ProgressLine(), processes)
    return _finished(run, record, assess_interrupted)


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
    before = Run.open(folder.path, task)
    check_unchanged(before)
    settings = before.settings if max_iteration is None else replace(before.settings, max_iteration=max_iteration)
    if device is not None:
        settings = replace(settings, device=device)
    problem = load_for_fit(settings, before.load_cfg(), told=True)
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
    settings, history, line_generation = start
    settings = replace(settings, device=device)
    problem = load_for_fit(
        settings,
        load_env_cfg(settings.task, settings.control_dt) if path is None else Run.open(Path(path), task).load_cfg(),
    )
    searcher = make_searcher(problem.for_search(device), settings)
    optimizer = make_optimizer(problem, settings, processes)
    optimizer.restore(history, line_generation)
    search(optimizer, searcher.rollout(optimizer.num_shown), lambda _: agree_to_stop(optimizer, processes))


def _finished(run: Optimization, record: EnvironmentRecord, keep_interrupted: bool = True) -> tuple[FitResult, Path]:
    """Search, refine, conclude, write."""
    outcome = run.run(keep_interrupted)
    result = conclude(run, record, outcome, keep_interrupted)
    run.progress.close()
    run.log.log_result(result)
    run.log.close()
    write_report(run.folder.path)
    return result, run.folder.path
