"""What is hidden in a recording, and under which conditions it is made."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from pace_optim.recording import Drive, Load

PerJoint = float | Mapping[str, float]
"""A number for all joints, or {joint: number}."""


@dataclass(frozen=True, kw_only=True)
class BaseTruth:
    """The five parameters of PACE, as the plant has them."""

    armature: PerJoint = 0.1
    """Inertia of the rotor at the joint [kg m^2]."""
    viscous_friction: PerJoint = 3.0
    """[N m s/rad]."""
    friction: PerJoint = 0.4
    """Coulomb friction [N m]."""
    encoder_bias: PerJoint = 0.0
    """The encoder shows q - bias [rad]."""
    delay: float = 0.005
    """[s]."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """Base parameters and hidden effects."""

    base: BaseTruth = field(default_factory=BaseTruth)
    """The base parameters."""
    delay_mode: Literal["command", "effort"] = "command"
    """What the base delay delays: targets, or the controller's torque."""
    effects: Mapping[str, Mapping[str, PerJoint]] = field(default_factory=dict)
    """{effect: {parameter: value or {joint: value}}}; joints that are not named have none of it."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and dicts."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True)
class PlantCfg:
    """How the plant is stepped and measured."""

    step: float = 2.1e-4
    """Longest integration step [s]. The integration is of second order: with 0.21 ms the bench's motions
    differ from those with 0.02 ms by 0.002 to 0.008 mrad RMS, a tenth of the usual noise at most."""
    control_dt: float = 0.0025
    """Time between two control instants [s]."""
    noise: float = 1e-4
    """Standard deviation of the encoder's noise, in the loop and in the log [rad]."""
    counts_per_turn: int | None = None
    """Encoder steps per turn; ``None`` means exact."""
    seed: int = 0
    """Seed of the noise and of what differs at random from recording to recording."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not (0 < self.step <= self.control_dt <= 0.1):
            raise ValueError(
                f"step is {self.step} s and control_dt {self.control_dt} s; expected 0 < step <= control_dt <= 0.1."
            )
        if self.noise < 0:
            raise ValueError(f"noise is {self.noise}; expected 0 or more [rad].")
        if self.counts_per_turn is not None and self.counts_per_turn < 2:
            raise ValueError(f"counts_per_turn is {self.counts_per_turn}; expected 2 or more, or None.")


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One recording to be made."""

    name: str
    """Its name."""
    command: np.ndarray
    """Targets on the control grid, (T, n) [rad]."""
    drive: Drive = field(default_factory=Drive)
    """Gains and limits in place of the robot's."""
    load: Load = field(default_factory=Load)
    """What is carried."""
    session_start: float = 0.0
    """When in the session it starts [s], for what changes over a session."""


def per_joint(value: PerJoint, joint_names: Sequence[str], default: float, what: str) -> np.ndarray:
    """Values of all joints, (n,); keys may be regular expressions.

    Args:
        value: A number, or {joint or regular expression: number}.
        default: Value of joints that no key covers.
    """
    if not isinstance(value, Mapping):
        return np.full(len(joint_names), float(value))
    result = np.full(len(joint_names), default)
    for pattern, number in value.items():
        hits = [i for i, name in enumerate(joint_names) if re.fullmatch(pattern, name)]
        if not hits:
            raise ValueError(f"{what} names {pattern!r}, which is no joint. Available: {', '.join(joint_names)}.")
        result[hits] = float(number)
    return result
