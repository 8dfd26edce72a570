"""Finding a run among those of a robot."""

from __future__ import annotations

import difflib
import shlex
from pathlib import Path

from pace_actuators.text import listed

_MOST_NAMED = 8
_OF_A_RUN = ("settings.json", "result.json", "best_trajectory.pt")


def find_run(log_dir: str | Path, robot_name: str | None = None, folder_name: str | None = None) -> Path:
    """The folder of a run.

    Args:
        log_dir: Where runs are kept.
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
