"""What reaches the terminal: text that no name can steer it with, in any encoding, with or without a reader."""

from __future__ import annotations

import codecs
import contextlib
import io
import os
import re
import sys
import unicodedata
from collections.abc import Iterator
from typing import Any, TextIO

_LONGEST_WORD = 300
_PLAIN = {"×": "x", "→": "->", "−": "-", "–": "-", "…": "...", "²": "^2", "³": "^3", "·": "*", "°": " deg", "±": "+/-"}
"""How a terminal without these characters shows them."""
_ERRORS = "pace_plain"


def readable(text: str) -> str:
    """The text with what steers a terminal written out: escapes, bells, changes of direction."""
    if text.isprintable():
        return text
    head = "\r" if text.startswith("\r") else ""  # the progress line's own
    return head + "".join(_shown(c) for c in text[len(head) :])


def one_line(text: str) -> str:
    """The text as one line that can be read; words without an end are cut."""
    line = " ".join(readable(text).split())
    return re.sub(rf"\S{{{_LONGEST_WORD},}}", lambda found: f"{found[0][:80]}…{found[0][-20:]}", line)


@contextlib.contextmanager
def safe_streams() -> Iterator[None]:
    """Let everything in the block print through :func:`readable`, to streams that take any character.

    A stream that is closed swallows what it gets: ``2>&-`` must not let messages run into the output.
    """
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (_Screen(_open(stream)) for stream in before)  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def _open(stream: TextIO | None) -> TextIO:
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8")
    if isinstance(stream, io.TextIOWrapper):
        with contextlib.suppress(ValueError):
            stream.reconfigure(errors=_ERRORS)
    return stream


class _Screen:
    """A text stream that shows what steers a terminal instead of passing it on."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        self._stream.write(readable(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _shown(character: str) -> str:
    if character in "\n\t":
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
