"""Units of hinges, and what they are for slides: metres for radians, forces for torques, masses for inertias."""

from __future__ import annotations

import re
from typing import Literal

JointType = Literal["hinge", "slide"]

JOINT_TYPES: tuple[JointType, ...] = ("hinge", "slide")
"""Both; an effect that means something on one of them alone says so in ``joint_types``."""

_OF_SLIDES = (
    (r"kg m(\^2|²|<sup>2</sup>)", "kg"),
    (r"\bN m(?![A-Za-z])", "N"),
    (r"(?<![A-Za-zµ])(m|µ|n)?rad(?![A-Za-z])", r"\1m"),
)


def in_slide_units(text: str) -> str:
    """A unit, or a text with units in it, of hinges as it is for slides: "N m s/rad" becomes "N s/m".

    Raises nothing: words that hold no unit stay as they are.
    """
    for pattern, unit in _OF_SLIDES:
        text = re.sub(pattern, unit, text)
    return text


def unit_for(unit: str, joint_type: JointType) -> str:
    """A hinge's unit for a joint of a type."""
    return in_slide_units(unit) if joint_type == "slide" else unit
