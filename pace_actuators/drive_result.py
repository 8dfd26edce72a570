"""The part of ``result.json`` that a drive needs: its schema, with one reader for all who read results."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

from pace_actuators.base_parameters import BASE_PARAMETERS
from pace_actuators.files import checked, file_at, read_json, refuse

VERSION = 1
ALL = "all"
"""Key of a value that all joints share."""

_ABOVE_ZERO = ("saturation_effort", "velocity_limit")
"""Limits that make a torque-speed line, which has a slope."""

CURE = "Fit again."

_LONGEST = 100.0
"""Delay, and time between two control steps [s]: of no drive, and so that numbers of steps are numbers."""


@dataclass(frozen=True, kw_only=True)
class LinkInertia:
    """A link's inertial parameters, in its own frame."""

    mass: float
    """[kg]."""

    com: Sequence[float]
    """Centre of mass, (3,) [m]."""

    inertia: Sequence[float]
    """xx, yy, zz, xy, xz, yz about the centre of mass, (6,) [kg m²]."""


@dataclass(frozen=True, kw_only=True)
class CommandTiming:
    """When commands came that a log stamps by a separate clock, against an even timer."""

    interval_s: float
    """From one tick of the timer to the next [s]."""

    early_s: float
    """One command in twenty came this much or more before its tick [s]."""

    late_s: float
    """One command in twenty came this much or more after its tick [s]."""

    lost: float
    """Part of the ticks without a command."""


@dataclass(kw_only=True)
class DriveResult:
    """What an identification says of the drives; field names are the file's keys."""

    version: int = VERSION
    task: str
    joint_names: list[str]
    effects: list[str]
    delay_mode: Literal["command", "effort"]
    physics_dt: float
    control_dt: float
    parameters: dict[str, dict[str, float]]
    """Value by parameter and joint (or ``"all"``)."""
    delay_s: float
    std: dict[str, dict[str, float | None]] = field(default_factory=dict)
    """Standard deviations of the same shape; ``None`` without an error bar."""
    correlation: dict[str, Any] = field(default_factory=dict)
    """``labels`` (``parameter/joint``) and ``matrix``, entries ``None`` where it is unknown; may be empty."""
    drive: dict[str, dict[str, float]] = field(default_factory=dict)
    """Gains and limits per joint that were in force in every recording, as far as known."""
    links: dict[str, LinkInertia] = field(default_factory=dict)
    """Links whose inertial parameters were identified, by name."""
    undetermined: list[str] = field(default_factory=list)
    """Labels (``parameter/joint``) of what the recordings do not determine: it keeps its prior value."""

    at_bound: list[str] = field(default_factory=list)
    """Labels of what ended at a bound."""
    times_noise: float | None = None
    """The training error as a multiple of the measurement noise; ``None``: it is not known."""

    command_timing: CommandTiming | None = None
    """When the recordings' commands came; ``None``: no log stamps them separately, or they follow no timer."""

    environment: dict[str, Any] = field(default_factory=dict)
    """Where the environment of the identification comes from: its code and files, by digest."""

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read ``result.json``, or that of a run's folder.

        Raises:
            ValueError: If it is missing, damaged, or of another version; the message names the file and the key.
        """
        path = result_path(path)
        content = read_json(path, "Name the result.json of a fit, or its run's folder.")
        if not isinstance(content, dict) or content.get("version") != VERSION:
            raise ValueError(f"{path} is no fit result of version {VERSION}. Fit again with this version.")
        result = checked(cls, content, path, CURE)
        result.check(path)
        return result

    def check(self, source: object) -> None:
        """Check what the types of the fields do not say.

        Args:
            source: The file, for messages.

        Raises:
            ValueError: If something does not fit; the message names the key.
        """
        if not self.joint_names or len(set(self.joint_names)) < len(self.joint_names):
            refuse(source, "joint_names must be a list of different names", CURE)
        for name, parameter in BASE_PARAMETERS.items():
            entries = self.parameters.get(name, {})
            keys = [ALL] if parameter.shared or ALL in entries else self.joint_names
            if missing := [key for key in keys if key not in entries]:
                refuse(source, f"{name} has no value for {', '.join(missing)}", CURE)
            for key, value in entries.items():
                if parameter.least is not None and value < parameter.least:
                    refuse(source, f"{name} of {key} is {value:g}, expected at least {parameter.least:g}", CURE)
        for name, values in self.drive.items():
            for key, value in values.items():
                if value < 0 or (value == 0 and name in _ABOVE_ZERO):
                    bound = "above 0" if name in _ABOVE_ZERO else "of at least 0"
                    refuse(source, f"drive/{name} of {key} is {value:g}, expected a number {bound}", CURE)
        for name, link in self.links.items():
            if not link.mass > 0 or len(link.com) != 3 or len(link.inertia) != 6 or not min(link.inertia[:3]) > 0:
                refuse(source, f"links/{name} is no rigid body: expected mass > 0, com (3) and inertia (6) > 0", CURE)
        if not 0 <= self.delay_s <= _LONGEST:
            refuse(source, f"delay_s is {self.delay_s:g}, expected 0 to {_LONGEST:g} [s]", CURE)
        if not 1e-9 < self.physics_dt <= self.control_dt * (1 + 1e-6) <= _LONGEST:
            refuse(
                source,
                f"physics_dt is {self.physics_dt:g} and control_dt {self.control_dt:g}; expected times above 0, the "
                f"first no longer than the second, and neither above {_LONGEST:g} [s]",
                CURE,
            )
        self._check_correlation(source)

    def _check_correlation(self, source: object) -> None:
        if not self.correlation:
            return
        labels, rows = self.correlation.get("labels"), self.correlation.get("matrix")
        square = (
            isinstance(labels, list)
            and isinstance(rows, list)
            and all(isinstance(label, str) and "/" in label for label in labels)
            and len(rows) == len(labels)
            and all(isinstance(row, list) and len(row) == len(labels) for row in rows)
            and all(v is None or (isinstance(v, int | float) and math.isfinite(v)) for row in rows for v in row)
        )
        if not square:
            refuse(source, "correlation must have labels (parameter/joint) and a matrix with a row for each", CURE)


def result_path(path: str | Path) -> Path:
    """Where the result of a run lies: the file itself, or that of the run's folder."""
    path = Path(path)
    with contextlib.suppress(OSError, ValueError):  # file_at says what is wrong
        path = path / "result.json" if path.is_dir() else path
    return file_at(path, "Name a run's folder or its result.json.")
