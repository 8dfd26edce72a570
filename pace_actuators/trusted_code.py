"""Which code may be imported because a file names it: that which has been named on this machine before.

A record of digests protects from code that has changed, not from a folder of somebody else's that brings its module and
the module's digest along. So the digest of every file of code that a user names, or runs a fit from, is kept under
``$XDG_STATE_HOME/pace`` (``~/.local/state/pace``), where no downloaded folder writes; a record counts for those alone.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable
from pathlib import Path


def trust(digests: Iterable[str]) -> None:
    """Remember code that was named here; where nothing can be kept, it must be named each time.

    Args:
        digests: SHA-256 of its files.
    """
    if not (new := sorted(set(digests) - _trusted())):
        return
    with contextlib.suppress(OSError):
        path = _store()
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with path.open("a", encoding="ascii") as file:
            file.write("".join(f"{digest}\n" for digest in new))


def is_trusted(digest: str) -> bool:
    """Whether code of this SHA-256 has been named here before."""
    return digest in _trusted()


def _trusted() -> set[str]:
    try:
        return set(re.findall(r"^[0-9a-f]{64}$", _store().read_text(encoding="ascii", errors="replace"), re.MULTILINE))
    except OSError:
        return set()


def _store() -> Path:
    """Where they are kept: outside of every folder of runs."""
    state = os.environ.get("XDG_STATE_HOME") or os.environ.get("LOCALAPPDATA") or os.path.expanduser("~/.local/state")
    return Path(state) / "pace" / "named_code.txt"
