"""Where a collection's files go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pace_actuators.files import refuse_place, refuse_taken
from pace_optim.recording import SUFFIXES, written_files

from .cfg import CollectionCfg


@dataclass(frozen=True, kw_only=True)
class Files:
    """Where one trajectory's files go; None where there is none."""

    recording: Path | None
    """The recording."""
    command: Path | None
    """The commands alone."""
    plot: Path | None
    """The picture."""


def plan_files(cfg: CollectionCfg, robot_name: str, names: Sequence[str]) -> list[Files]:
    """Name the files of every trajectory, and refuse what could not be written before the work is done.

    Args:
        cfg: The request.
        robot_name: Names the folder under ``data/`` where the request names none.
        names: Names of the trajectories; with several, each adds its own to the stem of its files.

    Raises:
        ValueError: If a suffix is wrong, a path is taken, or two files have the same name.
    """
    _check("--output", cfg.output, SUFFIXES)
    _check("--export_command", cfg.export_command, (".csv",))
    _check("--plot", cfg.plot, (".png",))
    folder = Path("data") / robot_name
    stem = f"{cfg.excitation}_optimized" if cfg.optimize else cfg.excitation
    recording = None if cfg.command_only else cfg.output or folder / f"{stem}.npz"
    command = cfg.export_command
    if command is None and cfg.command_only:
        command = folder / f"{stem}_command.csv"
    plot = cfg.plot or (recording or command or folder).with_suffix(".png")
    files = [
        Files(
            recording=_part(recording, name, len(names)),
            command=_part(command, name, len(names)),
            plot=None if cfg.no_plot else _part(plot, name, len(names)),
        )
        for name in names
    ]
    paths = [path for file in files for path in (file.recording, file.command, file.plot) if path]
    if repeated := sorted({str(path) for path in paths if paths.count(path) > 1}):
        raise ValueError(f"Two files would be written to {', '.join(repeated)}. Give each a name of its own.")
    recordings = [path for file in files if file.recording for path in written_files(file.recording)]
    truth = [truth_file(cfg, robot_name)] if cfg.effects else []
    refuse_taken(dict.fromkeys((*paths, *recordings, *truth)), option="--output", overwrite=cfg.overwrite)
    return files


def truth_file(cfg: CollectionCfg, robot_name: str) -> Path:
    """Where it is said what was hidden: the recording's stem (of several, what theirs have in common)."""
    stem = f"{cfg.excitation}_optimized" if cfg.optimize else cfg.excitation
    recording = cfg.output or Path("data") / robot_name / f"{stem}.npz"
    return recording.with_name(f"{recording.stem}.truth.json")


def _part(path: Path | None, name: str, count: int) -> Path | None:
    return path.with_name(f"{path.stem}_{name}{path.suffix}") if path and count > 1 else path


def _check(option: str, path: Path | None, suffixes: Sequence[str]) -> None:
    if path is None:
        return
    refuse_place(path, option=option)
    if path.suffix.lower() not in suffixes:
        raise ValueError(
            f"{option} {path}: found the suffix '{path.suffix}'; expected {' or '.join(suffixes)}. Rename the file."
        )
