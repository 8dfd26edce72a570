"""Compiles the same C for the processor, by the machine's own compiler, and runs it."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

from pace_envs.kernels.arguments import Argument, as_argument

_COMPILERS = ("c++", "g++", "clang++")
_OPTIONS = ("-O2", "-ffp-contract=off", "-fno-math-errno", "-shared", "-fPIC", "-x", "c++")
"""A multiplication and an addition are rounded one by one, as everywhere else."""
_PATIENCE = 3000
"""Control steps in Python that take as long as a compiler."""
_TEMPORARY: list[tempfile.TemporaryDirectory] = []
"""Folders of this process, removed at its end."""


class CannotCompileError(RuntimeError):
    """There is no kernel of something: it is done without one."""


class HostKernels:
    """Kernels by their source, each compiled once for a user and a compiler."""

    def __init__(self, compiler: str, folder: Path, include: str | None = None):
        """With a compiler of C++, a folder of the user's alone that keeps what it has made, and one of headers."""
        self._command = [compiler, *_OPTIONS, *([] if include is None else [f"-I{include}"])]
        info = os.stat(compiler)
        self._key = f"{self._command} {info.st_size} {info.st_mtime_ns}"
        self._folder = folder
        self._waited: dict[str, int] = {}
        self._functions: dict[str, Any] = {}

    def compile(self, sources: Sequence[str]) -> None:
        """Compile those that are new, side by side.

        Raises:
            CannotCompileError: If the compiler refuses one, or what it makes cannot be loaded.
        """
        new = [source for source in dict.fromkeys(sources) if source not in self._functions]
        if not new:
            return
        with ThreadPoolExecutor(min(len(new), os.cpu_count() or 1)) as pool:
            for source, path in zip(new, pool.map(self._compiled, new), strict=True):
                try:
                    self._functions[source] = ctypes.CDLL(str(path)).simulate
                except (OSError, AttributeError) as error:  # a folder from which nothing may run, a damaged file
                    path.unlink(missing_ok=True)
                    raise CannotCompileError(f"{path}: {error}") from error

    def launch(self, source: str, threads: int, width: int, arguments: Sequence[Argument]) -> None:
        """Run a compiled kernel over all its joints.

        Args:
            source: Its source.
            threads: Not used: ``arguments`` tell how many joints there are.
            width: Not used.
            arguments: Tensors, which are handed over by address, and whole numbers.
        """
        self._functions[source](*map(as_argument, arguments))

    def pays(self, source: str, steps: int) -> bool:
        """Whether a source is compiled before so many control steps: it was before, or they are many with those before.

        Args:
            source: The source.
            steps: Control steps that are simulated now.
        """
        if source in self._functions or self._path_of(source).exists():
            return True
        self._waited[source] = self._waited.get(source, 0) + steps
        return self._waited[source] >= _PATIENCE

    def address_of(self, source: str) -> int:
        """Where the function of a compiled one is."""
        return ctypes.cast(self._functions[source], ctypes.c_void_p).value or 0

    def _path_of(self, source: str) -> Path:
        return self._folder / f"{hashlib.sha256((self._key + source).encode()).hexdigest()}.so"

    def _compiled(self, source: str) -> Path:
        path = self._path_of(source)
        if not path.exists():
            with tempfile.NamedTemporaryFile(dir=self._folder, suffix=".tmp", delete=False) as file:
                begun = Path(file.name)
            try:
                subprocess.run([*self._command, "-", "-o", str(begun)], input=source.encode(), check=True, stderr=-1)
                os.replace(begun, path)  # whole or not at all: other processes may want the same
            except (OSError, subprocess.CalledProcessError) as error:
                raise CannotCompileError(f"{self._command[0]}: {error}") from error
            finally:
                begun.unlink(missing_ok=True)
        return path


@cache
def host_kernels() -> HostKernels | None:
    """The kernels of the processor; ``None`` where no compiler of C++ is installed."""
    compiler = next((path for name in _COMPILERS if (path := shutil.which(name))), None)
    return None if compiler is None else HostKernels(compiler, _own_folder())


@cache
def mujoco_kernels() -> HostKernels | None:
    """The same for kernels that step MuJoCo themselves; ``None`` where there is no compiler, or MuJoCo no headers."""
    import mujoco

    compiler = next((path for name in _COMPILERS if (path := shutil.which(name))), None)
    include = Path(mujoco.HEADERS_DIR).parent
    if compiler is None or not (include / "mujoco" / "mujoco.h").exists():
        return None
    return HostKernels(compiler, _own_folder(), str(include))


def _own_folder() -> Path:
    """A folder that only the user can write to: kept, or for this process where there is none to keep."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = Path(home) / "pace" / "kernels"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        info = folder.stat()
        others_write = bool(info.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
        if info.st_uid == os.getuid() and not others_write and os.access(folder, os.W_OK):
            return folder
    except (OSError, AttributeError):  # no such folder, or a system without such owners
        pass
    _TEMPORARY.append(tempfile.TemporaryDirectory(prefix="pace_kernels_"))
    return Path(_TEMPORARY[-1].name)
