"""Worker processes that keep out of each other's way."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.pool import Pool
from multiprocessing.queues import SimpleQueue

import torch

from pace_optim.terminal.parallel import end_with_parent


@contextmanager
def pinned_pool(workers: int) -> Iterator[Pool]:
    """A pool whose workers have processors of their own, which their threads and child processes keep to.

    Args:
        workers: Number of processes; processors are shared out among them.
    """
    context = multiprocessing.get_context("spawn")
    processors = sorted(os.sched_getaffinity(0))
    shares: SimpleQueue[list[int]] = context.SimpleQueue()
    for i in range(workers):
        shares.put(processors[i::workers] or [processors[i % len(processors)]])
    with context.Pool(workers, _start, (shares,)) as pool:
        yield pool


def _start(shares: SimpleQueue[list[int]]) -> None:
    end_with_parent()
    os.sched_setaffinity(0, shares.get())
    torch.set_num_threads(1)
