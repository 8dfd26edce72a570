"""Jobs that several processes share: the loss of one prints a line and ends the others."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import torch.distributed as dist

_OF_THE_CONNECTION = re.compile(r"gloo|nccl|connection (closed|reset|refused)|broken pipe", re.IGNORECASE)


@contextmanager
def told_of_lost_processes() -> Iterator[None]:
    """Say in one line that another process of a shared job is gone."""
    try:
        yield
    except RuntimeError as error:  # torch's errors of a backend are such, too
        if not isinstance(error, dist.DistError) and not _OF_THE_CONNECTION.search(str(error)):
            raise
        first = str(error).splitlines()[0]
        raise ValueError(
            f"A process that shares this job was lost ({first}). Its own message says why; --resume goes on from the "
            "last checkpoint."
        ) from None
