"""Writing files so that a reader sees the old one or the new one, never a half; several together, or none."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import torch


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


Writer = Callable[[IO[bytes]], object]


def write_atomically(path: Path, write: Writer) -> None:
    """Write a file through a temporary one beside it.

    Raises:
        OSError: If it cannot be written; its ``filename`` is the path.
    """
    with writing({path: write}):
        pass


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file's path beside a file's, for what writes by path; it takes the file's place at the end.

    Its suffix is the file's, which some libraries go by.

    Raises:
        OSError: If it cannot be written; its ``filename`` is the path.
    """
    remove_leftovers(path.parent)
    _refuse_other(path)
    temporary = path.with_name(f".{path.stem[:40]}.0.{os.getpid()}.tmp{path.suffix}")
    try:
        with naming(path):
            yield temporary
            os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_together(files: Mapping[Path, bytes]) -> None:
    """Write files that belong together: all of them, or none if one cannot be written.

    Raises:
        OSError: If one cannot be written; its ``filename`` is the path.
    """
    with writing({path: _writer(content) for path, content in files.items()}):
        pass


def _writer(content: bytes) -> Writer:
    return lambda file: file.write(content)


@contextlib.contextmanager
def writing(files: Mapping[Path, Writer]) -> Iterator[None]:
    """Write files that belong together: all of them at the end of the block, or none if anything in it fails.

    They are written before the block begins, beside where they belong, so that what the disk refuses is refused early.

    Args:
        files: For each file, what gets it opened.

    Raises:
        OSError: If one cannot be written; its ``filename`` is the path.
    """
    made: dict[Path, Path] = {}
    try:
        for number, (path, write) in enumerate(files.items()):
            remove_leftovers(path.parent)
            _refuse_other(path)
            made[path] = temporary = path.with_name(f".{path.name[:40]}.{number}.{os.getpid()}.tmp")
            with naming(path), temporary.open("wb") as file:
                write(file)
        yield
        try:
            _put_in_place(made)
        except KeyboardInterrupt:  # what has begun is ended: one file of two would be a half
            _put_in_place({path: temporary for path, temporary in made.items() if temporary.exists()})
            raise
    finally:
        for temporary in made.values():
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)


def _refuse_other(path: Path) -> None:
    """Replace only files: a device, such as /dev/null, would be gone for every program."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is a device or a pipe, expected a file", str(path))


def _put_in_place(made: Mapping[Path, Path]) -> None:
    for path, temporary in made.items():
        with naming(path):
            os.replace(temporary, path)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let what fails in the block name the file that was to be written: a full disk alone names none.

    Raises:
        OSError: What failed, with the file's name.
    """
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    except RuntimeError as error:  # torch and zip archives have their own words for a disk that is full
        if isinstance(error.__context__, OSError):
            raise OSError(error.__context__.errno, error.__context__.strerror, str(path)) from error
        if re.search(r"enforce fail|unexpected pos|writing file|iostream", str(error)):
            raise OSError(None, f"{path}: cannot be written ({str(error).splitlines()[0][:120]})") from error
        raise


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of processes of this machine that were killed while they wrote."""
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            found = re.fullmatch(r"\..+\.(\d+)\.tmp(\.\w+)?", entry.name)
            if found and not _is_alive(int(found[1])):
                with contextlib.suppress(OSError):
                    os.unlink(entry.path)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def json_text(content: Any) -> bytes:
    """JSON that can be read by eye."""
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()


def write_json(path: Path, content: Any) -> None:
    """Write JSON that can be read by eye."""
    text = json_text(content)
    write_atomically(path, lambda file: file.write(text))


def write_tensors(path: Path, content: Any) -> None:
    """Write what ``torch.load(path, weights_only=True)`` reads."""
    write_atomically(path, lambda file: torch.save(content, file))
