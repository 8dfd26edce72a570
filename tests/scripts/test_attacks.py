"""What a stranger gives us runs nothing: 45 attempts through names in generated Python, and through what is kept."""

import ast
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock
from xml.sax.saxutils import quoteattr

import pytest
import torch

from pace_actuators.files import OwnFolder
from pace_actuators.own_code import is_trusted
from pace_envs.compiler import host, host_kernels
from pace_envs.from_model.writing import configuration_text
from pace_envs.generated_python import Call, Word, python_page
from pace_optim.export import export

MARK = "EXECUTED"
PAYLOADS = (
    f'"""\nopen("{MARK}", "w")\n"""',
    f'\\"""; open("{MARK}", "w"); """',
    f"'),open('{MARK}','w'),('",
    f'x\nopen("{MARK}","w")\n',
    f"x\u2028\r\x0copen('{MARK}','w')\\",
    f'{{open("{MARK}","w")}}',
)
"""Each would open a file: through a docstring, a list of texts, a comment, a format."""

ANYTHING = MagicMock()
"""Stands for other simulators' modules; making one takes milliseconds."""

FORMATS = ("cfg", "mjlab", "isaaclab", "newton", "mjlab_native")

_MODEL = """<mujoco model={robot}><compiler angle="radian"/>
<asset><mesh name="shell" file={mesh}/></asset>
<worldbody><body name="upper" pos="0 0 1"><joint name={joint} axis="0 1 0" range="-2 2" actuatorfrcrange="-6 6"/>
<inertial pos="0 0 -0.1" mass="0.6" diaginertia="0.004 0.004 0.001"/>
<body name="lower"><joint name="end" axis="0 1 0"/><geom size="0.02"/>
<body name={body}><geom type="mesh" mesh="shell"/></body></body></body></worldbody>
<keyframe><key name={key} qpos="0.1 0"/></keyframe></mujoco>"""
_URDF = """<robot name={robot}><link name="base"/><link name={body}>
<visual><geometry><mesh filename={mesh}/></geometry></visual>
<inertial><mass value="0.4"/><inertia ixx="2e-3" iyy="2e-3" izz="4e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name={joint} type="revolute"><parent link="base"/><child link={body}/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="6" velocity="9"/></joint></robot>"""
NAMES = {"robot": "arm", "mesh": "shell.stl", "body": "arm", "joint": "hinge", "key": "home"}


def in_xml(text: str) -> str:
    """An attribute's value; what XML cannot hold at all is left out."""
    return quoteattr("".join(c for c in text if c >= " " or c in "\t\n\r"), {"\n": "&#10;", "\r": "&#13;"})


def write_model(path: Path, text: str = _MODEL, **names: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text.format(**{key: in_xml(name) for key, name in (NAMES | names).items()}))
    return path


def write_run(folder: Path, model: Path, joint: str, effect: str = "torque_gain") -> Path:
    """A run on a model file, as anybody could write one."""
    folder.mkdir(parents=True, exist_ok=True)
    joints = [joint, "end"]
    values = {
        name: dict.fromkeys(joints, 0.02) for name in ("armature", "viscous_friction", "friction", "encoder_bias")
    }
    values |= {"delay": {"all": 2.0}, "torque_gain.gain": dict.fromkeys(joints, 1.1)}
    content = {
        "version": 1, "task": str(model), "joint_names": joints, "effects": [effect], "delay_mode": "command",
        "physics_dt": 0.0025, "control_dt": 0.0025, "parameters": values, "delay_s": 0.005, "drive": {},
        "std": {name: dict.fromkeys(of, 0.01) for name, of in values.items()},
    }  # fmt: skip
    (folder / "result.json").write_text(json.dumps(content))
    return folder


def run_page(page: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Do with a page what its reader does; other simulators are not there."""
    for name in ("actuator", "entity", "envs", "envs.mdp", "managers", "managers.event_manager",
                 "managers.scene_entity_config", "tasks"):  # fmt: skip
        monkeypatch.setitem(sys.modules, f"mjlab.{name}", ANYTHING)
    for name in ("mjlab", "pace_actuators.mjlab", "pace_actuators.isaaclab"):
        monkeypatch.setitem(sys.modules, name, ANYTHING)
    exec(compile(page, "page.py", "exec"), {"__name__": "page", "__file__": "page.py"})


def check_page(page: str, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = [ast.unparse(node) for node in ast.walk(ast.parse(page)) if isinstance(node, ast.Call)]
    assert not [call for call in calls if call.startswith("open(")]
    run_page(page, monkeypatch)
    assert not Path(MARK).exists()


CARRIERS: dict[str, Callable[[Path, str], Path]] = {
    "the model's folder": lambda at, bad: write_run(at / "run", write_model(at / bad / "arm.xml"), "hinge"),
    "the model's file": lambda at, bad: write_run(at / "run", write_model(at / f"{bad}.xml"), "hinge"),
    "the run's folder": lambda at, bad: write_run(at / bad, write_model(at / "arm.xml"), "hinge"),
    "a joint": lambda at, bad: write_run(
        at / "run", write_model(at / "arm.xml", joint=bad), in_xml_back(bad), "torque_gain"
    ),
}


def in_xml_back(text: str) -> str:
    """The name that MuJoCo reads of what was written."""
    return "".join(c for c in text if c >= " " or c in "\t\n\r")


def payloads(carrier: str) -> list[str]:
    """MuJoCo opens no file whose path has a backslash."""
    return [bad for bad in PAYLOADS if "\\" not in bad or carrier in (*NAMES, "a joint", "the run's folder")]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("carrier", CARRIERS)
@pytest.mark.parametrize("fmt", FORMATS)
def test_an_exported_page_runs_nothing_of_a_name(fmt, carrier, tmp_path, monkeypatch):
    for number, bad in enumerate(payloads(carrier)):
        check_page(export(CARRIERS[carrier](tmp_path / str(number), bad), fmt).text, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("fmt", ("cfg", "mjlab"))
def test_an_exported_page_runs_nothing_of_an_effect_s_joints(fmt, tmp_path, monkeypatch):
    for number, bad in enumerate(PAYLOADS):
        at = tmp_path / str(number)
        model = write_model(at / "arm.xml", joint=bad)
        pattern = "".join(f"\\x{ord(c):02x}" if ord(c) < 256 else c for c in in_xml_back(bad)).replace("@", ".")
        run = write_run(at / "run", model, in_xml_back(bad), f"torque_gain@(?:{pattern})|end")
        check_page(export(run, fmt).text, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "carrier"),
    [
        *(("xml", each) for each in ("robot", "mesh", "body", "joint", "key", "the model's file", "its folder")),
        *(("urdf", each) for each in ("robot", "mesh", "body", "joint")),
    ],
)
def test_a_robot_s_page_runs_nothing_of_a_name(form, carrier, tmp_path, monkeypatch):
    for number, bad in enumerate(payloads(carrier)):
        at = tmp_path / str(number)
        name, folder = (bad if carrier == "the model's file" else "arm"), (bad if carrier == "its folder" else "x")
        names = {carrier: bad} if carrier in NAMES else {}
        model = write_model(at / folder / f"{name}.{form}", _MODEL if form == "xml" else _URDF, **names)
        check_page(configuration_text(model, at / "mine.py")[0], monkeypatch)


def test_what_is_no_value_is_not_written():
    with pytest.raises(RuntimeError, match="is no name"):
        python_page("X = _X_\n", {"_X_": Word(f"open('{MARK}')")})
    with pytest.raises(RuntimeError, match="is no name"):
        python_page("X = _X_\n", {"_X_": Call(name="f", values={"a=1, b": 2})})
    monkey = type("Text", (str,), {"__repr__": lambda self: f"open('{MARK}', 'w')"})
    with pytest.raises(TypeError, match="Text is no value of a page"):
        python_page("X = _X_\n", {"_X_": monkey("x")})


# --- what is kept: 12 attempts

DOUBLE = 'extern "C" void simulate(double* x) { *x *= 2.0; }'
DIGEST = "ab" * 32


@pytest.fixture(scope="module")
def evil_binary(tmp_path_factory):
    """A kernel that says that it was loaded."""
    if shutil.which("c++") is None:
        pytest.skip("needs a compiler of C++")
    folder = tmp_path_factory.mktemp("evil")
    source = f'#include <cstdio>\n__attribute__((constructor)) void f() {{ fclose(fopen("{MARK}", "w")); }}\n{DOUBLE}'
    words = ["c++", "-shared", "-fPIC", "-x", "c++", "-", "-o", str(folder / "evil.so")]
    subprocess.run(words, input=source.encode(), check=True)
    return (folder / "evil.so").read_bytes()


@pytest.fixture
def evil(evil_binary, tmp_path):
    """The same under the name and with the digest that one of ours would have, of a source that is new each time."""
    source = f"{DOUBLE} // {tmp_path}"
    (tmp_path / "made").mkdir(mode=0o700)
    name = host.HostKernels(shutil.which("c++"), OwnFolder.at(tmp_path / "made"))._name_of(source)
    return SimpleNamespace(source=source, name=name, content=evil_binary + host._digest_of(name, evil_binary))


def plant(base: Path, evil: SimpleNamespace) -> Path:
    """What an attacker puts under a base folder: a kernel, and a digest of code."""
    kernels = base / "pace" / "kernels"
    kernels.mkdir(mode=0o700, parents=True)
    kernels.parent.chmod(0o700)
    (kernels / evil.name).write_bytes(evil.content)
    (base / "pace" / "named_code.txt").write_text(f"{DIGEST}\n")
    return base


def tilde(base, evil, monkeypatch):
    monkeypatch.delenv("HOME")
    for variable, below in (("XDG_CACHE_HOME", ".cache"), ("XDG_STATE_HOME", ".local/state")):
        monkeypatch.delenv(variable, raising=False)
        plant(Path("~") / below, evil)


def here(base, evil, monkeypatch):
    monkeypatch.setenv("HOME", ".")
    for variable, below in (("XDG_CACHE_HOME", ".cache"), ("XDG_STATE_HOME", ".local/state")):
        monkeypatch.delenv(variable, raising=False)
        plant(Path(below), evil)


def relative(base, evil, monkeypatch):
    plant(Path("below"), evil)
    for variable in ("XDG_CACHE_HOME", "XDG_STATE_HOME"):
        monkeypatch.setenv(variable, "below")


def linked_folder(base, evil, monkeypatch):
    plant(base.parent / "theirs", evil)
    base.mkdir()
    (base / "pace").symlink_to(base.parent / "theirs" / "pace")


def linked_kernels(base, evil, monkeypatch):
    plant(base.parent / "theirs", evil)
    (base / "pace").mkdir(mode=0o700, parents=True)
    (base / "pace" / "kernels").symlink_to(base.parent / "theirs" / "pace" / "kernels")


def linked_files(base, evil, monkeypatch):
    theirs = plant(base.parent / "theirs", evil) / "pace"
    (base / "pace" / "kernels").mkdir(mode=0o700, parents=True)
    (base / "pace").chmod(0o700)
    (base / "pace" / "kernels" / evil.name).symlink_to(theirs / "kernels" / evil.name)
    (base / "pace" / "named_code.txt").symlink_to(theirs / "named_code.txt")


def others_write_folder(base, evil, monkeypatch):
    plant(base, evil)
    (base / "pace").chmod(0o770)
    (base / "pace" / "kernels").chmod(0o777)


def others_write_files(base, evil, monkeypatch):
    plant(base, evil)
    (base / "pace" / "kernels" / evil.name).chmod(0o666)
    (base / "pace" / "named_code.txt").chmod(0o622)


def other_digest(base, evil, monkeypatch):
    plant(base, evil)
    path = base / "pace" / "kernels" / evil.name
    path.write_bytes(evil.content[:-1] + bytes([evil.content[-1] ^ 1]))


KERNEL_ATTACKS = (tilde, here, relative, linked_folder, linked_kernels, linked_files, others_write_folder,
                  others_write_files, other_digest)  # fmt: skip
STORE_ATTACKS = (tilde, relative, linked_files)


def at_home(tmp_path, monkeypatch):
    base = tmp_path / "base"
    for variable in ("XDG_CACHE_HOME", "XDG_STATE_HOME"):
        monkeypatch.setenv(variable, str(base))
    return base


@pytest.mark.parametrize("attack", KERNEL_ATTACKS)
def test_no_kernel_is_loaded_that_we_have_not_compiled(attack, evil, tmp_path, monkeypatch):
    attack(at_home(tmp_path, monkeypatch), evil, monkeypatch)
    kernels = host_kernels.__wrapped__()
    kernels.compile([evil.source])
    value = torch.tensor(21.0, dtype=torch.float64)
    kernels.launch(evil.source, 1, 1, [value])
    assert float(value) == 42.0 and not Path(MARK).exists()


@pytest.mark.parametrize("attack", STORE_ATTACKS)
def test_no_code_is_trusted_that_nobody_has_named(attack, evil, tmp_path, monkeypatch):
    attack(at_home(tmp_path, monkeypatch), evil, monkeypatch)
    assert not is_trusted(DIGEST)


@pytest.mark.parametrize("attack", (others_write_folder, others_write_files, linked_folder, here))
def test_the_store_is_no_weaker_than_the_cache(attack, evil, tmp_path, monkeypatch):
    attack(at_home(tmp_path, monkeypatch), evil, monkeypatch)
    assert not is_trusted(DIGEST)


def test_the_attempts_would_succeed_where_nothing_is_checked(evil, tmp_path, monkeypatch):
    """The planted kernel and store are sound: in the user's own folders they are used."""
    plant(at_home(tmp_path, monkeypatch), evil)
    host_kernels.__wrapped__().compile([evil.source])
    assert Path(MARK).exists() and is_trusted(DIGEST)
