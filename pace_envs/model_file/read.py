"""Reading a model file into an ``MjSpec``."""

from __future__ import annotations

import gc
import math
import os
import re
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from pace_actuators.memory import available_memory
from pace_envs.model_file.slim import leave_out_meshes, leave_out_surfaces
from pace_envs.model_file.urdf import UrdfFacts, read_urdf
from pace_envs.mujoco_warnings import keep_quiet

MODEL_SUFFIXES = (".xml", ".urdf", ".mjcf")


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelFile:
    """A robot's model and what its file says beside it."""

    path: Path
    """The file."""
    spec: mujoco.MjSpec
    """The model; meshes and surfaces that are not needed are left out of it."""
    notes: tuple[str, ...]
    """What was left out although the file names it, in plain sentences."""
    urdf: UrdfFacts | None = None
    """What only a URDF says; ``None`` for an MJCF."""

    @property
    def format(self) -> str:
        """``"MJCF"`` or ``"URDF"``."""
        return "MJCF" if self.urdf is None else "URDF"


def is_model_file(text: str) -> bool:
    """Whether a text names a model file by its ending (``.xml``, ``.mjcf``, ``.urdf``)."""
    return Path(text).suffix.lower() in MODEL_SUFFIXES


def read_model_file(path: str | Path, *, touches: bool = False) -> ModelFile:
    """Read an MJCF or a URDF.

    Mesh geoms of bodies whose inertia is stated are left out: the dynamics do not need them. A mesh that is needed for
    a mass and that is missing takes its mass with it, which is noted.

    Args:
        touches: Whether the robot touches anything: mesh geoms that collide stay, and MuJoCo takes their convex hulls.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"The model file {path} does not exist. Correct its path.")
    check_limits(path, lambda: mujoco.MjData(_read(path, touches).spec.compile()), key=str(touches))
    return _read(path, touches)


def _read(path: Path, touches: bool) -> ModelFile:
    text = path.read_bytes().decode("utf-8", errors="replace")
    is_urdf = "<robot" in text and "<mujoco model" not in text[: text.find("<robot")]
    facts = read_urdf(text, path, touches=touches) if is_urdf else None
    keep_quiet()
    try:
        spec = mujoco.MjSpec.from_file(str(path)) if facts is None else mujoco.MjSpec.from_string(facts.xml)
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read {path}: {error}") from None
    if facts is not None:
        spec.modelname = spec.modelname or facts.name
        _write_urdf_facts(spec, facts)
    notes = [*(() if facts is None else facts.notes), *leave_out_meshes(spec, path, touches=touches)]
    leave_out_surfaces(spec, path)
    return ModelFile(path=path, spec=spec, notes=tuple(notes), urdf=facts)


def compile_model(spec: mujoco.MjSpec, path: str | Path, notes: Sequence[str] = ()) -> mujoco.MjModel:
    """Compile a model, whose file messages name.

    Args:
        notes: What was left out of it, which may be why it cannot be compiled.
    """
    try:
        model = spec.compile()
    except ValueError as error:
        if "balanceinertia" in str(error):
            body = re.search(r"Element name '([^']*)'", str(error))
            raise ValueError(
                f"{path}: no body can have the stated inertia of {body[1] if body else 'a body'}. One of its "
                "principal moments is above the sum of the other two. Correct it, or let MuJoCo make them equal: "
                '<compiler balanceinertia="true"/>.'
            ) from None
        needed = " Put them where the file looks for them." if notes else ""
        raise ValueError(
            " ".join([f"MuJoCo cannot compile {path}: {error}{'.' * bool(notes)}", *notes]) + needed
        ) from None
    values = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    bad = [n for n, v in values.items() if isinstance(v, np.ndarray) and v.dtype.kind == "f" and np.isnan(v).any()]
    if bad:
        raise ValueError(f"{path} has a value that is not a number (NaN), in the model's {', '.join(bad)}. Correct it.")
    return model


def _write_urdf_facts(spec: mujoco.MjSpec, facts: UrdfFacts) -> None:
    """Give the model what MuJoCo's reader of URDF leaves out: stiff mimic joints, and no mass where none is stated."""
    for equality in list(spec.equalities):  # MuJoCo's own of mimic joints: twice the rows, and softer
        spec.delete(equality)
    for mimic in facts.mimics:
        equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=mimic.joint, name2=mimic.leader)
        equality.data = [mimic.offset, mimic.multiplier, *[0.0] * (len(equality.data) - 2)]
        equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
        equality.solref, equality.solimp = [0.005, 1.0], [0.95, 0.99, 0.001, 0.5, 2.0]
    for body in spec.bodies:
        if not body.explicitinertial:
            for geom in body.geoms:
                geom.density = 0.0


_LONGEST_S = 10.0
"""Longest time of a processor for reading and compiling a model [s]; the largest robots' take a second."""
_MEMORY = 4e9
"""Most memory for it [bytes]; the largest robots' take a tenth."""
_WAIT = 10.0
"""Longest time of a clock for it, as a multiple of that of a processor."""
_REFUSED = 3
_checked: set[tuple[str, str, int, int]] = set()
"""Files that were within the limits, as long as they are what they were."""


def check_limits(path: Path, read: Callable[[], object], key: str = "") -> None:
    """Refuse a model file that takes too long, or too much memory, such as one that repeats a body 1e8 times.

    MuJoCo cannot be interrupted while it reads. So the file is read in a forked process first, once. Other faults of
    the file are left to the next reader. Systems that cannot fork have no such limits.

    Args:
        key: Identifies this way of reading it.
    """
    info = path.stat()
    state = str(path.resolve()), key, info.st_mtime_ns, info.st_size
    if state in _checked or not hasattr(os, "fork"):
        return
    memory = min(_MEMORY, 0.9 * available_memory())
    collects = gc.isenabled()
    gc.disable()  # in the fork, a simulation that is collected would wait for threads that are not there
    try:
        if not (pid := os.fork()):
            _read_in_fork(read, int(memory))
    finally:
        if collects:
            gc.enable()
    status = _end_of(pid)
    if status in (-signal.SIGXCPU, -signal.SIGKILL):
        raise ValueError(
            f"MuJoCo has not read and compiled {path} after {_LONGEST_S:g} s. Look for what the file repeats or sizes "
            "(replicate, composite, flexcomp, size), and make it smaller."
        )
    if status == _REFUSED or status < 0:
        raise ValueError(
            f"The model of {path} does not fit into {memory / 1e9:.2g} GB of memory, or ends MuJoCo. Look for what the "
            "file repeats or sizes (replicate, composite, flexcomp, size, hfield), and make it smaller."
        )
    _checked.add(state)


def _read_in_fork(read: Callable[[], object], memory: int) -> None:
    """The forked process: it never returns."""
    import resource  # systems that fork have it

    status = 0
    try:
        silence = os.open(os.devnull, os.O_WRONLY)
        for descriptor in (1, 2):
            os.dup2(silence, descriptor)
        pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
        most = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(_LONGEST_S), resource.getrlimit(resource.RLIMIT_CPU)[1]))
        signal.signal(signal.SIGXCPU, signal.SIG_DFL)
        read()
    except ValueError as error:  # the next reader names the fault
        status = _REFUSED if re.search("memory|allocate", str(error), re.IGNORECASE) else 0
    except BaseException:
        status = _REFUSED
    finally:
        os._exit(status)


def _end_of(pid: int) -> int:
    """The process' status, negative for the signal that has ended it."""
    until, pause = time.monotonic() + _WAIT * _LONGEST_S, 0.0005
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > until:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return -signal.SIGKILL
        time.sleep(pause)
        pause = min(2 * pause, 0.05)
