"""What a run rests on: the digest of every file that it read, and whether one has changed since."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from pace_envs.task_source import EnvironmentRecord, file_digest
from pace_optim.problem.problem import Problem
from pace_optim.run.open import Run
from pace_optim.run.resolved import first_difference, resolved
from pace_optim.run.settings import FitSettings

_NOT_TO_COMPARE = ("versions",)


def with_absolute_paths(settings: FitSettings, env_cfg: Any) -> FitSettings:
    """The same settings, which mean the same from any folder; the robot's sample stands in ``data`` where none does."""
    sample = getattr(getattr(env_cfg, "sim2real", None), "recording", None)
    data = settings.data or ([str(sample)] if sample is not None else [])
    columns = None if settings.columns is None else str(Path(settings.columns).absolute())
    return replace(settings, data=_absolute(data), validation=_absolute(settings.validation), columns=columns)


def recording_digests(settings: FitSettings) -> dict[str, str]:
    """SHA-256 of each recording, in the order of training and validation."""
    return {name: file_digest(name) for name in [*settings.data, *settings.validation]}


def input_digests(settings: FitSettings, record: EnvironmentRecord) -> dict[str, str | None]:
    """SHA-256 of each other file: the model with what it includes, code of the user's own, facts beside recordings.

    ``None`` stands for facts that are not there: they would be read if they came.
    """
    code = {entry["file"]: entry["sha256"] for entry in record.code.values()}
    beside = [
        Path(name).with_suffix(".json")
        for name in (*settings.data, *settings.validation)
        if not name.endswith((".npz", ".pt"))
    ]
    columns = {} if settings.columns is None else {settings.columns: file_digest(settings.columns)}
    return {**record.files, **code, **columns, **{str(path): _digest_if_there(path) for path in beside}}


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
