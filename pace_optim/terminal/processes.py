"""The processes that share a job, started by torchrun: who does which part, and who writes."""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist

from pace_envs.lost_process import told_of_lost_processes

_LOST_AFTER = timedelta(minutes=10)
"""How long a process may be silent before it counts as lost."""
_LEISURE = timedelta(days=30)
"""How long the others wait for the one that writes."""
_at_leisure: dist.ProcessGroup | None = None
"""The same processes, for waiting until the one that writes needs the others."""


@dataclass(frozen=True)
class Processes:
    """Processes that share candidates; one alone, unless :func:`join` has found others."""

    rank: int = 0
    """This one's number."""
    count: int = 1
    """How many there are."""

    @property
    def writes(self) -> bool:
        """Whether this is the one that writes files and prints."""
        return self.rank == 0

    def share(self, size: int) -> slice:
        """This process's part of so many candidates; parts differ by one at most."""
        return slice(size * self.rank // self.count, size * (self.rank + 1) // self.count)

    def owns(self, number: int) -> bool:
        """Whether this process does the piece of work of that number: they go round the processes."""
        return number % self.count == self.rank

    def exchange(self, pieces: Sequence[Any]) -> list[Any]:
        """All pieces, each from the process that owns its number."""
        if self.count == 1:
            return list(pieces)
        own = [piece if self.owns(number) else None for number, piece in enumerate(pieces)]
        every: list[Any] = [None] * self.count
        _together(lambda: dist.all_gather_object(every, own))
        return [every[number % self.count][number] for number in range(len(own))]

    def gather(self, mine: torch.Tensor, size: int) -> torch.Tensor:
        """All rows (size, ...) of which each process has its share."""
        if self.count == 1:
            return mine
        whole = torch.zeros((size, *mine.shape[1:]), dtype=mine.dtype)
        whole[self.share(size)] = mine.cpu()
        _together(lambda: dist.all_reduce(whole))  # each row has one process that is not zero: the sum is exact
        return whole

    def agree(self, value: Any, at_leisure: bool = False) -> Any:
        """What the writing process has, in all of them; ``at_leisure`` the others wait as long as it takes."""
        if self.count == 1:
            return value
        held, group = [value], _at_leisure if at_leisure else None
        _together(lambda: dist.broadcast_object_list(held, src=0, group=group))
        return held[0]


def join(device: str = "cpu") -> tuple[Processes, str]:
    """Find the other processes of a ``torchrun``, and this one's device.

    Args:
        device: ``"cpu"``, or ``"cuda"`` with any number: each process takes the GPU of its local rank.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        return Processes(), device
    global _at_leisure
    own = own_device(device)
    if not dist.is_initialized():  # scores are few numbers: by gloo, which reports a lost process at once
        _together(lambda: dist.init_process_group("gloo", timeout=_LOST_AFTER))
        _at_leisure = dist.new_group(timeout=_LEISURE)
        atexit.register(_leave)
    return Processes(rank=dist.get_rank(), count=dist.get_world_size()), own


def own_device(device: str) -> str:
    """This process's device: of several that torchrun started on a host, each takes the GPU of its local rank."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or not device.startswith("cuda"):
        return device
    return f"cuda:{os.environ.get('LOCAL_RANK', '0')}"


def _leave() -> None:
    """End gloo's threads before the interpreter ends: one that still runs then aborts the process."""
    if dist.is_initialized():
        dist.destroy_process_group()


def _together(action: Callable[[], object]) -> None:
    with told_of_lost_processes():
        action()
