"""What went wrong, in a sentence: bad input, code of the user's own, too little memory, a full disk, our own fault."""

from __future__ import annotations

import re
import sys
import sysconfig
import traceback
from pathlib import Path

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
