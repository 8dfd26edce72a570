"""The command lines: ``pace VERB …`` is the ``main`` of the module of that name here, and so is ``scripts/VERB.py``.

Only the called verb is imported. A new file in this folder is a new verb.
"""

from __future__ import annotations

import ast
import difflib
import sys
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pace_optim.terminal.cli import SPELT, USER_ERROR, run_cli, spelt


def main() -> int:
    """The console command ``pace``; returns its exit code."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help"):
        print(*_help(), sep="\n")
        return 0
    if words[0] in ("-V", "--version"):
        print(f"pace-mujoco {package_version()}")
        return 0
    verb = words[0].replace("-", "_")
    verb = next((name for name, other in SPELT.items() if other == verb), verb)
    if verb not in verbs():
        close = difflib.get_close_matches(verb, verbs(), n=1)
        meant = f"; did you mean {spelt(close[0])}?" if close else "."
        print(f"error: there is no command {words[0]!r}{meant} See pace --help.", file=sys.stderr)
        return USER_ERROR
    sys.argv = [f"pace {spelt(verb)}", *words[1:]]
    return run_cli(import_module(f"{__name__}.{verb}").main)


def verbs() -> dict[str, str]:
    """What each command does, by the name of its module; nothing is imported to find out."""
    return {file.stem: _first_line(file) for file in sorted(Path(__file__).parent.glob("[a-z]*.py"))}


def package_version() -> str:
    """Version of this package; ``unknown`` in a checkout that was not installed."""
    try:
        return version("pace-mujoco")
    except PackageNotFoundError:
        return "unknown"


def _first_line(file: Path) -> str:
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]


def _help() -> list[str]:
    width = max(len(verb) for verb in verbs())
    lines = [f"  {spelt(verb):<{width}}  {what}" for verb, what in verbs().items()]
    return [
        "usage: pace VERB [options]; pace VERB --help says more",
        "",
        "Identify a robot's drives from recordings, find the effect that is missing, train with the result.",
        "",
        *lines,
        "",
        "example:",
        "  pace fit --task Pace-AnymalD-v0",
    ]
