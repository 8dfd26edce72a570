"""Whether a recording contradicts the limits that are stated of its drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from pace_actuators.joint_units import JointType, units_for
from pace_optim.recording import Recording

_BEYOND = 1.1
"""Times the stated limit: below, noise and a load that drives the motor may be the reason."""
_SPAN = 0.02
"""Time over which a speed is taken from positions [s]."""


def contradicted_limits(
    recording: Recording, velocity_limit: ArrayLike, effort_limit: ArrayLike, joint_types: Sequence[JointType] = ()
) -> list[str]:
    """Measured speeds and torques beyond what is stated, in words.

    Args:
        recording: The recording; its own facts come before what is configured.
        velocity_limit: No-load speed as configured, (n,) [rad/s]; NaN or infinite where there is none.
        effort_limit: Torque limit as configured, (n,) [N m]; NaN or infinite where there is none.
        joint_types: Whether each joint turns or slides; none: all turn.
    """
    n = recording.num_joints
    span = max(1, round(_SPAN / float(np.median(np.diff(recording.time)))))
    moved = recording.dof_pos[span:] - recording.dof_pos[:-span]
    speed = np.abs(moved / (recording.time[span:] - recording.time[:-span])[:, None])
    found = [("velocity_limit", "no-load speed", "rad/s", speed, recording.drive.velocity_limit, velocity_limit)]
    if recording.dof_effort is not None:
        torque = np.abs(recording.dof_effort)
        found.append(("effort_limit", "torque limit", "N m", torque, recording.drive.effort_limit, effort_limit))
    notes = []
    for field, words, unit, measured, own, configured in found:
        stated = np.broadcast_to(np.asarray(configured if own is None else own, dtype=float), (n,))
        for j, name in enumerate(recording.joint_names):
            values = measured[np.isfinite(measured[:, j]), j]
            largest = float(np.quantile(values, 0.999)) if values.size else 0.0
            if np.isfinite(stated[j]) and largest > _BEYOND * stated[j]:
                own_unit = units_for(unit, joint_types[j : j + 1])
                notes.append(
                    f"the recording contradicts the stated {words}: {name} reaches {largest:.3g} {own_unit}, {field} "
                    f"is {stated[j]:.3g} {own_unit}. Correct {field}."
                )
    return notes
