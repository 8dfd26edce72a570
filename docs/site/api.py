"""docs/api.md: every public name with one line. ``python docs/site/api.py > docs/api.md`` writes it."""

from __future__ import annotations

import ast
import inspect
import re
import sys
from importlib import import_module
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = {
    "pace_optim": "Fit, compare, diagnose: recordings in, parameters and missing effects out.",
    "pace_envs": "Robots as batched environments, tasks, training.",
    "pace_actuators": "The drive and its effects. It needs torch alone.",
}
_HEAD = """# Public names

Import these from the package itself: `from pace_optim import fit`. Versioning covers these names, the command lines and
the files of a run; everything deeper may move. Terms of the managers are in `pace_envs.mdp`, the adapters in
`pace_actuators.mjlab` and `pace_actuators.isaaclab`. `python docs/site/api.py > docs/api.md` makes this page.
"""
_ROLE = re.compile(r":\w+:`~?([^`]+)`")


def page() -> str:
    """The page, from the first lines of the docstrings."""
    text = [_HEAD]
    for package, about in PACKAGES.items():
        text.append(f"\n## {package}\n\n{about}\n\n| name | what it is |\n|---|---|\n")
        text += [f"| `{name}` | {line} |\n" for name, line in lines_of(package).items()]
    return "".join(text)


def lines_of(package: str) -> dict[str, str]:
    """The first line of each public name's documentation."""
    from pace_actuators.public_names import homes_of

    module = import_module(package)
    homes = homes_of(ROOT / package / "__init__.py")
    return {name: _line(getattr(module, name), homes.get(name, package), name) for name in sorted(module.__all__)}


def _line(value: object, home: str, name: str) -> str:
    documented = inspect.isclass(value) or inspect.isroutine(value) or inspect.ismodule(value)
    text = inspect.getdoc(value) if documented else _below_assignment(home, name)
    line = re.split(r"\n\n", text or "", maxsplit=1)[0].replace("\n", " ")
    return _ROLE.sub(r"`\1`", line).replace("``", "`").replace("|", "\\|")


def _below_assignment(module: str, name: str) -> str:
    """The string under a constant's assignment, which documents it."""
    body = ast.parse(inspect.getsource(import_module(module))).body
    for statement, after in pairwise(body):
        targets = getattr(statement, "targets", [getattr(statement, "target", None)])
        if any(getattr(target, "id", "") == name for target in targets) and isinstance(after, ast.Expr):
            return str(ast.literal_eval(after.value))
    return ""


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    print(page(), end="")
