"""What a hidden effect is: where it acts, how its size is drawn, and how it is found by name."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

if TYPE_CHECKING:
    from pace_optim.data_collection.plant.state import Drives, State


@dataclass(frozen=True, kw_only=True)
class Draw:
    """From which range a parameter is drawn."""

    unit: str
    """Its unit."""
    low: float
    """Smallest value drawn."""
    high: float
    """Largest value drawn."""
    log: bool = False
    """Whether all orders of magnitude are equally likely."""
    signed: bool = False
    """Whether the sign is drawn as well."""
    role: Literal["size", "inverse", "shape"] = "size"
    """Whether the effect grows with it (size), shrinks with it (inverse), or neither (shape)."""
    torque: bool = False
    """Whether it is larger for stronger drives: multiplied by the robot's torque scale."""
    integer: bool = False
    """Whether it is a whole number."""
    null: float = 0.0
    """Value of joints without the effect."""
    factor: bool = False
    """Whether the value multiplies something: 1 plus what is drawn, a tenth at least."""

    def sample(self, rng: np.random.Generator, torque_scale: float, boost: float) -> float:
        """A value; ``boost`` above 1 makes the effect larger than its range says."""
        value = (
            np.exp(rng.uniform(np.log(self.low), np.log(self.high))) if self.log else rng.uniform(self.low, self.high)
        )
        value *= {"size": boost, "inverse": 1 / boost, "shape": 1.0}[self.role]
        if self.signed:
            value *= rng.choice((-1.0, 1.0))
        if self.torque:
            value *= torque_scale
        if self.factor:
            value = max(0.1, 1 + value)
        return float(np.round(value)) if self.integer else float(value)


def draws_of(**draws: Draw) -> Mapping[str, Draw]:
    """An effect's parameters by name."""
    return draws


class HiddenEffect:
    """One effect. A subclass states its equation, its draws, and overrides the stages where it acts.

    Values of all shapes are (R, n): recordings by joints. Stages, in the order in which they act:
    `prepare` (once), `command`, `measure`, `speed_feedback`, `controller` (each control instant), then at every
    integration step `drive`, `friction`, `motor_torque`, `joint_torque`.
    """

    name: ClassVar[str]
    outside: ClassVar[bool] = False
    """Whether it is no effect of the library: nothing the diagnosis can name."""
    draws: ClassVar[Mapping[str, Draw]]
    drive_rank: ClassVar[int] = 0
    """Order of the `drive` stages: limit of the request -1, bandwidth 0, gain 1, ripple 2, torque-speed limit 3."""

    def __init__(self, values: Mapping[str, np.ndarray]):
        """Keep the values, {parameter: (R, n)}."""
        self.values = dict(values)

    def __getattr__(self, name: str) -> np.ndarray:
        """A parameter's values, (R, n)."""
        try:
            return self.__dict__["values"][name]
        except KeyError:
            raise AttributeError(name) from None

    def prepare(self, drives: Drives) -> None:
        """Change what is constant: gains, delays, masses, transmission."""

    def command(self, target: np.ndarray, dt: float) -> np.ndarray:
        """Targets [rad] as the drive takes them."""
        return target

    def measure(self, position: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the encoder makes of a position [rad] and a speed [rad/s], bias and noise aside."""
        return position, speed

    def speed_feedback(self, speed: np.ndarray, dt: float) -> np.ndarray:
        """The speed [rad/s] that the controller uses."""
        return speed

    def controller(self, torque: np.ndarray, error: np.ndarray, dt: float) -> np.ndarray:
        """The controller's torque [N m], of its position error [rad]."""
        return torque

    def drive(self, torque: np.ndarray, state: State) -> np.ndarray:
        """The motor's torque [N m]."""
        return torque

    def friction(self, forward: np.ndarray, backward: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Coulomb levels for motion in either direction, both >= 0 [N m]."""
        return forward, backward

    def motor_torque(self, state: State) -> np.ndarray:
        """A torque on the motor's side [N m]."""
        raise NotImplementedError

    def joint_torque(self, state: State) -> np.ndarray:
        """A torque on the link [N m]."""
        raise NotImplementedError


EFFECTS: dict[str, type[HiddenEffect]] = {}
"""All effects by name."""


def hidden(effect: type[HiddenEffect]) -> type[HiddenEffect]:
    """Register an effect."""
    if effect.name in EFFECTS:
        raise ValueError(f"A hidden effect named {effect.name!r} is already registered. Choose another name.")
    EFFECTS[effect.name] = effect
    return effect


def effect_named(name: str) -> type[HiddenEffect]:
    """The effect of a name."""
    if name not in EFFECTS:
        close = difflib.get_close_matches(name, EFFECTS, n=1, cutoff=0.4)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"There is no hidden effect {name!r}.{hint} Available: {', '.join(sorted(EFFECTS))}.")
    return EFFECTS[name]


def library_effects() -> tuple[str, ...]:
    """Names of the effects that the diagnosis knows."""
    return tuple(sorted(name for name, effect in EFFECTS.items() if not effect.outside))


def outside_effects() -> tuple[str, ...]:
    """Names of the effects that it does not know."""
    return tuple(sorted(name for name, effect in EFFECTS.items() if effect.outside))
