"""Finding a run among those of a robot, and opening it: its settings, its environment, and the problem that it solves.

problem = open_problem("logs/pace/my_arm/26_01_01_12-00-00")
"""

from __future__ import annotations

import difflib
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from pace_actuators.effects import use_recorded_effects
from pace_actuators.text import listed
from pace_envs.task_source import EnvironmentRecord, file_digest
from pace_optim.estimate.error_bars.assessment import trajectories
from pace_optim.problem.problem import Problem, load_problem
from pace_optim.problem.recordings import tell_nobody, tell_on_stderr
from pace_optim.run.resolved import first_difference, resolved
from pace_optim.run.result import FitResult
from pace_optim.run.settings import FitSettings
from pace_optim.run.tensors import Trajectories, read_bounds

_MOST_NAMED = 8
_OF_A_RUN = ("settings.json", "result.json", "best_trajectory.pt")


def find_run(log_dir: str | Path, robot_name: str | None = None, folder_name: str | None = None) -> Path:
    """The folder of a run.

    Args:
        robot_name: The robot's folder in it; ``None`` means that of the newest run.
        folder_name: The run's folder in that; ``None`` means the newest.
    """
    log_dir = Path(log_dir)
    robots = sorted(path.name for path in log_dir.iterdir() if _runs(path)) if log_dir.is_dir() else []
    if not robots:
        raise ValueError(
            f"There is no run under {log_dir}. Fit first: scripts/fit.py --task … --log_dir {shlex.quote(str(log_dir))}"
        )
    if robot_name is None:
        robot_name = max(robots, key=lambda robot: _age(_runs(log_dir / robot)[-1]))
    if robot_name not in robots:
        raise ValueError(
            f"There is no run of {robot_name!r} under {log_dir}. {_available('Robots', robots, robot_name)}"
        )
    runs = _runs(log_dir / robot_name)
    if folder_name is None:
        return runs[-1]
    for run in runs:
        if run.name == folder_name:
            return run
    names = [run.name for run in reversed(runs)]
    raise ValueError(
        f"There is no run {folder_name!r} in {log_dir / robot_name}. {_available('Runs', names, folder_name)}"
    )


def find_mean(run: Path, mean_name: str) -> Path:
    """A saved mean of a run's search, by the name of its file."""
    path = run / (mean_name if mean_name.endswith(".pt") else f"{mean_name}.pt")
    means = sorted(file.name for file in run.glob("mean_*.pt"))
    if path.name in means and path.parent == run:
        return path
    if not means:
        raise ValueError(
            f"There is no {mean_name!r} in {run}, nor another saved mean: its search ended before the first was due, "
            "or there was none. Leave --mean_name out to see the best parameters."
        )
    raise ValueError(f"There is no {mean_name!r} in {run}. {_available('Means', means, mean_name)}")


def newest_mean(run: Path) -> str | None:
    """Name of the file of a run's last saved mean."""
    names = [path.stem for path in run.glob("mean_*.pt") if path.stem.removeprefix("mean_").isdigit()]
    return max(names, key=lambda name: int(name.removeprefix("mean_")), default=None)


def _runs(robot: Path) -> list[Path]:
    """A robot's runs, the oldest first: their names are the times when they were started."""
    if not robot.is_dir():
        return []
    return sorted((path for path in robot.iterdir() if any((path / name).is_file() for name in _OF_A_RUN)), key=_age)


def _age(run: Path) -> tuple[str, int]:
    """Sorts ``…_10`` of one second after ``…_9``."""
    stamp, count = run.name[:17], run.name[18:]
    return stamp, int(count) if count.isdigit() else 0


def _available(what: str, names: list[str], wanted: str) -> str:
    close = difflib.get_close_matches(wanted, names, n=1)
    meant = f" Did you mean {close[0]}?" if close else ""
    return f"{what}: {listed(names, _MOST_NAMED)}.{meant}"


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run's folder with its settings; its environment is registered again."""

    folder: Path
    """Where it lies."""

    settings: FitSettings
    """Settings of the fit, paths absolute; the task is a known one."""

    record: EnvironmentRecord
    """Where its environment comes from."""

    recordings: dict[str, str]
    """SHA-256 of each recording, by its path, in the order of training and validation."""

    inputs: dict[str, str | None]
    """SHA-256 of each other file that the fit read; ``None`` where there was none."""

    resolved: dict[str, Any]
    """The whole configuration as it was resolved then."""

    overridden: bool = False
    """Whether the task is not the run's own."""

    @classmethod
    def open(cls, run: str | Path, task: str | None = None) -> Run:
        """Read a run's ``settings.json`` and make its environment and effects known.

        Args:
            run: The run's folder, or its ``result.json``.
            task: Another environment, as :func:`pace_envs.task_source.use_task` returns it.
        """
        folder = run_folder(run)
        path = folder / "settings.json"
        settings, content = FitSettings.load(path)
        record = EnvironmentRecord.read(content.environment, settings.task, path, "Start a new fit.")
        known = record.use(str(path), task)
        use_recorded_effects(settings.effects, record.code, str(path))
        return cls(
            folder=folder,
            settings=replace(settings, task=known),
            record=record,
            recordings=content.digests,
            inputs=content.inputs,
            resolved=content.resolved,
            overridden=task is not None,
        )

    def problem(
        self,
        *,
        data: Sequence[str | Path] = (),
        physics_dt: float | None = None,
        effects: Sequence[Any] | None = None,
        columns: str | None = None,
        strict: bool = False,
    ) -> Problem:
        """The problem that the run solves, on its own recordings or on others.

        Args:
            physics_dt: Another physics step [s]; ``None``: that of its result.
            effects: Other effects; ``None`` keeps its own.
            columns: Column map of logs among ``data``; ``None``: guessed.
            strict: Whether one of ``data`` that cannot be used refuses all, instead of being set aside.
        """
        settings = self.settings
        if data:
            own = {"data": [str(path) for path in data], "validation": [], "joints": ".*"}
            settings = replace(settings, **own, columns=columns, rate=None, strict=strict)  # type: ignore[arg-type]
        try:
            drive_dt = self.told_drive_dt if settings.drive_dt is None else settings.drive_dt
            settings = replace(settings, physics_dt=physics_dt or self.used_physics_dt, drive_dt=drive_dt)
            problem = problem_of(settings, self.load_cfg(), tell=tell_on_stderr if data else tell_nobody)
        except ValueError as error:
            if data or str(self.folder) in str(error):
                raise
            raise ValueError(f"{error} (Of the run's own settings: {self.folder / 'settings.json'}.)") from None
        if result := self.result:
            problem = problem.with_torque_noise(result.torque_noise).with_imu_delays(result.imu_delays)
        if data:  # other recordings have other bounds; the run's values must be within
            problem = problem.reaching(read_bounds(self.folder))
        return problem if effects is None else problem.with_effects(effects)

    @property
    def result(self) -> FitResult | None:
        """What it has found so far; ``None``: it has not ended."""
        path = self.folder / "result.json"
        return FitResult.load(path) if path.is_file() else None

    @property
    def told_drive_dt(self) -> float | None:
        """Period of the drives' loops [s] that its recordings showed where none was stated; ``None``: as assumed."""
        rate = result.loop_rate if (result := self.result) else {}
        return rate["used_s"] if rate and rate["used_s"] != rate["assumed_s"] else None

    @property
    def used_physics_dt(self) -> float | None:
        """Physics step of its result [s], which may be finer than the robot's; ``None``: the robot's."""
        if self.settings.physics_dt is not None or self.overridden or (result := self.result) is None:
            return self.settings.physics_dt
        return result.physics_dt

    def load_cfg(self) -> Any:
        """A fresh configuration of its environment."""
        task = self.settings.task if self.overridden else None
        return self.record.load_cfg(str(self.folder / "settings.json"), task)


def open_problem(
    run: str | Path,
    *,
    task: str | None = None,
    data: Sequence[str | Path] = (),
    physics_dt: float | None = None,
    effects: Sequence[Any] | None = None,
    columns: str | None = None,
    strict: bool = False,
) -> Problem:
    """The problem of a run of any robot; :meth:`Run.open` and :meth:`Run.problem` have the arguments."""
    return Run.open(run, task).problem(
        data=data, physics_dt=physics_dt, effects=effects, columns=columns, strict=strict
    )


def problem_of(settings: FitSettings, env_cfg: Any = None, tell: Callable[[str], None] = tell_on_stderr) -> Problem:
    """The problem that settings pose: the one place where they become one.

    Args:
        settings: Of a fit; its task and effects are known.
        env_cfg: The task's configuration, if it has been loaded.
        tell: Gets how the recordings are understood.
    """
    return load_problem(
        settings.task,
        data=settings.data,
        validation=settings.validation,
        delay_mode=settings.delay_mode,
        physics_dt=settings.physics_dt,
        drive_dt=settings.drive_dt,
        control_dt=settings.control_dt,
        effects=settings.effects,
        links=settings.links,
        unknown=settings.unknown,
        residual=("position",) if settings.only_searches else settings.residual,
        env_cfg=env_cfg,
        joints=settings.joints,
        columns=settings.columns,
        facts=settings.facts,
        rate=settings.rate,
        strict=settings.strict,
        max_duration=settings.max_duration,
        tell=tell,
    )


def run_folder(run: str | Path) -> Path:
    """The folder of a run, named by itself or by its ``result.json``."""
    path = Path(run)
    if path.name == "result.json" and path.is_file():
        path = path.parent
    if not path.is_dir():
        raise ValueError(f"There is no run {run}. Name the folder that scripts/fit.py printed as its last line.")
    return path


def replay(run: Path, physical: torch.Tensor, task: str | None = None) -> Trajectories:
    """Simulate one parameter vector on the recordings of a run.

    Args:
        physical: The parameters in the layout of the run's ``config.pt``, (size,).
        task: Another environment than the run's own.
    """
    problem = open_problem(run, task=task)
    if tuple(physical.shape) != (problem.space.size,):
        raise ValueError(
            f"The parameters have the shape {tuple(physical.shape)}, expected ({problem.space.size},) for "
            f"{problem.task}. They belong to another task, or it has changed since."
        )
    every = problem.evaluator().residuals(physical[None].double(), problem.dataset.sampled)
    return Trajectories.of(trajectories(problem, every))


_NOT_TO_COMPARE = ("versions",)


def with_absolute_paths(settings: FitSettings, env_cfg: Any) -> FitSettings:
    """The same settings, which mean the same from any folder; the robot's sample stands in ``data`` where none does."""
    sample = getattr(getattr(env_cfg, "sim2real", None), "recording", None)
    data = settings.data or ([str(sample)] if sample is not None else [])
    files = {
        name: None if value is None else str(Path(value).absolute())
        for name, value in (("columns", settings.columns), ("facts", settings.facts))
    }
    return replace(settings, data=_absolute(data), validation=_absolute(settings.validation), **files)  # type: ignore[arg-type]


def recording_digests(settings: FitSettings) -> dict[str, str]:
    """SHA-256 of each recording, in the order of training and validation."""
    return {name: file_digest(name) for name in [*settings.data, *settings.validation]}


def input_digests(settings: FitSettings, record: EnvironmentRecord) -> dict[str, str | None]:
    """SHA-256 of each other file: the model with what it includes, code of the user's own, facts beside recordings.

    ``None`` stands for facts that are not there: they would be read if they came.
    """
    code = {entry["file"]: entry["sha256"] for entry in record.code.values()}
    beside = [Path(name).with_suffix(".json") for name in (*settings.data, *settings.validation)]
    given = {name: file_digest(name) for name in (settings.columns, settings.facts) if name is not None}
    return {**record.files, **code, **given, **{str(path): _digest_if_there(path) for path in beside}}


def check_unchanged(run: Run) -> None:
    """See whether every file is what it was when the run was started."""
    moved = {*run.record.files, *(entry["file"] for entry in run.record.code.values())} if run.overridden else set()
    for name, digest in (run.recordings | run.inputs).items():
        path = Path(name)
        if name in moved:  # what it says is compared, once it is loaded
            continue
        if digest is None and path.is_file():
            raise ValueError(
                f"{name} was not there when the run was started, and would be read now. Move it away, or start a new "
                "fit."
            )
        if digest is not None and _digest_if_there(path) != digest:
            raise ValueError(f"{name} has changed or gone since the run was started. Put it back, or start a new fit.")


def check_same_configuration(run: Run, problem: Problem) -> None:
    """See whether the configuration is the one that the run was started with."""
    now = resolved(problem)
    now["configuration"]["sim2real"].pop("notes")  # words about the rest
    if run.overridden:
        now["configuration"]["scene"]["robot"].pop("mjcf_path")
    for part in run.resolved:
        if part not in _NOT_TO_COMPARE and (found := first_difference(run.resolved[part], now.get(part))):
            raise ValueError(
                f"The environment's {part} has changed since the run was started: {found} in "
                f"{run.folder / 'settings.json'}. Put it back, or start a new fit."
            )


def _absolute(names: list[str]) -> list[str]:
    return [str(Path(name).absolute()) for name in names]


def _digest_if_there(path: Path) -> str | None:
    return file_digest(path) if path.is_file() or path.is_dir() else None
