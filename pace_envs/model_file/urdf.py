"""What a URDF says that MuJoCo's reader does not take: speeds, mimic joints, which joints are driven.

And what MuJoCo refuses although other readers of URDF take it: inertias that no body can have, names with undeclared
prefixes, a base that floats below a fixed link.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from pace_actuators.text import listed

MOVING = ("revolute", "continuous", "prismatic")

_SMALLEST_MASS = 1e-6
"""Of a moving link where the file gives it, and what is fixed to it, none [kg]."""
_SMALLEST_INERTIA, _SMALLEST_AREA = 1e-9, 1e-6
"""Where no body can have the stated inertia, it is at least this [kg m^2], and this per mass [m^2]."""
_ZERO = 1e-15
"""A stated inertia that is smaller everywhere is zero [kg m^2]."""
_READABLE = (".stl", ".obj", ".msh")
"""Files of meshes that MuJoCo reads."""
_TOLD = 1e-3
"""A smaller relative change of an inertia gets no note: a flat plate's moments are rounded."""
_NUMBERS = {
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction"),
    "mimic": ("multiplier", "offset"),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
}


@dataclass(frozen=True, kw_only=True)
class Mimic:
    """A joint that follows another: q = multiplier * q_leader + offset."""

    joint: str
    leader: str
    """Empty where the leader does not move: the joint stays at the offset."""
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
    motors: Mapping[str, Mapping[str, float]]
    """Actuators of transmissions that move two joints together, {actuator: {joint: ratio}}, behind their own gears.
    The drives are those of the joints, unless a log has the actuators' columns."""
    command: Mapping[str, str]
    """Their command interface, such as ``"velocity"``, where the file names it."""
    notes: tuple[str, ...]


def read_urdf(text: str, path: Path, *, touches: bool = False) -> UrdfFacts:
    """Read a URDF.

    Args:
        touches: Whether the meshes of collisions stay, under the absolute paths of their files.
    """
    try:
        root = ElementTree.fromstring(_with_declared_prefixes(text.strip().strip("\0")))
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is no readable XML: {error}.") from None
    if any("xacro" in str(element.tag) for element in root.iter()):
        raise ValueError(f"{path} is a xacro, not yet a URDF. Expand it first: xacro {path.name} > robot.urdf")
    repeated = _keep_first(root)
    _check_numbers(root, path)
    meshes = _without_meshes(root, path if touches else None)
    notes = [*repeated, *_hold_what_floats(root), *_give_possible_inertias(root, path)]
    if meshes and touches:
        notes.append(
            f"Collision meshes without effect: {listed(meshes, 3)}. Expected {', '.join(_READABLE)} files beside the "
            "URDF; the folder of a package:// path may also lie above it. Convert or move them."
        )
    elif meshes:
        notes.append("The meshes are not loaded: a fit needs no shapes.")
    types = {joint.get("name", ""): joint.get("type", "") for joint in root.findall("joint")}
    moving = [name for name, kind in types.items() if kind in MOVING]
    command, (motors, told) = _command_interfaces(root), _motors(root, path)
    notes += told
    named = {e.get("name", "") for e in root.iterfind("transmission/joint")} | set(command)
    return UrdfFacts(
        name=root.get("name", ""),
        xml=ElementTree.tostring(root, encoding="unicode"),
        velocity_limits=_velocity_limits(root),
        mimics=tuple(_mimics(root)),
        driven=tuple(name for name in moving if name in named),
        motors=motors,
        command=command,
        notes=tuple(notes),
    )


def _with_declared_prefixes(text: str) -> str:
    """The same, with each prefix of a name declared that is not, such as that of ``drake:acceleration``."""
    used = set(re.findall(r"[<\s/]([A-Za-z_][\w.-]*):[\w.-]+\s*(?:=|/?>|\s)", re.sub(r'"[^"]*"', '""', text)))
    unknown = sorted(prefix for prefix in used - {"xml", "xmlns"} if f"xmlns:{prefix}" not in text)
    return re.sub(r"<robot\b", " ".join(["<robot", *(f'xmlns:{p}="{p}"' for p in unknown)]), text, count=1)


def _keep_first(root: ElementTree.Element) -> list[str]:
    """Keep the first of elements that a link or joint has once, as ROS does; returns a note on the others."""
    told: dict[str, list[str]] = {}
    for owner in (*root.findall("link"), *root.findall("joint")):
        for parent in (owner, *owner):
            for tag in sorted(_ONCE.intersection(child.tag for child in parent)):
                for repeated in parent.findall(tag)[1:]:
                    parent.remove(repeated)
                    told.setdefault(tag, []).append(owner.get("name", ""))
    return [
        f"Stated twice, the first is used: <{tag}> of {listed(list(dict.fromkeys(names)), 3)}."
        for tag, names in told.items()
    ]


_ONCE = frozenset(
    {"inertial", "origin", "mass", "inertia", "geometry", "parent", "child", "axis", "limit", "dynamics", "mimic"}
)
"""Elements of a URDF's link or joint, or of their parts, that stand once."""


def _hold_what_floats(root: ElementTree.Element) -> list[str]:
    """Fix each floating joint where it is, as every base is held; returns a note on what was."""
    floating = [joint for joint in root.findall("joint") if joint.get("type") == "floating"]
    for joint in floating:
        joint.set("type", "fixed")
    names = listed([joint.get("name", "") for joint in floating], 3)
    return [f"Taken as fixed, not as floating: {names}."] if floating else []


def _give_possible_inertias(root: ElementTree.Element, path: Path) -> list[str]:
    """Replace inertias that no body can have by the nearest one that a body can have; returns notes on them.

    A body's second moments of mass Σ = ½ tr(I) 1 - I have no negative eigenvalue. Those that have are set to 0. So no
    principal moment is larger than the sum of the others. A moving link without any mass becomes a small point.
    """
    moving = [_link(joint, "child") for joint in root.findall("joint") if _moves(joint)]
    massless = [name for name in moving if not _mass_fixed_to(root, name)]
    if moving and len(massless) == len(moving):
        raise ValueError(f"{path} states no mass of any link that a joint moves. Give the links their <inertial>.")
    for link in root.findall("link"):
        if link.get("name") in massless:
            for old in link.findall("inertial"):
                link.remove(old)
            ElementTree.SubElement(ElementTree.SubElement(link, "inertial"), "mass", value=str(_SMALLEST_MASS))
    changed: dict[str, float] = {}
    for link in root.findall("link"):
        inertial = link.find("inertial")
        mass = 0.0 if inertial is None else _number_of(inertial.find("mass"), "value")
        if inertial is None or mass <= 0:
            continue
        element = inertial.find("inertia")
        stated = np.zeros((3, 3)) if element is None else _tensor(element)
        possible = _nearest_possible(stated, mass)
        if element is not None and possible is stated:
            continue
        element = ElementTree.SubElement(inertial, "inertia") if element is None else element
        for key, (i, j) in _ENTRIES.items():
            element.set(key, repr(float(possible[i, j])))
        size = float(np.abs(stated).max())
        changed[link.get("name", "")] = float(np.abs(possible - stated).max()) / size if size > _ZERO else math.inf
    carried = _carried(root) - set(massless)
    told = {name: change for name, change in changed.items() if change > _TOLD and name in carried}
    notes = []
    if massless:
        notes.append(f"No mass is stated for {listed(massless, 3)}, which a joint moves: {1e6 * _SMALLEST_MASS:g} mg.")
    if zero := [name for name, change in told.items() if math.isinf(change)]:
        notes.append(f"The inertia of {listed(zero, 3)} is zero: taken as a point's.")
    if impossible := [name for name, change in told.items() if math.isfinite(change)]:
        most = max(told[name] for name in impossible)
        notes.append(
            f"No body can have the stated inertia of {listed(impossible, 3)}: a principal moment is not positive, or "
            f"above the sum of the other two. The nearest possible one is used, changed by {100 * most:.1f} % at most."
        )
    return notes


_ENTRIES = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


def _tensor(element: ElementTree.Element) -> np.ndarray:
    tensor = np.zeros((3, 3))
    for key, (i, j) in _ENTRIES.items():
        tensor[i, j] = tensor[j, i] = _number_of(element, key)
    return tensor


def _nearest_possible(inertia: np.ndarray, mass: float) -> np.ndarray:
    """The nearest inertia [kg m^2] that a body of that mass can have; where it can have this one, the same."""
    moments = np.linalg.eigvalsh(inertia)
    if moments[0] > 0 and moments[0] + moments[1] > moments[2]:
        return inertia
    values, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    values = np.maximum(values, 0.5 * max(_SMALLEST_INERTIA, _SMALLEST_AREA * mass))
    second = (axes * values) @ axes.T
    return np.trace(second) * np.eye(3) - second


def _carried(root: ElementTree.Element) -> set[str]:
    """Links that a joint moves, itself or further up; the inertia of the others does not matter."""
    joints = root.findall("joint")
    found = [_link(joint, "child") for joint in joints if _moves(joint)]
    for link in found:
        found += [
            child
            for joint in joints
            if _link(joint, "parent") == link and (child := _link(joint, "child")) not in found
        ]
    return set(found)


def _mass_fixed_to(root: ElementTree.Element, name: str) -> float:
    """Mass of a link and of all that is fixed to it [kg]."""
    links = {link.get("name", ""): link.find("inertial/mass") for link in root.findall("link")}
    below: dict[str, list[str]] = {}
    for joint in root.findall("joint"):
        if joint.get("type") == "fixed":
            below.setdefault(_link(joint, "parent"), []).append(_link(joint, "child"))
    found, total = [name], 0.0
    for link in found:
        total += max(_number_of(links.get(link), "value"), 0.0)
        found += [child for child in below.get(link, ()) if child not in found]
    return total


def _moves(joint: ElementTree.Element) -> bool:
    return joint.get("type") in MOVING


def _link(joint: ElementTree.Element, end: str) -> str:
    """The parent or child link of a joint."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _number_of(element: ElementTree.Element | None, key: str) -> float:
    """A number of an element; 0 if missing."""
    return 0.0 if element is None else float(element.get(key, 0.0))


def _without_meshes(root: ElementTree.Element, path: Path | None) -> list[str]:
    """Take visuals and meshes out of the tree; returns the meshes' files, each once.

    With the URDF's own file given, meshes of collisions stay that MuJoCo can read, and are not returned.
    """
    meshes = [] if path else [e.get("filename", "") for e in root.iter("mesh")]
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for part in link.findall("collision"):
            if (mesh := part.find("geometry/mesh")) is None:
                continue
            if path and (file := _found(mesh.get("filename", ""), path)):
                mesh.set("filename", str(file))
            else:
                link.remove(part)
                meshes.append(mesh.get("filename", ""))
    if (extension := root.find("mujoco/compiler")) is not None:
        for key in ("meshdir", "discardvisual", "fusestatic"):
            extension.attrib.pop(key, None)
    else:
        extension = ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler")
    extension.set("strippath", "false")
    extension.set("fusestatic", "false")  # a fixed link keeps its name: loads are bolted to it
    return list(dict.fromkeys(meshes))


def _found(name: str, path: Path) -> Path | None:
    """The file of a mesh, by its name in the URDF at a path; ``None`` if it is not there, or MuJoCo cannot read it.

    The package of ``package://package/file`` is looked for beside the folders that hold the URDF, and among them.
    """
    _, scheme, rest = name.rpartition("://")
    package, _, inside = rest.partition("/")
    folders = path.resolve().parents
    tried = [folders[0] / rest, *(folder / rest for folder in folders[1:] if scheme)]
    tried += [folder / inside for folder in folders if scheme and folder.name == package]
    return next((file for file in tried if file.suffix.lower() in _READABLE and file.is_file()), None)


def _check_numbers(root: ElementTree.Element, path: Path) -> None:
    for owner in [*root.findall("joint"), *root.findall("link")]:
        for element in [*owner, *owner.findall("inertial/*")]:
            for key in _NUMBERS.get(element.tag, ()):
                try:
                    good = not math.isnan(float(element.get(key, "0")))
                except ValueError:
                    good = False
                if not good:
                    what = f"<{element.tag} {key}={element.get(key)!r}> of {owner.tag} {owner.get('name', '')!r}"
                    raise ValueError(f"{path}: {what} is not a number. Correct it.")


def _velocity_limits(root: ElementTree.Element) -> dict[str, float]:
    limits = {joint.get("name", ""): joint.find("limit") for joint in root.findall("joint")}
    return {
        name: value
        for name, limit in limits.items()
        if limit is not None and (value := float(limit.get("velocity", 0.0))) > 0
    }


def _mimics(root: ElementTree.Element) -> list[Mimic]:
    found = [(joint.get("name", ""), joint.find("mimic")) for joint in root.findall("joint") if _moves(joint)]
    leaders = {joint.get("name", "") for joint in root.findall("joint") if _moves(joint)}
    return [
        Mimic(
            joint=name,
            leader=leader if (leader := mimic.get("joint", "")) in leaders else "",
            multiplier=float(mimic.get("multiplier", 1.0)),
            offset=float(mimic.get("offset", 0.0)),
        )
        for name, mimic in found
        if mimic is not None
    ]


def _motors(root: ElementTree.Element, path: Path) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Motors of differential and four-bar transmissions of ROS (``transmission_interface``), and notes on them.

    With n the reductions of the joints, and x the motors' positions divided by their own reductions:

        differential:  x₁ = n₁ q₁ + n₂ q₂,  x₂ = n₁ q₁ - n₂ q₂        four-bar linkage:  x₁ = n₁ q₁,  x₂ = q₁ + n₂ q₂
    """
    rows: dict[str, dict[str, float]] = {}
    left_out, joints = [], {joint.get("name", "") for joint in root.findall("joint")}
    for element in root.iter("transmission"):
        kind = (element.findtext("type") or element.findtext("plugin") or "").rpartition("/")[2]
        if kind not in ("DifferentialTransmission", "FourBarLinkageTransmission"):
            continue
        name = element.get("name", "")
        parts = {
            each.get("role") or each.findtext("role") or "": each
            for each in [*element.iter("actuator"), *element.iter("joint")]
        }
        if missing := [role for role in ("actuator1", "actuator2", "joint1", "joint2") if role not in parts]:
            raise ValueError(f"{path}: the transmission {name} has no {listed(missing)}. Add it, with its role.")
        (one, other), (first, second) = (
            [parts[f"{what}{i}"].get("name", "") for i in (1, 2)] for what in ("actuator", "joint")
        )
        one, other = (f"{each}_motor" if each in joints else each for each in (one, other))
        n, m = (_reduction(parts[f"joint{i}"], path, name) for i in (1, 2))
        if kind == "DifferentialTransmission":
            rows |= {one: {first: n, second: m}, other: {first: n, second: -m}}
        else:
            rows |= {one: {first: n}, other: {first: 1.0, second: m}}
        left_out += [
            f"{parts[role].get('name')}" for role in ("joint1", "joint2") if parts[role].find("offset") is not None
        ]
    notes = []
    if rows:
        notes.append(
            f"{listed(list(dict.fromkeys(j for row in rows.values() for j in row)))}: coupled by a transmission. "
            f"Drives are the joints', or those of {listed(list(rows))} where a log has these columns"
        )
    if left_out:
        notes.append(
            f"offsets of transmissions are left out ({listed(left_out, 3)}): the encoder bias takes their place"
        )
    return rows, notes


def _reduction(element: ElementTree.Element, path: Path, name: str) -> float:
    """The mechanical reduction of a part of a transmission; 1 where it states none."""
    text = element.findtext("mechanicalReduction") or element.findtext("mechanical_reduction") or "1"
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value == 0:
        raise ValueError(f"{path}: a reduction of the transmission {name} is {text!r}; expected a number. Correct it.")
    return value


def _command_interfaces(root: ElementTree.Element) -> dict[str, str]:
    """First command interface of the joints of ``<ros2_control>``."""
    joints = [joint for control in root.iter("ros2_control") for joint in control.iter("joint")]
    return {
        joint.get("name", ""): interface.get("name", "")
        for joint in joints
        if (interface := joint.find("command_interface")) is not None
    }
