"""Compiles the same C for the processor, by the machine's own compiler, and runs it."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import shutil
import signal
import subprocess
import tempfile
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import torch

from pace_actuators.files import OwnFolder

_COMPILERS = ("c++", "g++", "clang++")
_OPTIONS = ("-O2", "-ffp-contract=off", "-fno-math-errno", "-nostdinc++", "-shared", "-fPIC", "-x", "c++")
"""A multiplication and an addition are rounded one by one, as everywhere else. Headers are C's alone: to read those of
C++ takes as long as to compile a kernel."""
_PATIENCE = 3000
"""Steps in Python that take as long as a compiler."""
_LONGEST_S = 180.0
"""Longest time of a compiler on one kernel [s]; the largest take some 10 s of a free processor."""
_FIRST = 'extern "C" void simulate() {}'
"""A kernel that shows whether the compiler works at all, before any process waits for a long one."""
_FIRST_S = 30.0
"""Longest time of a compiler on that [s]; it takes 0.1 s."""
_DIGEST = hashlib.sha256
_TEMPORARY: list[tempfile.TemporaryDirectory] = []
"""Folders of this process, removed at its end."""


Argument = int | torch.Tensor | ctypes.c_void_p
"""What a kernel is launched with."""


class CannotCompileError(RuntimeError):
    """There is no kernel of something: it is done without one."""


class HostKernels:
    """Kernels by their source, each compiled once for a user and a compiler."""

    def __init__(self, compiler: str, folder: OwnFolder, include: str | None = None):
        """With a compiler of C++, a folder of the user's alone that keeps what it has made, and one of headers."""
        self._command = [compiler, *_OPTIONS, *([] if include is None else [f"-I{include}"])]
        info = os.stat(compiler)
        self._key = f"{self._command} {info.st_size} {info.st_mtime_ns}"
        self._folder = folder
        self._waited: dict[str, int] = {}
        self._functions: dict[str, Any] = {}
        self._running: set[subprocess.Popen] = set()
        self._is_stuck = False

    def compile(self, sources: Sequence[str]) -> None:
        """Compile those that are new, side by side.

        A kernel of an earlier process is loaded where its digest is right, and compiled again where it is not.

        Raises:
            CannotCompileError: If the compiler refuses one or does not end, or what it makes cannot be loaded.
        """
        new = [source for source in dict.fromkeys(sources) if source not in self._functions]
        if not new:
            return
        with ThreadPoolExecutor(min(len(new), os.cpu_count() or 1)) as pool:
            try:
                names = list(pool.map(self._compiled, new))
            except BaseException:  # one has failed, or the user has interrupted: the others are not needed
                pool.shutdown(wait=False, cancel_futures=True)
                for process in list(self._running):
                    _end(process)
                raise
        for source, name in zip(new, names, strict=True):
            try:
                self._functions[source] = ctypes.CDLL(self._folder.path_of(name)).simulate
            except (OSError, AttributeError) as error:  # a folder from which nothing may run
                self._folder.remove(name)
                raise CannotCompileError(f"{self._folder.path / name}: {error}") from error

    def launch(self, source: str, threads: int, width: int, arguments: Sequence[Argument]) -> None:
        """Run a compiled kernel over all its joints.

        Args:
            threads: Not used: ``arguments`` hold the number of joints.
            arguments: Tensors, which are handed over by address, and whole numbers.
        """
        self._functions[source](*map(as_argument, arguments))

    def pays(self, source: str, steps: int) -> bool:
        """Whether a source is compiled before so many steps: it was before, or they are many with those before.

        Args:
            steps: Steps that are simulated now: of the physics for a robot, of control for single joints.
        """
        if source in self._functions or self._is_kept(self._name_of(source)):
            return True
        self._waited[source] = self._waited.get(source, 0) + steps
        return self._waited[source] >= _PATIENCE and not self._is_stuck

    def address_of(self, source: str) -> int:
        """Where the function of a compiled one is."""
        return ctypes.cast(self._functions[source], ctypes.c_void_p).value or 0

    def _name_of(self, source: str) -> str:
        return f"{_DIGEST((self._key + source).encode()).hexdigest()}.so"

    def _is_kept(self, name: str) -> bool:
        """Whether a file is the kernel that was compiled under its name: whole, and with its digest at its end."""
        content = self._folder.read(name) or b""
        size = _DIGEST().digest_size
        return len(content) > size and content[-size:] == _digest_of(name, content[:-size])

    def _compiled(self, source: str) -> str:
        """The name of a source's kernel in the folder."""
        name = self._name_of(source)
        if not self._is_kept(name):
            try:
                binary = self._run_compiler(source)
                self._folder.write(name, binary + _digest_of(name, binary))
            except OSError as error:
                raise CannotCompileError(f"{self._command[0]}: {error}") from error
        return name

    def _run_compiler(self, source: str) -> bytes:
        limit = _FIRST_S if source == _FIRST else _LONGEST_S
        if self._is_stuck:
            raise CannotCompileError(f"{self._command[0]} did not end before")
        with tempfile.TemporaryDirectory(prefix="pace_compiler_") as folder:
            target = Path(folder) / "kernel.so"
            with subprocess.Popen(
                [*self._command, "-", "-o", str(target)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                start_new_session=True,  # a compiler is several processes, which are ended together
            ) as process:
                self._running.add(process)
                try:
                    _, said = process.communicate(source.encode(), timeout=limit)
                except subprocess.TimeoutExpired:
                    self._tell_stuck(limit)
                    raise CannotCompileError(f"{self._command[0]} has not ended after {limit:g} s") from None
                finally:
                    _end(process)
                    self._running.discard(process)
            if process.returncode:
                raise CannotCompileError(f"{self._command[0]}: {said.decode(errors='replace')[-500:]}")
            return target.read_bytes()

    def _tell_stuck(self, limit: float) -> None:
        if not self._is_stuck:
            self._is_stuck = True
            warnings.warn(
                f"The compiler {self._command[0]} has not ended after {limit:g} s: the simulation continues without "
                "compiled kernels, more slowly. Repair it, or put another one first in PATH. [W21]",
                stacklevel=2,
            )


def as_argument(value: Argument) -> ctypes.c_void_p | ctypes.c_int:
    """Tensors are handed over by address, whole numbers by value."""
    if isinstance(value, torch.Tensor):
        return ctypes.c_void_p(value.data_ptr())
    return ctypes.c_int(value) if isinstance(value, int) else value


def _end(process: subprocess.Popen) -> None:
    """End a process that still runs, and those that it started."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def _digest_of(name: str, binary: bytes) -> bytes:
    return _DIGEST(name.encode() + binary).digest()


@cache
def host_kernels() -> HostKernels | None:
    """The kernels of the processor; ``None`` where no compiler of C++ is installed, or it does not work."""
    return _kernels(None)


@cache
def mujoco_kernels() -> HostKernels | None:
    """The same for kernels that step MuJoCo themselves; ``None`` also where MuJoCo has no headers."""
    import mujoco

    include = Path(mujoco.HEADERS_DIR).parent
    return _kernels(str(include)) if (include / "mujoco" / "mujoco.h").exists() else None


def _kernels(include: str | None) -> HostKernels | None:
    if (compiler := _compiler()) is None:
        return None
    kernels = HostKernels(compiler, _own_folder(), include)
    try:
        kernels.compile([_FIRST])
    except CannotCompileError:
        return None
    return kernels


def _compiler() -> str | None:
    """The machine's compiler; one of the present folder, which a relative PATH names, is not the machine's.

    Systems that know no owners of files (Windows) have no place for what it makes.
    """
    if not hasattr(os, "getuid"):
        return None
    found = (shutil.which(name) for name in _COMPILERS)
    return next((path for path in found if path is not None and os.path.isabs(path)), None)


def _own_folder() -> OwnFolder:
    """A private folder of the user: a kept one if possible, else one for this process."""
    if (kept := OwnFolder.below("XDG_CACHE_HOME", ".cache", "pace", "kernels")) is not None:
        return kept
    _TEMPORARY.append(tempfile.TemporaryDirectory(prefix="pace_kernels_"))
    return OwnFolder.at(Path(_TEMPORARY[-1].name).resolve())
