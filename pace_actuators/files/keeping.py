"""Nothing of the user's is written over silently: what every command asks before its work."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def refuse_taken(paths: Iterable[str | Path], *, option: str, overwrite: bool, own: Iterable[str | Path] = ()) -> None:
    """Refuse to write where something lies already, before anything is computed or written.

    Args:
        paths: The files that are to be written.
        option: The option that says where, for the message.
        overwrite: Whether the user said that files may be replaced.
        own: Files of a run's folder that bear the names this program gives them: they are its own, and are replaced.
    """
    files, ours = [Path(path) for path in paths], {Path(path).absolute() for path in own}
    for path in files:
        refuse_place(path, option=option)
    there = [str(path) for path in files if path.exists() and path.absolute() not in ours]
    if there and not overwrite:
        raise ValueError(
            f"{', '.join(there)} {'exist' if len(there) > 1 else 'exists'}, and may be yours. Choose another {option}, "
            "or replace what is there with --overwrite."
        )


def refuse_place(path: Path, *, option: str) -> None:
    """Refuse a path where no file can be."""
    if path.is_dir():
        raise ValueError(f"{option} {path}: is a folder; expected a file. Add a file's name.")
    if path.exists() and not path.is_file():
        raise ValueError(f"{option} {path}: is a device or a pipe; expected a file. Choose another place.")
    obstacle = next((parent for parent in path.parents if parent.exists()), None)
    if obstacle is not None and not obstacle.is_dir():
        raise ValueError(f"{option} {path}: {obstacle} is a file, not a folder. Choose another place.")
