"""Where a collection's files go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pace_actuators.files import refuse_place, refuse_taken
from pace_envs.tasks.pace import PaceCfg
from pace_optim.recording import SUFFIXES, written_files

from .cfg import CollectionCfg


@dataclass(frozen=True, kw_only=True)
class Files:
    """Where one trajectory's files go; None for a file that is not written."""

    recording: Path | None
    """The recording."""
    command: Path | None
    """The commands alone."""
    plot: Path | None
    """The picture."""


def plan_files(cfg: CollectionCfg, sim2real: PaceCfg, names: Sequence[str]) -> list[Files]:
    """Name the files of every trajectory, and refuse what could not be written before the work is done.

    Args:
        sim2real: Says where files go that the request does not place.
        names: Names of the trajectories; with several, each adds its own to the stem of its files.
    """
    _check("--output", cfg.output, SUFFIXES)
    _check("--export_command", cfg.export_command, (".csv",))
    _check("--plot", cfg.plot, (".png",))
    folder, stem = Path("data") / sim2real.robot_name, _stem(cfg)
    recording = None if cfg.command_only else _recording(cfg, sim2real)
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
        raise ValueError(f"Two files would be written to {', '.join(repeated)}. Give each another name.")
    recordings = [path for file in files if file.recording for path in written_files(file.recording)]
    truth = [truth_file(cfg, sim2real)] if cfg.effects else []
    refuse_taken(dict.fromkeys((*paths, *recordings, *truth)), option="--output", overwrite=cfg.overwrite)
    return files


def truth_file(cfg: CollectionCfg, sim2real: PaceCfg) -> Path:
    """Where the truth is written: by the recording's stem (of several, their common part)."""
    recording = _recording(cfg, sim2real)
    return recording.with_name(f"{recording.stem}.truth.json")


def _stem(cfg: CollectionCfg) -> str:
    return f"{cfg.excitation}_optimized" if cfg.optimize else cfg.excitation


def _recording(cfg: CollectionCfg, sim2real: PaceCfg) -> Path:
    """Where a recording goes: as asked; where a fit looks for one of this motion; else under ``data/``."""
    if cfg.output is not None:
        return cfg.output
    own = Path(sim2real.data_dir)
    is_for_motion = own.stem.startswith(_stem(cfg)) and own.suffix.lower() in SUFFIXES
    if is_for_motion and not own.is_absolute():
        return sim2real.recording
    return Path("data") / sim2real.robot_name / f"{_stem(cfg)}.npz"


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
