"""What all command lines share: options that read well, and errors of one line.

def main() -> None:
    parser = make_parser("Does this.", example="scripts/this.py --task Pace-AnymalD-v0")
    ...

if __name__ == "__main__":
    sys.exit(run_cli(main))
"""

from __future__ import annotations

import argparse
import codecs
import contextlib
import difflib
import io
import os
import re
import sys
import sysconfig
import traceback
import unicodedata
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn, TextIO

from pace_optim.terminal.progress import end_line

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

    Each write is one line. A line break inside it came with a foreign name or text and is written as an escape. So
    foreign text cannot begin a new line, such as ``run: …``. Print several lines with ``print(*lines, sep="\n")``. A
    closed stream swallows its input: ``2>&-`` must not let messages run into the output.
    """
    before = sys.stdout, sys.stderr, warnings.formatwarning
    sys.stdout, sys.stderr = (_Screen(_open(stream)) for stream in before[:2])  # type: ignore[assignment]
    warnings.formatwarning = _formatted  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.stdout, sys.stderr, warnings.formatwarning = before


def _formatted(message: Warning | str, *_: Any, **__: Any) -> str:
    end_line()
    return f"warning: {message}\n"


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


_OURS = ("pace_actuators", "pace_envs", "pace_optim", "scripts", "benchmarks", "tests")
_NO_MEMORY = re.compile(r"allocate memory|bad_alloc|bad allocation|[Cc]ould not allocate|out of memory", re.DOTALL)


def is_of_input(error: BaseException) -> bool:
    """Whether the user can mend it."""
    is_input = isinstance(error, ValueError | KeyError | OSError | MemoryError)
    return is_input or lacks_memory(error) or _is_loop(error)


def _is_loop(error: BaseException) -> bool:
    """Whether a path is a link to itself: Python 3.11 and 3.12 have a RuntimeError for it where they resolve one."""
    return isinstance(error, RuntimeError) and str(error).startswith("Symlink loop from ")


def lacks_memory(error: BaseException) -> bool:
    """Whether memory was asked for that there is not."""
    return isinstance(error, MemoryError) or bool(_NO_MEMORY.search(str(error)))


def sentence(error: BaseException) -> str:
    """What to say of an error, without its type where the text says it all."""
    own = own_code(error)
    if lacks_memory(error):
        from pace_actuators.memory import available_memory  # with torch: a command that begins has no need of it

        text = f"there is not enough memory ({_text(error)}); {available_memory() / 1e9:.3g} GB are free. "
        text += "Ask for fewer --num_envs, or for shorter or fewer recordings."
    elif is_of_input(error):
        text = _text(error)
        if isinstance(error, KeyError) and error.args and " " not in str(error.args[0]):
            text = f"there is no {text!r}"
    elif own is None:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return (
            f"this is a fault of the program, not of your input ({type(error).__name__}: {_text(error)}; "
            f"{Path(where.filename).name}:{where.lineno}). PACE_TRACEBACK=1 in the environment shows all of it."
        )
    else:
        text = f"{type(error).__name__}: {_text(error)}"
    return text if own is None else f"{own}: {text}"


def own_code(error: BaseException) -> str | None:
    """Where in a user's own code an error arose: file, line and function, and the effect; ``None`` if elsewhere.

    What this project says of bad input stands for itself, though own code may have called it.
    """
    found, trace = None, error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if _is_own(code.co_filename):
            owner = trace.tb_frame.f_locals.get("self")
            name = "" if owner is None else f"{getattr(owner, 'name', None) or type(owner).__name__}."
            found = f"{code.co_filename}:{trace.tb_lineno}, in {name}{code.co_name}"
        elif _is_ours(code.co_filename) and is_of_input(error):
            found = None
        trace = trace.tb_next
    return found


def _is_ours(filename: str) -> bool:
    here = Path(__file__).resolve().parents[2]
    path = Path(filename).resolve()
    return path.is_relative_to(here) and path.relative_to(here).parts[0] in _OURS


def _is_own(filename: str) -> bool:
    if filename.startswith("<") or _is_ours(filename):
        return False
    path = Path(filename).resolve()
    libraries = {sys.prefix, sys.base_prefix, *sysconfig.get_paths().values()}
    return "site-packages" not in path.parts and not any(path.is_relative_to(Path(each)) for each in libraries)


def _text(error: BaseException) -> str:
    if isinstance(error, KeyError) and error.args:
        return str(error.args[0])  # str(KeyError) is a repr
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return (str(error) or type(error).__name__)[:2000]


FAULT = 1
USER_ERROR = 2
INTERRUPTED = 130
_CONSOLE = "pace "
"""What the name of the program begins with where the console command was called."""


def run_cli(main: Callable[[], int | None]) -> int:
    """Run a command; return its exit code.

    An error that the user can correct (ValueError, KeyError, OSError, too little memory, custom code) is printed to
    stderr as one line, ``error: ...``, with exit code 2. A fault of the program exits with 1, an interruption with 130.
    With ``PACE_TRACEBACK=1`` in the environment errors keep their traceback.
    """
    with safe_streams():
        return _run(main)


def _run(main: Callable[[], int | None]) -> int:
    try:
        status = main() or 0
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        end_line()
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone, as `head` does
        _drop_output()
        return 0
    except Exception as error:
        if os.environ.get("PACE_TRACEBACK"):
            raise
        _drop_output(unless_it_can=True)
        end_line()
        print(f"error: {one_line(as_called(sentence(error)))}", file=sys.stderr)
        return USER_ERROR if is_of_input(error) or own_code(error) else FAULT


def _drop_output(*, unless_it_can: bool = False) -> None:
    """Write what is left of the output nowhere: the interpreter would try, and complain, when it ends."""
    try:
        if unless_it_can:
            sys.stdout.flush()
            return
    except (OSError, ValueError):
        pass
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def command(verb: str) -> str:
    """How the user calls a command: ``pace fit`` where this one was called so, else ``scripts/fit.py``."""
    return as_called(f"scripts/{verb}.py")


SPELT = {"import_log": "import"}
"""Verbs of the console command whose module has another name."""


def spelt(verb: str) -> str:
    """A command's verb, by the name of its module."""
    return SPELT.get(verb, verb).replace("_", "-")


def as_called(text: str) -> str:
    """The text with the commands in it as the user calls them."""
    if not sys.argv[0].startswith(_CONSOLE):
        return text
    return re.sub(r"scripts/(\w+)\.py", lambda found: _CONSOLE + spelt(found[1]), text)


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line and say what was probably meant."""

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print a text of argparse, which is several lines."""
        print(*message.removesuffix("\n").split("\n"), sep="\n", file=file or sys.stderr)

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with 2."""
        if message.startswith("unrecognized arguments: "):
            known = [option for action in self._actions for option in action.option_strings]
            for word in message.removeprefix("unrecognized arguments: ").split():
                option = word.partition("=")[0]
                if option.startswith("-") and (
                    close := difflib.get_close_matches(option.replace("-", "_"), [k.replace("-", "_") for k in known])
                ):
                    match = next(k for k in known if k.replace("-", "_") == close[0])
                    message += f"; did you mean {match} instead of {option}?"
        print(f"error: {one_line(message).rstrip('.')}. See {self.prog} --help.", file=sys.stderr)
        raise SystemExit(USER_ERROR)


def given_options(parser: argparse.ArgumentParser) -> list[str]:
    """The options that stand on the command line, by their names."""
    words = [word.partition("=")[0] for word in sys.argv[1:]]
    known = [option for action in parser._actions for option in action.option_strings]
    return [word for word in dict.fromkeys(words) if word in known]


def make_parser(description: str, *, example: str) -> Parser:
    """A parser whose ``--help`` ends with an example."""
    return Parser(
        prog=sys.argv[0] if sys.argv[0].startswith(_CONSOLE) else None,
        description=as_called(description),
        epilog=as_called(f"example:\n  {example}"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
