"""A folder that is the user's alone: what may run or be trusted later is kept there, and nowhere else."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class OwnFolder:
    """An open folder that belongs to the user, with mode 0700, that is not itself a link.

    Its files are opened, checked and replaced relative to the open folder, so that no one else can replace one. A
    file of another user, a file that others may write to, and a link count as missing.
    """

    def __init__(self, path: Path, descriptor: int):
        """Take an open folder; :meth:`below` and :meth:`at` check it."""
        self.path = path
        self._descriptor = descriptor

    def __del__(self) -> None:
        """Close it."""
        os.close(self._descriptor)

    @classmethod
    def below(cls, variable: str, under_home: str, *names: str) -> OwnFolder | None:
        """The folder under a base directory of the XDG specification; it is made if it is missing.

        Args:
            variable: Environment variable of the base directory, such as ``XDG_CACHE_HOME``.
            under_home: Base directory under ``HOME`` where the variable is empty, such as ``.cache``.
            names: Folders below the base directory; each must be the user's alone.

        Returns:
            The folder. ``None`` where it cannot be private: the base directory is not an absolute path or is not
            writable, a folder is a link or belongs to another user, or the system has no owners.
        """
        home = os.environ.get("HOME", "")
        base = os.environ.get(variable) or (os.path.join(home, under_home) if home else "")
        if not os.path.isabs(base) or not hasattr(os, "getuid"):
            return None
        try:
            os.makedirs(base, mode=0o700, exist_ok=True)
            return cls._descend(Path(base), os.open(base, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC), names)
        except (OSError, ValueError):  # ValueError: a zero in the path
            return None

    @classmethod
    def at(cls, path: Path) -> OwnFolder:
        """A folder by its path, such as a temporary one; it is made if it is missing.

        Raises:
            OSError: If it is a link, or not the user's alone.
        """
        return cls._descend(path.parent, os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC), [path.name])

    @classmethod
    def _descend(cls, path: Path, descriptor: int, names: tuple[str, ...] | list[str]) -> OwnFolder:
        for name in names:
            try:
                with contextlib.suppress(FileExistsError):
                    os.mkdir(name, mode=0o700, dir_fd=descriptor)
                inner = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=descriptor)
            finally:
                os.close(descriptor)
            path, descriptor = path / name, inner
            if not _is_own(info := os.fstat(descriptor)):
                os.close(descriptor)
                raise PermissionError(f"{path} is not the user's alone")
            if stat.S_IMODE(info.st_mode) != 0o700:
                os.fchmod(descriptor, 0o700)
        return cls(path, descriptor)

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Let no other process of the user's into the same block: for what reads a file and writes it again."""
        import fcntl  # systems without it have no such folders

        fcntl.flock(self._descriptor, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(self._descriptor, fcntl.LOCK_UN)

    def read(self, name: str) -> bytes | None:
        """A file's content; ``None`` if it is missing or not the user's alone."""
        try:
            descriptor = os.open(
                name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=self._descriptor
            )
        except OSError:
            return None
        with os.fdopen(descriptor, "rb") as file:
            info = os.fstat(descriptor)
            return file.read() if stat.S_ISREG(info.st_mode) and _is_own(info) else None

    def write(self, name: str, content: bytes) -> None:
        """Write a file whole or not at all, also if the machine stops meanwhile.

        Raises:
            OSError: If it cannot be written.
        """
        temporary = f".{name}.{os.getpid()}.tmp"
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        with contextlib.suppress(FileNotFoundError):  # of a process of the same number that was killed
            os.unlink(temporary, dir_fd=self._descriptor)
        try:
            with os.fdopen(os.open(temporary, flags, 0o600, dir_fd=self._descriptor), "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.rename(temporary, name, src_dir_fd=self._descriptor, dst_dir_fd=self._descriptor)
            os.fsync(self._descriptor)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary, dir_fd=self._descriptor)
            raise

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        with contextlib.suppress(OSError):
            os.unlink(name, dir_fd=self._descriptor)

    def path_of(self, name: str) -> str:
        """A path of a file that leads through the open folder, where the system has one."""
        through = f"/proc/self/fd/{self._descriptor}"
        return f"{through}/{name}" if os.path.isdir(through) else str(self.path / name)


def _is_own(info: os.stat_result) -> bool:
    return info.st_uid == os.geteuid() and not info.st_mode & _OTHERS_WRITE
