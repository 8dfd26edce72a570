"""What all command lines share: options that read well, and errors of one line.

def main() -> None:
    parser = make_parser("Does this.", example="scripts/this.py --task Pace-AnymalD-v0")
    ...

if __name__ == "__main__":
    sys.exit(run_cli(main))
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import os
import re
import sys
from collections.abc import Callable
from typing import Any, NoReturn

from pace_optim.terminal.faults import is_of_input, own_code, sentence
from pace_optim.terminal.screen import one_line, safe_streams

FAULT = 1
USER_ERROR = 2
INTERRUPTED = 130
_CONSOLE = "pace "
"""What the name of the program begins with where the console command was called."""


def run_cli(main: Callable[[], int | None]) -> int:
    """Run a command; return its exit code.

    What a user can mend (ValueError, KeyError, OSError, too little memory, code of the user's own) is printed to
    stderr as one line, ``error: ...``, and exits with 2; a fault of the program exits with 1, an interruption with 130.
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
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone, as `head` does
        _drop_output()
        return 0
    except Exception as error:
        if os.environ.get("PACE_TRACEBACK"):
            raise
        _drop_output(unless_it_can=True)
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


def as_called(text: str) -> str:
    """The text with the commands in it as the user calls them."""
    if not sys.argv[0].startswith(_CONSOLE):
        return text
    return re.sub(r"scripts/(\w+)\.py", lambda found: _CONSOLE + found[1].replace("_", "-"), text)


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
