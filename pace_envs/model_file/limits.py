"""Limits on what a model file may take: it is read once in a process that can be ended."""

from __future__ import annotations

import gc
import math
import os
import re
import signal
import time
from collections.abc import Callable
from pathlib import Path

from pace_actuators.memory import available_memory

_LONGEST_S = 10.0
"""Longest time of a processor for reading and compiling a model [s]; the largest robots' take a second."""
_MEMORY = 4e9
"""Most memory for it [bytes]; the largest robots' take a tenth."""
_WAIT = 10.0
"""Longest time of a clock for it, as a multiple of that of a processor."""
_REFUSED = 3
_checked: set[tuple[str, str, int, int]] = set()
"""Files that were within the limits, as long as they are what they were."""


def check_limits(path: Path, read: Callable[[], object], key: str = "") -> None:
    """Refuse a model file that takes too long, or too much memory, such as one that repeats a body 1e8 times.

    MuJoCo cannot be interrupted while it reads. So the file is read in a forked process first, once; other faults of
    the file are left to the next reader. Systems that cannot fork have no such limits.

    Args:
        path: The file.
        read: Reads, compiles and allocates it.
        key: Identifies this way of reading it.

    Raises:
        ValueError: If it is beyond a limit, or ends the process that reads it.
    """
    info = path.stat()
    state = str(path.resolve()), key, info.st_mtime_ns, info.st_size
    if state in _checked or not hasattr(os, "fork"):
        return
    memory = min(_MEMORY, 0.9 * available_memory())
    collects = gc.isenabled()
    gc.disable()  # in the fork, a simulation that is collected would wait for threads that are not there
    try:
        if not (pid := os.fork()):
            _read_in_fork(read, int(memory))
    finally:
        if collects:
            gc.enable()
    status = _end_of(pid)
    if status in (-signal.SIGXCPU, -signal.SIGKILL):
        raise ValueError(
            f"MuJoCo has not read and compiled {path} after {_LONGEST_S:g} s. Look for what the file repeats or sizes "
            "(replicate, composite, flexcomp, size), and make it smaller."
        )
    if status == _REFUSED or status < 0:
        raise ValueError(
            f"The model of {path} does not fit into {memory / 1e9:.2g} GB of memory, or ends MuJoCo. Look for what the "
            "file repeats or sizes (replicate, composite, flexcomp, size, hfield), and make it smaller."
        )
    _checked.add(state)


def _read_in_fork(read: Callable[[], object], memory: int) -> None:
    """The forked process: it never returns."""
    import resource  # systems that fork have it

    status = 0
    try:
        silence = os.open(os.devnull, os.O_WRONLY)
        for descriptor in (1, 2):
            os.dup2(silence, descriptor)
        pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
        most = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(_LONGEST_S), resource.getrlimit(resource.RLIMIT_CPU)[1]))
        signal.signal(signal.SIGXCPU, signal.SIG_DFL)
        read()
    except ValueError as error:  # the next reader names the fault
        status = _REFUSED if re.search("memory|allocate", str(error), re.IGNORECASE) else 0
    except BaseException:
        status = _REFUSED
    finally:
        os._exit(status)


def _end_of(pid: int) -> int:
    """The process' status, negative for the signal that has ended it."""
    until, pause = time.monotonic() + _WAIT * _LONGEST_S, 0.0005
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > until:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return -signal.SIGKILL
        time.sleep(pause)
        pause = min(2 * pause, 0.05)
