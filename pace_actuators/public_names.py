"""What a package exports: imported when it is asked for, so that commands start before torch is loaded.

A package lists its public names once, as imports that a type checker sees and Python skips:

    if TYPE_CHECKING:
        from pace_optim.comparison import compare

    __all__ = ["compare"]
    __getattr__ = public_names(__file__)
"""

from __future__ import annotations

import ast
import difflib
import sys
import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

_warned: set[str] = set()


def deprecated(old: str, new: str, removal: str, *, stacklevel: int = 2) -> None:
    """Warn, once per process, that a name has a successor.

    Args:
        old: The name that was used.
        new: What to write instead.
        removal: The release that removes the old name, ``"0.5"``.
        stacklevel: Frames between this call and the user's line, as for :func:`warnings.warn`.
    """
    if old not in _warned:
        _warned.add(old)
        message = f"{old} is deprecated and will be removed in {removal}: write {new} instead."
        warnings.warn(message, DeprecationWarning, stacklevel=stacklevel + 1)


def public_names(init: str, renamed: Mapping[str, tuple[str, str]] | None = None) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package that imports its public names on first use.

    Args:
        init: ``__file__`` of the package, which lists its names under ``if TYPE_CHECKING:``.
        renamed: Old names, each with its successor in the package and the release that removes the old one.
    """
    homes, moved, package = homes_of(Path(init)), renamed or {}, Path(init).parent.name

    def get(name: str) -> Any:
        if name in moved:
            new, removal = moved[name]
            deprecated(f"{package}.{name}", f"{package}.{new}", removal)
            return getattr(sys.modules[package], new)
        if name not in homes:
            close = difflib.get_close_matches(name, [*homes, *moved], n=1) if not name.startswith("_") else []
            meant = f"; did you mean {close[0]}?" if close else ""
            raise AttributeError(f"module {package!r} has no attribute {name!r}{meant}")
        home = homes[name]
        value = import_module(f"{home}.{name}") if home == package else getattr(import_module(home), name)
        setattr(sys.modules[package], name, value)
        return value

    return get


def homes_of(init: Path) -> dict[str, str]:
    """The module of each public name, from the imports under ``if TYPE_CHECKING:`` of a package."""
    return {
        alias.name: node.module or ""
        for block in ast.parse(init.read_text(encoding="utf-8")).body
        if isinstance(block, ast.If) and getattr(block.test, "id", "") == "TYPE_CHECKING"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
