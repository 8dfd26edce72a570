"""Which code may be imported because a file names it: that which has been named on this machine before.

A record of digests protects from code that has changed, not from a foreign folder that brings its module and
the module's digest along. So the digest of every file of code that a user names, or runs a fit from, is kept under
``$XDG_STATE_HOME/pace`` (``~/.local/state/pace``), where no downloaded folder writes; a record counts for those alone.
Where that is no absolute path, or not the user's alone (:class:`pace_actuators.files.OwnFolder`), nothing is kept.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable

from pace_actuators.files import OwnFolder

_FILE = "named_code.txt"


def trust(digests: Iterable[str]) -> None:
    """Remember code that was named here; where nothing can be kept, it must be named each time.

    Args:
        digests: SHA-256 of its files.
    """
    if (folder := _folder()) is None:
        return
    with contextlib.suppress(OSError), folder.alone():
        kept = _kept(folder)
        if new := set(digests) - kept:
            folder.write(_FILE, "".join(f"{digest}\n" for digest in sorted(kept | new)).encode())


def is_trusted(digest: str) -> bool:
    """Whether code of this SHA-256 has been named here before."""
    folder = _folder()
    return folder is not None and digest in _kept(folder)


def _kept(folder: OwnFolder) -> set[str]:
    text = (folder.read(_FILE) or b"").decode("ascii", errors="replace")
    return set(re.findall(r"^[0-9a-f]{64}$", text, re.MULTILINE))


def _folder() -> OwnFolder | None:
    """Where they are kept: outside of every folder of runs."""
    return OwnFolder.below("XDG_STATE_HOME", ".local/state", "pace")
