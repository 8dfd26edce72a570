"""What reaches the terminal: text that no name can steer it with, in any encoding, with or without a reader."""

from __future__ import annotations

import codecs
import contextlib
import io
import os
import re
import sys
import unicodedata
import warnings
from collections.abc import Iterator
from typing import Any, TextIO

_LONGEST_WORD = 300
_PLAIN = {"×": "x", "→": "->", "−": "-", "–": "-", "…": "...", "²": "^2", "³": "^3", "·": "*", "°": " deg", "±": "+/-"}
"""How a terminal without these characters shows them."""
_ERRORS = "pace_plain"


def readable(text: str) -> str:
    """The text with what steers a terminal written out: ends of lines, escapes, bells, changes of direction."""
    return text if text.isprintable() else "".join(map(_shown, text))


def one_line(text: str) -> str:
    """The text as one line that can be read; words without an end are cut."""
    line = readable(" ".join(text.split()))
    return re.sub(rf"\S{{{_LONGEST_WORD},}}", lambda found: f"{found[0][:80]}…{found[0][-20:]}", line)


@contextlib.contextmanager
def safe_streams() -> Iterator[None]:
    r"""Let everything in the block print through :func:`readable`, to streams that take any character.

    What is written at once is one line, which may end: the end of a line within it came with a name or a text of
    somebody else's, and is written out. So nothing foreign can begin a line of its own, such as ``run: …``. Print
    several lines with ``print(*lines, sep="\n")``. A stream that is closed swallows what it gets: ``2>&-`` must not
    let messages run into the output.
    """
    before = sys.stdout, sys.stderr, warnings.formatwarning
    sys.stdout, sys.stderr = (_Screen(_open(stream)) for stream in before[:2])  # type: ignore[assignment]
    warnings.formatwarning = lambda message, *_, **__: f"warning: {message}\n"  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.stdout, sys.stderr, warnings.formatwarning = before


def _open(stream: TextIO | None) -> TextIO:
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8")
    if isinstance(stream, io.TextIOWrapper):
        with contextlib.suppress(ValueError):
            stream.reconfigure(errors=_ERRORS)
    return stream


class _Screen:
    """A text stream that shows what steers a terminal instead of passing it on; a line, or a part of one, at a time."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        line = text.removesuffix("\n")
        shown = line if line == "\r" else readable(line)  # alone it is the progress line's own
        self._stream.write(shown + text[len(line) :])
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _shown(character: str) -> str:
    if character == "\t":
        return character
    if unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp"):
        return character.encode("unicode_escape").decode() if character < "\ud800" else f"\\u{ord(character):04x}"
    return character


def _in_plain_letters(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    return "".join(_PLAIN.get(c, f"\\u{ord(c):04x}") for c in text), error.end


codecs.register_error(_ERRORS, _in_plain_letters)
