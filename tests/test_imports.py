"""Imports run one way: pace_actuators <- pace_envs <- pace_optim <- scripts."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

DOWNSTREAM = {
    "assets": {"pace_actuators", "pace_envs", "pace_optim", "scripts", "tests"},
    "pace_actuators": {"pace_assets", "pace_envs", "pace_optim", "scripts", "tests"},
    "pace_envs": {"pace_optim", "scripts", "tests"},
    "pace_optim": {"scripts", "tests"},
    "scripts": {"tests"},
}
"""Folder -> what none of its files may import."""

FLOORS = {
    "pace_optim": (
        ["terminal", "recording", "excitation"],
        ["robot_logs", "plant", "export", "measured_effort", "one_kernel"],
        ["problem"],
        ["optimizers", "single_joint_model"],
        ["uncertainty"],
        ["run", "experiment_design", "single_joint_fits"],
        ["report", "data_collection"],
        ["comparison"],
        ["log_checks"],
        ["identification"],
        ["diagnosis"],
        ["commands"],
    ),
    "pace_optim/diagnosis": (
        ["diagnosis_cfg"],
        ["settings"],
        ["candidates"],
        ["judging"],
        ["beginning", "search"],
        ["verdict"],
        ["telling"],
        ["method"],
        ["diagnose"],
    ),
    "pace_optim/diagnosis/search": (
        ["state"],
        ["one_round", "pooling", "replace_effect"],
        ["carried_links"],
        ["grow"],
        ["look_ahead"],
        ["search"],
    ),
}
"""Package -> its rooms, from the ground up: a room imports from below and from beside, never from above."""

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


@pytest.mark.parametrize("path", files_of(*DOWNSTREAM))
def test_no_file_imports_what_lies_downstream(path):
    against = imported_roots((ROOT / path).read_text(encoding="utf-8")) & DOWNSTREAM[path.split("/")[0]]
    assert not against, (
        f"{path} imports {sorted(against)}, against pace_actuators <- pace_envs <- pace_optim <- scripts"
    )


def imported_modules(source: str) -> set[str]:
    """Full names of what a file imports absolutely, of modules and of what it takes from them."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


@pytest.mark.parametrize("package", FLOORS)
def test_every_room_has_its_floor(package):
    rooms = {path.stem for path in (ROOT / package).iterdir() if path.is_dir() or path.suffix == ".py"}
    assert rooms - {"__init__", "__pycache__", "py"} == {room for floor in FLOORS[package] for room in floor}


@pytest.mark.parametrize(
    ("package", "path"), [(package, path) for package in FLOORS for path in files_of(package)], ids=str
)
def test_no_room_imports_from_a_floor_above(package, path):
    height = {room: i for i, floor in enumerate(FLOORS[package]) for room in floor}
    own = Path(path).relative_to(package).parts[0].removesuffix(".py")
    if own == "__init__":
        return
    prefix = package.replace("/", ".") + "."
    for module in imported_modules((ROOT / path).read_text(encoding="utf-8")):
        room = module.removeprefix(prefix).split(".")[0] if module.startswith(prefix) else own
        assert height.get(room, 0) <= height[own], f"{path} imports {module}, from a floor above its own"


@pytest.mark.parametrize("path", files_of("pace_actuators"))
def test_actuators_need_torch_alone(path):
    allowed = ACTUATORS_MAY_IMPORT | {ADAPTERS.get(path, "torch")}
    foreign = imported_roots((ROOT / path).read_text(encoding="utf-8")) - allowed
    assert not foreign, f"{path} imports {sorted(foreign)}; whoever trains a policy installs torch and nothing else"


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
