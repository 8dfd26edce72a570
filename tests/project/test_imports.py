"""Imports run one way: pace_actuators <- pace_envs <- pace_optim <- scripts."""

import ast
import subprocess
import sys
from collections.abc import Callable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from places import ROOT

DOWNSTREAM = {
    "assets": {"pace_actuators", "pace_envs", "pace_optim", "scripts", "tests"},
    "pace_actuators": {"pace_assets", "pace_envs", "pace_optim", "scripts", "tests"},
    "pace_envs": {"pace_optim", "scripts", "tests"},
    "pace_optim": {"scripts", "tests"},
    "scripts": {"tests"},
}
"""Folder -> what none of its files may import."""

ACTUATORS_MAY_IMPORT = {*sys.stdlib_module_names, "torch", "pace_actuators"}
ADAPTERS = {"pace_actuators/mjlab.py": "mjlab", "pace_actuators/isaaclab.py": "isaaclab"}
"""The two files that may import one framework more."""


def imported_roots(source: str) -> set[str]:
    """Top-level names that a file imports from outside its own package, at whatever depth of its code."""
    roots = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            roots |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            roots.add((node.module or "").split(".")[0])
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if called in ("import_module", "__import__") and not str(node.args[0].value).startswith("."):
                roots.add(str(node.args[0].value).split(".")[0])
    return roots


def files_of(*folders: str) -> list[str]:
    return sorted(p.relative_to(ROOT).as_posix() for f in folders for p in (ROOT / f).rglob("*.py"))


@pytest.mark.parametrize(
    ("source", "roots"),
    [
        ("import torch.nn as nn, pace_optim", {"torch", "pace_optim"}),
        ("from pace_envs.mdp import joint_pos_rel", {"pace_envs"}),
        ("def f():\n    from pace_optim import fit", {"pace_optim"}),
        ("import importlib\nimportlib.import_module('pace_optim.identification.fit')", {"importlib", "pace_optim"}),
        ("from . import effects\nfrom .effects import base", set()),
    ],
)
def test_every_form_of_import_is_seen(source, roots):
    assert imported_roots(source) == roots


def foreign(paths: list[str], is_wrong: Callable[[str, str], bool]) -> list[str]:
    """What files import that they may not."""
    roots = {path: imported_roots((ROOT / path).read_text(encoding="utf-8")) for path in paths}
    return [f"{path} imports {root}" for path in paths for root in sorted(roots[path]) if is_wrong(path, root)]


@pytest.mark.slow
@pytest.mark.parametrize("folder", DOWNSTREAM)
def test_no_file_imports_what_lies_downstream(folder):
    """Imports run one way: pace_actuators <- pace_envs <- pace_optim <- scripts."""
    assert foreign(files_of(folder), lambda _, root: root in DOWNSTREAM[folder]) == []


def run_at_import(node: ast.AST) -> Iterator[ast.AST]:
    """What runs while a module is imported: all but functions, and what is there for types."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        if not isinstance(child, ast.FunctionDef):
            yield child
            yield from run_at_import(child)


def imported_modules(path: str) -> set[str]:
    """Full names of what a file imports, of modules and of what it takes from them.

    In ``pace_optim`` every import counts. Below, what only a type or a function names may be a file that comes later.
    """
    found, folder = set(), Path(path).parent.parts
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    for node in run_at_import(tree) if path.startswith(("pace_actuators/", "pace_envs/")) else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = folder[: len(folder) - node.level + 1] if node.level else ()
            module = ".".join([*above, *filter(None, [node.module])])
            found |= {f"{module}.{alias.name}" for alias in node.names}
    return found


def rooms_of(package: str) -> dict[str, set[str]]:
    """What each room of a package (a folder or a file in it) imports of the other rooms."""
    prefix, rooms = package.replace("/", ".") + ".", {}
    for path in files_of(package):
        own = Path(path).relative_to(package).parts[0].removesuffix(".py")
        if own != "__init__":  # which is there for those outside
            taken = {m.removeprefix(prefix).split(".")[0] for m in imported_modules(path) if m.startswith(prefix)}
            rooms.setdefault(own, set()).update(taken - {own})
    return {room: taken & set(rooms) for room, taken in rooms.items()}


PACKAGES = sorted({str(Path(path).parent) for path in files_of("pace_actuators", "pace_envs", "pace_optim")})


@pytest.mark.slow
@pytest.mark.parametrize("package", PACKAGES)
def test_the_rooms_of_a_package_have_an_order(package):
    """No arrow up: there is an order in which each room imports from rooms before it alone."""
    try:
        list(TopologicalSorter(rooms_of(package)).static_order())
    except CycleError as error:
        pytest.fail(f"{package} imports in a circle: {' -> '.join(error.args[1])}")


def test_a_room_that_imports_upwards_is_seen(tmp_path, monkeypatch):
    for name, text in {"low": "from ..house import high", "high": "import house.low.part"}.items():
        (tmp_path / "house" / name).mkdir(parents=True)
        (tmp_path / "house" / name / "part.py").write_text(text.replace("..house", ".."))
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    assert rooms_of("house") == {"low": {"high"}, "high": {"low"}}


def test_actuators_need_torch_alone():
    """Training a policy takes torch and nothing else."""
    paths = files_of("pace_actuators")
    assert foreign(paths, lambda path, root: root not in {*ACTUATORS_MAY_IMPORT, ADAPTERS.get(path)}) == []


def test_importing_the_actuators_loads_no_simulator():
    code = (
        "import sys, pace_actuators\n"
        "unwanted = {'mujoco', 'gymnasium', 'scipy', 'pace_envs', 'pace_optim', 'mjlab', 'isaaclab'}\n"
        "heavy = unwanted & set(sys.modules)\n"
        "sys.exit(f'import pace_actuators loads {sorted(heavy)}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_fit_says_that_it_reads_before_what_is_slow_is_imported():
    code = "import sys; import pace_optim.commands.fit; print(*sorted({'torch', 'mujoco', 'numpy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
