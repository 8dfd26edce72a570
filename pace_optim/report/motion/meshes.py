"""A robot's looks, which its dynamics do not need: the meshes that its model file names, as far as they are there."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from pace_envs.mujoco_warnings import keep_quiet

_LARGEST = 60e6
"""Files of meshes that are read for a picture, together [bytes]."""
_READ = (".stl", ".obj", ".msh")
"""What MuJoCo reads of meshes."""
_TURNED = (".glb", ".gltf")
"""Up is y in these: the same mesh in another format is turned by a quarter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Looks:
    """What a model file shows of its bodies."""

    model: mujoco.MjModel | None = None
    """Bodies with all that could be read, each in its own frame; of a URDF they are not connected."""
    unread: dict[str, list[str]] = field(default_factory=dict)
    """Meshes that are missing, too large or in another format, by the body that they belong to."""


def looks_of(path: Path) -> Looks:
    """The shapes of a model file's bodies, as far as they can be read.

    Args:
        path: MJCF or URDF.
    """
    keep_quiet()
    unread: dict[str, list[str]] = {}
    try:
        text = path.read_text("utf-8", errors="replace")
        spec = _of_urdf(text, path, unread) if "<robot" in text else mujoco.MjSpec.from_file(str(path))
        files = {mesh.name or Path(mesh.file).stem: path.parent / spec.meshdir / mesh.file for mesh in spec.meshes}
        size = sum(file.stat().st_size for file in files.values() if file.is_file())
        lost = {name for name, file in files.items() if size > _LARGEST or not file.is_file()}
        for geom in [geom for geom in spec.geoms if geom.meshname in lost]:
            unread.setdefault(geom.parent.name, []).append(files[geom.meshname].name)
            geom.parent.explicitinertial, geom.parent.mass, geom.parent.inertia = True, 1.0, np.ones(3)
            spec.delete(geom)
        for mesh in [mesh for mesh in spec.meshes if (mesh.name or Path(mesh.file).stem) in lost]:
            spec.delete(mesh)
        return Looks(model=spec.compile() if spec.meshes else None, unread=unread)
    except (ValueError, OSError, ElementTree.ParseError):
        return Looks(unread=unread)


def _of_urdf(text: str, path: Path, unread: dict[str, list[str]]) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    for link in ElementTree.fromstring(text.strip().strip("\0")).findall("link"):
        name, lost = link.get("name", ""), list[str]()
        body = spec.worldbody if name == spec.worldbody.name else spec.worldbody.add_body(name=name)
        shown = [_mesh(spec, body, part, path, lost) for part in link.findall("visual")]
        if not any(shown) and any([_mesh(spec, body, part, path, []) for part in link.findall("collision")]):
            lost = []
        if lost:
            unread[name] = lost
    return spec


def _mesh(spec: mujoco.MjSpec, body: mujoco.MjsBody, part: ElementTree.Element, path: Path, lost: list[str]) -> bool:
    """Add the mesh of a visual or collision; whether it is there and can be read, else its name is lost."""
    element, origin = part.find("geometry/mesh"), part.find("origin")
    if element is None:
        return False
    file = _found(element.get("filename", ""), path)
    if file is None:
        lost.append(Path(element.get("filename", "")).name)
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
    formats = () if Path(name).suffix.lower() in _TURNED else _READ
    kind, _, rest = name.rpartition("://")
    places = [path.parent, *path.resolve().parents[1:5]]
    shorter = rest.partition("/")[2] if kind == "package" else rest
    for place in places:
        for each in (rest, shorter):
            found = [place / each, *(place / Path(each).with_suffix(suffix) for suffix in formats)] if each else []
            if file := next((file for file in found if file.suffix.lower() in _READ and file.is_file()), None):
                return file.resolve()
    return None


def _numbers(text: str | None, default: float) -> list[float]:
    return [float(each) for each in text.split()] if text else [default] * 3
