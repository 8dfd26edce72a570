"""Reading a model file into an ``MjSpec``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from pace_envs.model_file.limits import check_limits
from pace_envs.model_file.slim import leave_out_meshes, leave_out_surfaces
from pace_envs.model_file.urdf import UrdfFacts, read_urdf
from pace_envs.motor_coordinates import add_motors
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
        path: The file.
        touches: Whether the robot touches anything: mesh geoms that collide stay, and MuJoCo takes their convex hulls.

    Raises:
        ValueError: If the file is missing or is no model, or takes too much time or memory.
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
        spec: The model.
        path: Its file.
        notes: What was left out of it, which may be why it cannot be compiled.

    Raises:
        ValueError: If MuJoCo cannot, or a value is not a number.
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
    """Give the model what MuJoCo's reader of URDF leaves out: mimic joints, and no mass where none is stated."""
    for mimic in facts.mimics:
        equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=mimic.joint, name2=mimic.leader)
        equality.data = [mimic.offset, mimic.multiplier, *[0.0] * (len(equality.data) - 2)]
        equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
        equality.solref, equality.solimp = [0.005, 1.0], [0.95, 0.99, 0.001, 0.5, 2.0]
    add_motors(spec, facts.motors, facts.name)
    for body in spec.bodies:
        if not body.explicitinertial:
            for geom in body.geoms:
                geom.density = 0.0
