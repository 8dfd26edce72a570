"""A robot's looks, which its dynamics do not need: the meshes that its model file names, as far as they are there."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from pace_envs.mujoco_warnings import keep_quiet

_LARGEST = 60e6
"""Files of meshes that are read for a picture, together [bytes]."""
_READ = (".stl", ".obj", ".msh")
"""What MuJoCo reads of meshes; a Collada file's link is drawn by its collision meshes."""


def looks_of(path: Path) -> mujoco.MjModel | None:
    """A model with the bodies of a model file and all that it shows; ``None`` if a mesh is missing or too large.

    Of a URDF its bodies are not connected. Only what is in a body's own frame is of use.

    Args:
        path: MJCF or URDF.
    """
    keep_quiet()
    try:
        text = path.read_text("utf-8", errors="replace")
        spec = _of_urdf(text, path) if "<robot" in text else mujoco.MjSpec.from_file(str(path))
        folder = path.parent / spec.meshdir
        files = [folder / mesh.file for mesh in spec.meshes if mesh.file]
        if not files or sum(file.stat().st_size for file in files) > _LARGEST:
            return None
        return spec.compile()
    except (ValueError, OSError, ElementTree.ParseError):
        return None


def _of_urdf(text: str, path: Path) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    for link in ElementTree.fromstring(text.strip().strip("\0")).findall("link"):
        name = link.get("name", "")
        body = spec.worldbody if name == spec.worldbody.name else spec.worldbody.add_body(name=name)
        shown = [_mesh(spec, body, part, path) for part in link.findall("visual")]
        if not any(shown):
            for part in link.findall("collision"):
                _mesh(spec, body, part, path)
    return spec


def _mesh(spec: mujoco.MjSpec, body: mujoco.MjsBody, part: ElementTree.Element, path: Path) -> bool:
    """Add the mesh of a visual or collision; whether it is there and can be read."""
    element, origin = part.find("geometry/mesh"), part.find("origin")
    file = None if element is None else _found(element.get("filename", ""), path)
    if element is None or file is None:
        return False
    name = f"mesh {len(spec.meshes)}"
    mesh = spec.add_mesh(name=name, file=str(file), scale=_numbers(element.get("scale"), 1.0))
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    if origin is not None:
        geom.pos = _numbers(origin.get("xyz"), 0.0)
        mujoco.mju_euler2Quat(quat := np.zeros(4), np.array(_numbers(origin.get("rpy"), 0.0)), "XYZ")
        geom.quat = quat
    colour = part.find("material/color")
    if colour is not None:
        geom.rgba = [float(each) for each in colour.get("rgba", "").split()]
    return True


def _found(name: str, path: Path) -> Path | None:
    """The file that a URDF names, beside it or above it; or the same mesh in a format that MuJoCo reads."""
    kind, _, rest = name.rpartition("://")
    places = [path.parent, *path.resolve().parents[1:5]]
    shorter = rest.partition("/")[2] if kind == "package" else rest
    for place in places:
        for each in (rest, shorter):
            found = [place / each, *(place / Path(each).with_suffix(suffix) for suffix in _READ)] if each else []
            if file := next((file for file in found if file.suffix.lower() in _READ and file.is_file()), None):
                return file.resolve()
    return None


def _numbers(text: str | None, default: float) -> list[float]:
    return [float(each) for each in text.split()] if text else [default] * 3
