"""Work shared out among forked processes.

The torque law of a few hundred rows costs its calls, not its numbers, so that threads inside a call gain nothing.
"""

from __future__ import annotations

import ctypes
import gc
import io
import multiprocessing
import os
import pickle
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import TypeVar

import torch

from pace_actuators.effects import Effect
from pace_envs.simulation import available_processors

Item = TypeVar("Item")
Result = TypeVar("Result")

_PR_SET_PDEATHSIG = 1
"""Of Linux's prctl: the signal that a process gets when its parent dies."""


def parallel_map(
    work: Callable[[list[Item]], list[Result]],
    items: Sequence[Item],
    effects: Sequence[type[Effect] | None] | None = None,
) -> list[Result]:
    """``work(items)``, with the items shared out among as many processes as there are processors.

    Processes are forked, so that nothing but results is pickled; where that is unsafe (other systems than Linux), and
    in worker processes, one process does it all. Items must not influence each other.

    Args:
        work: Gives one result per item, in order.
        effects: The effect of each item; items of one effect stay together. ``None``: each item is on its own.

    Raises:
        RuntimeError: If a process ended without a result.
    """
    count = _processes()
    shares = _shares(range(len(items)) if effects is None else effects, count)
    if len(shares) < 2:
        return work(list(items))
    results: list[Result | None] = [None] * len(items)
    with _own_processors(len(shares)) as processors:
        others: list[_Other] = []
        try:
            for own_processors, share in zip(processors[1:], shares[1:], strict=True):
                others.append(_Other(work, [items[i] for i in share], own_processors))
            own = work([items[i] for i in shares[0]])
            parts = [own, *(other.result() for other in others)]
        finally:
            for other in others:
                other.end()
    for share, part in zip(shares, parts, strict=True):
        for i, result in zip(share, part, strict=True):
            results[i] = result
    return results  # type: ignore[return-value]


def _processes() -> int:
    forks = sys.platform == "linux" and multiprocessing.parent_process() is None
    return available_processors() if forks else 1


def _shares(groups: Sequence[object], count: int) -> list[list[int]]:
    """Indices for each process, about as many for each; those of one group together, the largest dealt out first."""
    members: dict[object, list[int]] = {}
    for i, group in enumerate(groups):
        members.setdefault(group, []).append(i)
    shares: list[list[int]] = [[] for _ in range(min(count, len(members)))]
    for own in sorted(members.values(), key=len, reverse=True):
        min(shares, key=len).extend(own)
    return shares


@contextmanager
def _own_processors(count: int) -> Iterator[list[set[int]]]:
    """Processors for each process; this one keeps to the first while the context lasts."""
    every = os.sched_getaffinity(0)
    processors = [set(sorted(every)[k::count]) or every for k in range(count)]
    os.sched_setaffinity(0, processors[0])
    try:
        yield processors
    finally:
        os.sched_setaffinity(0, every)


@contextmanager
def _no_collection() -> Iterator[None]:
    """Collect no garbage; a process that is forked meanwhile never does."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class _Other:
    """A share of the work in a separate process."""

    def __init__(self, work: Callable[[list[Item]], list[Result]], share: list[Item], processors: set[int]):
        context = multiprocessing.get_context("fork")
        self._receiver, sender = context.Pipe(duplex=False)
        self._process = context.Process(target=_run, args=(work, share, processors, sender), daemon=True)
        with _no_collection():  # in the fork, a simulation that is collected would wait for threads that are not there
            self._process.start()
        sender.close()

    def result(self) -> list:
        """What it found, or its error."""
        try:
            result = _Unpickler(io.BytesIO(self._receiver.recv_bytes())).load()
        except EOFError:
            self._process.join()
            raise RuntimeError(
                f"A process that shared the work ended without a result (exit code {self._process.exitcode}; -9 mostly "
                "means that memory has run out). Close other programs, or use one processor (taskset -c 0 python ...)."
            ) from None
        if isinstance(result, BaseException):
            raise result
        return result

    def end(self) -> None:
        """Stop it, if it still runs; a program's own handlers of signals came along and must not run."""
        self._process.kill()
        self._process.join()
        self._receiver.close()


def _run(work: Callable, share: list, processors: set[int], sender: Connection) -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process is interrupted and ends the others
    os.sched_setaffinity(0, processors)
    torch.set_num_threads(1)  # threads of the first process did not come along
    try:
        content = _dumped(work(share))
    except Exception as error:
        content = _dumped(_portable(error))
    sender.send_bytes(content)


def end_with_parent() -> None:
    """Let this process die where the one that started it dies; on Linux only."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _dumped(value: object) -> bytes:
    file = io.BytesIO()
    _Pickler(file).dump(value)
    return file.getvalue()


def _portable(error: Exception) -> Exception:
    """The error with where it came from, as one that can be sent."""
    trace = traceback.format_exc()
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # pickle calls what the error's class defines
        return RuntimeError(f"{type(error).__name__}: {error}\n{trace}")
    error.add_note(trace)
    return error


class _Pickler(pickle.Pickler):
    """Sends effects by address, which is the same in both processes: a user's class may be defined anywhere."""

    def persistent_id(self, obj: object) -> int | None:
        return id(obj) if isinstance(obj, type) and issubclass(obj, Effect) else None


class _Unpickler(pickle.Unpickler):
    """Gets them back."""

    def persistent_load(self, pid: int) -> type[Effect]:
        every: list[type[Effect]] = [Effect, *_subclasses(Effect)]
        return next(effect for effect in every if id(effect) == pid)


def _subclasses(effect: type[Effect]) -> Iterator[type[Effect]]:
    for each in effect.__subclasses__():
        yield each
        yield from _subclasses(each)
