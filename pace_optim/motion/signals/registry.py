"""Excitations by name."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pace_envs.tasks.pace import PaceCfg

from .trajectory import Motion, Trajectory


@dataclass(frozen=True, kw_only=True)
class Excitation:
    """A kind of motion."""

    name: str
    """Its name on the command line."""
    description: str
    """What it is, in a few words."""
    duration: float
    """Usual duration of each of its trajectories [s]."""
    make: Callable[[Motion], list[Trajectory]]
    """Makes the trajectories."""


_EXCITATIONS: dict[str, Excitation] = {}


def register_excitation(
    name: str, description: str, *, duration: float = 20.0
) -> Callable[[Callable[[Motion], list[Trajectory]]], Callable[[Motion], list[Trajectory]]]:
    """Decorate a function that makes an excitation's trajectories.

    Args:
        duration: Usual duration of each trajectory [s].

    Raises:
        ValueError: If the name is taken.
    """

    def register(make: Callable[[Motion], list[Trajectory]]) -> Callable[[Motion], list[Trajectory]]:
        if name in _EXCITATIONS:
            raise ValueError(f"An excitation named {name!r} is already registered. Choose another name.")
        _EXCITATIONS[name] = Excitation(name=name, description=description, duration=duration, make=make)
        return make

    return register


def excitations() -> tuple[Excitation, ...]:
    """All excitations, sorted by name."""
    return tuple(_EXCITATIONS[name] for name in sorted(_EXCITATIONS))


def excitation_named(name: str) -> Excitation:
    """The excitation of a name."""
    if name not in _EXCITATIONS:
        close = difflib.get_close_matches(name, _EXCITATIONS, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise ValueError(
            f"There is no excitation {name!r}.{hint} Available: {', '.join(sorted(_EXCITATIONS))}. "
            "Register your own with register_excitation."
        )
    return _EXCITATIONS[name]


def make_excitation(
    name: str,
    cfg: PaceCfg,
    *,
    control_dt: float,
    duration: float | None = None,
    min_frequency: float = 0.1,
    max_frequency: float = 10.0,
    seed: int = 0,
) -> list[Trajectory]:
    """Make the commanded trajectories of an excitation.

    They start at the centre of the robot's motion and stay within the range that ``cfg.excitation`` gives.

    Args:
        name: One of ``excitations()``.
        duration: Duration of each trajectory [s]; ``None`` means the excitation's usual one.
        min_frequency: Lower end of the band [Hz].
        max_frequency: Upper end of the band [Hz].
        seed: Seed of random phases, levels and times.

    Raises:
        ValueError: If the name is unknown, or the request cannot be met.
    """
    excitation = excitation_named(name)
    if seed < 0:
        raise ValueError(f"The seed is {seed}; expected an integer of 0 or more.")
    motion = Motion(
        cfg=cfg,
        duration=excitation.duration if duration is None else duration,
        control_dt=control_dt,
        min_frequency=min_frequency,
        max_frequency=max_frequency,
        rng=np.random.default_rng(seed),
    )
    return excitation.make(motion)
