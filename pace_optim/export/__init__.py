"""A fit's result for other programs: robot models, and configurations of drives."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from pace_actuators import IdentifiedDrives
from pace_actuators.files import write_atomically
from pace_actuators.text import listed
from pace_envs.identified import doubts_of_fit
from pace_envs.link_inertia import NAMES
from pace_optim.export.configs import cfg_python, extra_parameters, isaaclab_python, mjlab_python
from pace_optim.export.mjcf import mjcf, motors_of, pulled_notes
from pace_optim.export.mjlab_native import mjlab_native_python
from pace_optim.export.newton import newton_python

__all__ = ["FORMATS", "Export", "export"]


@dataclass(frozen=True, kw_only=True)
class Export:
    """What is written."""

    text: str
    """The file's content."""

    notes: list[str]
    """What the format cannot hold, and what to do where it is used."""

    warnings: list[str] = field(default_factory=list)
    """Why the fit's values may not be the robot's: W22 and W23, as a training prints them."""

    def write(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(Path(path), lambda file: file.write(self.text.encode()))


def _json(drives: IdentifiedDrives) -> tuple[str, list[str]]:
    """Values per joint, what all joints share written out, in SI units; how motors of several joints turn with them."""
    joints = drives.joint_names
    names = [name for name in drives.parameters if name != "delay" and name not in NAMES]
    content = {
        "version": 1,
        "joint_names": list(joints),
        "delay_mode": drives.delay_mode,
        "delay_s": drives.delay_s,
        "control_dt_s": drives.at.control_dt,
        "physics_dt_s": drives.at.physics_dt,
        "drive": {name: dict(values) for name, values in drives.drive.items()},
        "effects": [effect.label for effect in drives.effects],
        "links": {name: asdict(link) for name, link in drives.links.items()},
        "parameters": {name: drives.determined(name, joints) for name in names}
        | {name: dict(drives.parameters[name]) for name in extra_parameters(drives)},
        **({"couplings": motors} if (motors := motors_of(drives)) else {}),
    }
    return json.dumps(content, indent=2) + "\n", []


FORMATS: dict[str, Callable[[IdentifiedDrives], tuple[str, list[str]]]] = {
    "mjcf": mjcf,
    "mjlab": mjlab_python,
    "mjlab_native": mjlab_native_python,
    "isaaclab": isaaclab_python,
    "newton": newton_python,
    "cfg": cfg_python,
    "json": _json,
}
"""Format -> what writes it."""
_SHORT = 0.001
"""Physics steps that are shorter are impractical in training [s]."""
_OF_JOINTS = ("mjlab", "mjlab_native", "isaaclab", "newton")
"""Formats of simulators in which a drive is one of a joint."""


def export(path: str | Path, fmt: str, *, joints_only: bool = False, task: str | None = None) -> Export:
    """A result in another format.

    Args:
        path: ``result.json``, or the run's folder.
        fmt: One of ``FORMATS``.
        joints_only: Leave the drives out of a model (``mjcf``).
        task: Another environment than that of the fit.
    """
    if fmt not in FORMATS:
        raise ValueError(f"There is no format {fmt!r}. Available: {', '.join(FORMATS)}.")
    if joints_only and fmt != "mjcf":
        raise ValueError(f"joints_only is for the format mjcf; {fmt!r} holds nothing but drives. Leave it out.")
    drives = IdentifiedDrives.load(path)
    if task is not None:
        drives = replace(drives, task=task, environment={})
    if fmt in _OF_JOINTS and (motors := motors_of(drives)):
        raise ValueError(
            f"{fmt} gives each joint a drive, and the motors {listed(list(motors))} move several joints together. Use "
            "the format mjcf, whose tendons carry them, or json."
        )
    text, notes = mjcf(drives, joints_only=True) if joints_only else FORMATS[fmt](drives)
    if fmt in _OF_JOINTS:
        notes = [*notes, *pulled_notes(drives)]
    return Export(text=text, notes=[*_short_step(drives), *notes], warnings=doubts_of_fit(drives))


def _short_step(drives: IdentifiedDrives) -> list[str]:
    """How to train with values that belong to a physics step which is too short for that."""
    at = drives.at
    if at.physics_dt >= _SHORT:
        return []
    return [
        f"A physics step of {1e3 * at.physics_dt:g} ms is slow in training. Fit once more with the same effects and "
        f"--physics_dt {at.control_dt:g} --drive_dt {at.control_dt:g}, and export that run."
    ]
