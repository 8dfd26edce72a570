"""Recordings of joints that several motors move together, as recordings of the motors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pace_actuators.text import listed
from pace_envs.motor_coordinates import DrivenJoints

from .data import Recording

_MOTION = ("dof_pos", "des_dof_pos", "dof_vel", "des_dof_vel")
_EFFORT = ("dof_effort", "des_dof_effort")


def of_motors(recording: Recording, driven: DrivenJoints) -> Recording:
    """The recording with the columns of motors in place of those of the joints that they move together.

    Positions and speeds are those of the motors, q_m = R q, and torques do the same work, τ_m = R⁻ᵀ τ. Values of the
    drives beside the recording (gains, limits) are taken as the motors', in the order of these columns.

    Args:
        recording: Of joints or of motors; the latter, and one without all the joints of a motor, stay as they are.
        driven: What the robot's drives move.
    """
    place = dict(zip(driven.joints, driven.names, strict=True))
    rows = {name: driven.row_of(name) for name in driven.names}
    motors = [name for name, joint in zip(driven.names, driven.joints, strict=True) if name != joint]
    moved = {joint for name in motors for joint in rows[name]}
    names = recording.joint_names
    if not motors or not moved <= set(names) or set(motors) & set(names):
        return recording
    back = {
        joint: {name: ratio for name, ratio in zip(driven.names, column, strict=True) if ratio}
        for joint, column in zip(driven.joints, driven.inverse.tolist(), strict=True)
    }
    series = {}
    for key in (*_MOTION, *_EFFORT):
        if (values := getattr(recording, key)) is not None:
            turned = values.astype(np.float64)
            for joint in moved:
                row = rows[place[joint]] if key in _MOTION else _efforts(place[joint], back)
                turned[..., names.index(joint)] = _sum(values, names, row)
            series[key] = turned
    order = sorted(moved, key=names.index)
    note = (
        f"{listed(order)}: turned into their motors {listed([place[joint] for joint in order])}, whose gains and "
        "limits the values beside the log are, in this order."
    )
    return replace(
        recording,
        **series,
        joint_names=tuple(place.get(name, name) if name in moved else name for name in names),
        unit_stated=tuple(place.get(name, name) if name in moved else name for name in recording.unit_stated),
        notes=(*recording.notes, note),
    )


def _efforts(motor: str, back: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """How a motor's torque follows from those of joints, τ_m = Σ (∂q_joint/∂q_m) τ_joint."""
    return {joint: row[motor] for joint, row in back.items() if motor in row}


def _sum(values: np.ndarray, names: tuple[str, ...], row: Mapping[str, float]) -> np.ndarray:
    """Σ ratio x_joint; NaN where one of these has none."""
    return sum((ratio * values[..., names.index(joint)] for joint, ratio in row.items()), start=np.zeros(()))
