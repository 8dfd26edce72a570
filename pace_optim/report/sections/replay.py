"""The robot in 3-D: measured motion and simulated motion over each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from markupsafe import Markup

from pace_actuators.text import listed

from ..markup import Section, choice, curve, html, json_script
from ..motion import Looks, Motion, looks_of, motions_of, scene_of
from ..motion.scene import scalar_joints
from ..run_data import RunData

_RECORDINGS_ON_PAGE = 8
"""Those with the largest errors; each takes some 4 bytes a joint and picture."""
_STEP = 1e-5
"""To which positions and times are rounded [rad, m, s]."""
_MESHES = 3
"""Meshes and links that the note names."""
_SPEEDS = (("real time", 1.0), ("1/4", 0.25), ("1/10", 0.1), ("1/50", 0.02))
_EXAGGERATIONS = (1, 5, 20, 100)
_OF_BASE = (
    " The base moves as its IMU and the feet that stand show. A green foot stands, and its leg is not simulated. An "
    "orange foot swings."
)


def replay(run: RunData) -> Section | None:
    """The viewer; nothing where the run holds no model."""
    model = run.read_model()
    if model is None or not run.recordings:
        return None
    bias = run.result.parameters["encoder_bias"]
    motions = motions_of(
        model, run.joint_names, run.worst(_RECORDINGS_ON_PAGE), [bias[name] for name in run.joint_names]
    )
    looks = None if run.model_file is None else looks_of(run.model_file)
    return Section(
        id="replay",
        title="Replay",
        lead="Blue: measured. Solid: simulated, coloured by its error. Drag to turn, wheel to come closer."
        + (_OF_BASE if any(motion.base is not None for motion in motions) else ""),
        html=viewer(model, motions, looks) + _about(looks),
    )


def viewer(model: mujoco.MjModel, motions: Sequence[Motion], looks: Looks | None = None) -> Markup:
    """HTML of a viewer that the page's script brings to life."""
    content = {
        "scene": _encode_scene(scene_of(model, looks)),
        "joints": [model.joint(j).name for j in scalar_joints(model)],
        "scale": _scale(motions),
        "recordings": [_encode(motion) for motion in motions],
    }
    return html(
        '<div class="replay">{{ choice }}'
        '<canvas aria-label="The robot, measured and simulated"></canvas>'
        '<div class="controls"><button type="button" class="play">Play</button>'
        '<input type="range" name="at" min="0" max="1" value="0" step="any" aria-label="time">'
        '<label>Speed <select name="speed">{% for text, value in speeds %}<option value="{{ value }}">{{ text }}'
        '</option>{% endfor %}</select></label><label>Error drawn <select name="exaggerate">{% for value in times %}'
        '<option value="{{ value }}">{{ value }}×</option>{% endfor %}</select></label></div>'
        '<p class="replay-note"></p>{{ script }}</div>',
        choice=choice("recording", [motion.name for motion in motions], group="replay "),
        speeds=_SPEEDS,
        times=_EXAGGERATIONS,
        script=json_script(content),
    )


def _about(looks: Looks | None) -> Markup:
    """Which links are drawn as rods, and for which meshes."""
    if looks is None or not looks.unread:
        return Markup("")
    meshes = list(dict.fromkeys(mesh for own in looks.unread.values() for mesh in own))
    return html(
        '<p class="replay-note">Plain rods stand for meshes that are missing, or neither STL, OBJ nor MSH: '
        "{{ meshes }} ({{ links }}).</p>",
        meshes=listed(meshes, _MESHES),
        links=listed(list(looks.unread), _MESHES),
    )


def _scale(motions: Sequence[Motion]) -> list[float]:
    """Error at which a joint's link is fully red, (m,) [rad or m]: what 99 % of all joints' samples stay below."""
    errors = np.concatenate([np.abs(motion.simulated - motion.measured) for motion in motions])
    largest = float(np.quantile(errors, 0.99)) if errors.size else 0.0
    return [max(largest, 1e-6)] * motions[0].measured.shape[1]


def _encode_scene(scene: dict[str, Any]) -> dict[str, Any]:
    """A scene whose meshes stand once each, under ``meshes``; their shapes have the index."""
    meshes: dict[tuple[tuple[float, ...], tuple[int, ...]], int] = {}
    geoms = []
    for geom in scene["geoms"]:
        if geom["shape"] == "mesh":
            mesh = tuple(geom["vertices"]), tuple(geom["faces"])
            kept = {key: value for key, value in geom.items() if key not in ("vertices", "faces")}
            geoms.append(kept | {"mesh": meshes.setdefault(mesh, len(meshes))})
        else:
            geoms.append(geom)
    encoded = [
        {"vertices": _curves(np.reshape(vertices, (-1, 3)), 1e-4), "faces": curve(np.array(faces), 1.0)}
        for vertices, faces in meshes
    ]
    return scene | {"geoms": geoms, "meshes": encoded}


def _encode(motion: Motion) -> dict[str, Any]:
    base: dict[str, Any] = {}
    if motion.base is not None and motion.standing is not None:
        base = {"base": _curves(motion.base), "standing": _curves(motion.standing, 1.0), "feet": list(motion.feet)}
    return base | {
        "name": motion.name,
        "time": curve(motion.time, _STEP),
        "measured": _curves(motion.measured),
        "error": _curves(motion.simulated - motion.measured),
    }


def _curves(values: np.ndarray, step: float = _STEP) -> list[dict[str, Any]]:
    return [curve(column, step) for column in values.T]
