"""How much memory there is, and refusing what would take more before it is asked for."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

_HEADROOM = 0.9
"""Part of the free memory that may be asked for."""


def check_memory(needed: float, what: str, cure: str) -> None:
    """Refuse what would not fit.

    Args:
        needed: Memory that it will take [bytes].
        what: What takes it, as the beginning of a sentence.
        cure: What to ask for instead, a sentence.
    """
    free = available_memory()
    if needed > _HEADROOM * free:
        raise ValueError(f"{what} would take {needed / 1e9:.3g} GB of memory, and {free / 1e9:.3g} GB are free. {cure}")


def available_memory() -> float:
    """Memory that this process can still get [bytes]: the machine's, its container's, its own limit's; the least."""
    return min(_of_machine(), _of_container(), _of_limit())


def _of_machine() -> float:
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024.0 * float(line.split()[1])
    with contextlib.suppress(AttributeError, OSError, ValueError):
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    return float("inf")


def _of_container() -> float:
    """What control groups (version 2, then 1) leave: their limit less what is used and cannot be given back."""
    least = float("inf")
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, controllers, name = line.split(":", 2)
            if controllers == "":
                root, limit, used, cache = Path("/sys/fs/cgroup"), "memory.max", "memory.current", "inactive_file"
            elif "memory" in controllers.split(","):
                root, cache = Path("/sys/fs/cgroup/memory"), "total_inactive_file"
                limit, used = "memory.limit_in_bytes", "memory.usage_in_bytes"
            else:
                continue
            folder = root / name.lstrip("/")
            for each in (folder, *folder.parents):
                least = min(least, _left_in(each, limit, used, cache))
                if each == root:
                    break
    return least


def _left_in(folder: Path, limit: str, used: str, cache: str) -> float:
    try:
        most = (folder / limit).read_text().strip()
        if most == "max":
            return float("inf")
        stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        return max(0.0, float(most) - float((folder / used).read_text()) + float(stat.get(cache, 0)))
    except (OSError, ValueError):
        return float("inf")


def _of_limit() -> float:
    try:
        import resource
    except ImportError:  # not on Windows
        return float("inf")
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    if most == resource.RLIM_INFINITY:
        return float("inf")
    with contextlib.suppress(OSError, ValueError, IndexError):
        return max(0.0, most - float(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize())
    return float(most)
