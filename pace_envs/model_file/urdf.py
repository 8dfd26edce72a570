"""What a URDF says that MuJoCo's reader does not take: speeds, mimic joints, which joints are driven."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

MOVING = ("revolute", "continuous", "prismatic")
_NUMBERS = {
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction"),
    "mimic": ("multiplier", "offset"),
}


@dataclass(frozen=True, kw_only=True)
class Mimic:
    """A joint that follows another: q = multiplier * q_leader + offset."""

    joint: str
    leader: str
    multiplier: float
    offset: float


@dataclass(frozen=True, kw_only=True)
class UrdfFacts:
    """A URDF without its meshes, and what else it says."""

    name: str
    xml: str
    """The same without visuals and meshes."""
    velocity_limits: Mapping[str, float]
    """No-load speed of joints [rad/s or m/s], where the file has one above 0."""
    mimics: tuple[Mimic, ...]
    driven: tuple[str, ...]
    """Joints that have a transmission or a ros2_control command; empty where the file names none."""
    command: Mapping[str, str]
    """Their command interface, such as ``"velocity"``, where the file names it."""
    notes: tuple[str, ...]


def read_urdf(text: str, path: Path) -> UrdfFacts:
    """Read a URDF.

    Args:
        text: Its content.
        path: Its file, for messages.

    Raises:
        ValueError: If it is no URDF, still a xacro, or a number in it is none.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is no readable XML: {error}.") from None
    if any("xacro" in str(element.tag) for element in root.iter()):
        raise ValueError(f"{path} is a xacro, not yet a URDF. Expand it first: xacro {path.name} > robot.urdf")
    _check_numbers(root, path)
    meshes = _without_meshes(root)
    types = {joint.get("name", ""): joint.get("type", "") for joint in root.findall("joint")}
    moving = [name for name, kind in types.items() if kind in MOVING]
    command = _command_interfaces(root)
    named = {e.get("name", "") for e in root.iterfind("transmission/joint")} | set(command)
    return UrdfFacts(
        name=root.get("name", ""),
        xml=ElementTree.tostring(root, encoding="unicode"),
        velocity_limits=_velocity_limits(root),
        mimics=tuple(_mimics(root)),
        driven=tuple(name for name in moving if name in named),
        command=command,
        notes=(f"Its meshes ({', '.join(meshes[:2])}{', …' if len(meshes) > 2 else ''}) are left out.",)
        if meshes
        else (),
    )


def _without_meshes(root: ElementTree.Element) -> list[str]:
    """Take visuals and meshes out of the tree; returns the meshes' files, each once."""
    meshes = [e.get("filename", "") for e in root.iter("mesh")]
    for link in root.iter("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            if part.tag == "visual" or part.find("geometry/mesh") is not None:
                link.remove(part)
    if (extension := root.find("mujoco/compiler")) is not None:
        for key in ("meshdir", "discardvisual", "fusestatic"):
            extension.attrib.pop(key, None)
    else:
        extension = ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler")
    extension.set("fusestatic", "false")  # a fixed link keeps its name: loads are bolted to it
    return list(dict.fromkeys(meshes))


def _check_numbers(root: ElementTree.Element, path: Path) -> None:
    for joint in root.findall("joint"):
        for element in joint:
            for key in _NUMBERS.get(element.tag, ()):
                try:
                    good = not math.isnan(float(element.get(key, "0")))
                except ValueError:
                    good = False
                if not good:
                    what = f"<{element.tag} {key}={element.get(key)!r}> of joint {joint.get('name', '')!r}"
                    raise ValueError(f"{path}: {what} is not a number. Correct it.")


def _velocity_limits(root: ElementTree.Element) -> dict[str, float]:
    limits = {joint.get("name", ""): joint.find("limit") for joint in root.findall("joint")}
    return {
        name: value
        for name, limit in limits.items()
        if limit is not None and (value := float(limit.get("velocity", 0.0))) > 0
    }


def _mimics(root: ElementTree.Element) -> list[Mimic]:
    found = [(joint.get("name", ""), joint.find("mimic")) for joint in root.findall("joint")]
    return [
        Mimic(
            joint=name,
            leader=mimic.get("joint", ""),
            multiplier=float(mimic.get("multiplier", 1.0)),
            offset=float(mimic.get("offset", 0.0)),
        )
        for name, mimic in found
        if mimic is not None
    ]


def _command_interfaces(root: ElementTree.Element) -> dict[str, str]:
    """First command interface of the joints of ``<ros2_control>``."""
    joints = [joint for control in root.iter("ros2_control") for joint in control.iter("joint")]
    return {
        joint.get("name", ""): interface.get("name", "")
        for joint in joints
        if (interface := joint.find("command_interface")) is not None
    }
