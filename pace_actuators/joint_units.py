"""Units of hinges, and what they are for slides: metres for radians, forces for torques, masses for inertias."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Literal

JointType = Literal["hinge", "slide"]

JOINT_TYPES: tuple[JointType, ...] = ("hinge", "slide")
"""Both; an effect that means something on one of them alone says so in ``joint_types``."""

SLIDE_LENGTH = 0.1
"""Metres of a slide that count as a radian of a hinge."""

_OF_SLIDES = (
    (r"kg m(\^2|²|<sup>2</sup>)", "kg"),
    (r"\bN m(?![A-Za-z])", "N"),
    (r"(?<![A-Za-zµ])(m|µ|n)?rad(?![A-Za-z])", r"\1m"),
)
_OF_HINGES = re.compile(
    r"kg m(\^2|²|<sup>2</sup>)"
    r"|\bN m(?![A-Za-z])( s(\^2|²)?)?(/(\(rad s\)|rad(\^2|²)?))?"
    r"|(?<![A-Za-zµ])(m|µ|n)?rad(?![A-Za-z])(\^2|²)?(/s(\^2|²)?)?"
)
"""A whole unit that is another one for slides."""


def units_for(text: str, joint_types: Iterable[JointType]) -> str:
    """A unit, or a text with units in it, of hinges as it is for joints of some types.

    Args:
        text: For hinges; words that hold no unit stay as they are.
        joint_types: Of the joints that it is about.

    Returns:
        For slides "N m s/rad" becomes "N s/m"; for joints of both types "mrad" becomes "mrad or mm".
    """
    types = set(joint_types)
    if "slide" not in types:
        return text
    if "hinge" in types:
        return _OF_HINGES.sub(lambda unit: f"{unit[0]} or {_of_slides(unit[0])}", text)
    return _of_slides(text)


def joint_label(joint: str, own: JointType, joint_types: Iterable[JointType], unit: str = "mrad") -> str:
    """A joint's name for a table of errors, with its unit where others have another: "A3 [mm]"."""
    return f"{joint} [{units_for(unit, [own])}]" if len(set(joint_types)) > 1 else joint


def radians(joint_types: Iterable[JointType]) -> tuple[float, ...]:
    """What counts as a radian of each joint [rad, of slides m]."""
    return tuple(SLIDE_LENGTH if each == "slide" else 1.0 for each in joint_types)


def all_hinges(count: int) -> tuple[JointType, ...]:
    """The types of so many joints by default: they turn."""
    return tuple("hinge" for _ in range(count))


def _of_slides(text: str) -> str:
    for pattern, unit in _OF_SLIDES:
        text = re.sub(pattern, unit, text)
    return text
