"""The names that a recording's file may hold, and what to say about any other name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from pace_actuators.identified import DRIVE_FIELDS

COMMAND_SERIES = ("des_dof_pos", "des_dof_vel", "des_dof_effort")
"""Commands of a drive; at least one of them is in every recording."""
MEASURED_SERIES = ("dof_pos", "dof_vel", "dof_effort")
CONDITIONS = ("temperature", "voltage")
"""What a drive works in: the temperature of its motor and the voltage of its supply."""
JOINT_SERIES = ("dof_pos", "des_dof_pos", "des_dof_vel", "des_dof_effort", "dof_vel", "dof_effort", *CONDITIONS)
POSE_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""Columns of `real_ee_pose`: a position [m], or a position and a quaternion."""
BASE_COLUMNS = {"base_ang_vel": ("x", "y", "z"), "base_lin_acc": ("x", "y", "z"), "base_quat": ("w", "x", "y", "z")}
"""What an IMU shows of a base that moves, and its orientation: the columns of each."""
FEET_SERIES = ("contact", "foot_force")
"""What feet feel of the ground."""
SAMPLED_SERIES = (*MEASURED_SERIES, *CONDITIONS, "torque_enable", "real_ee_pose", *BASE_COLUMNS, *FEET_SERIES)
"""Series with a value at each sample."""
SERIES = ("time", *JOINT_SERIES, "torque_enable", "real_ee_pose", "des_time", *BASE_COLUMNS, *FEET_SERIES)
DRIVE_FACTS = DRIVE_FIELDS
BENCH_FACTS = ("load_mass", "load_length", "arm_mass")
LOAD_FACTS = ("added_mass", "added_mass_at", *BENCH_FACTS)
FACTS = ("name", "joint_names", "time_origin", *DRIVE_FACTS, *LOAD_FACTS, "feet", "imu", "couplings", "comment")

_OTHER_WORDS = {
    "time": ("t", "timestamp", "timestamps", "stamp"),
    "dof_pos": ("q", "pos", "position", "positions", "joint_pos", "joint_position", "dof_position"),
    "des_dof_pos": ("q_des", "target", "targets", "goal_position", "command", "cmd", "joint_pos_target"),
    "des_dof_vel": ("qd_des", "dq_des", "vel_des", "target_velocity", "joint_vel_target"),
    "des_dof_effort": ("tau_ff", "tau_des", "feed_forward", "feedforward", "target_torque", "joint_effort_target"),
    "des_time": ("command_time", "target_time", "t_des"),
    "dof_vel": ("qd", "dq", "vel", "velocity", "velocities", "joint_vel", "joint_velocity", "speed"),
    "dof_effort": ("tau", "effort", "torque", "torques", "joint_effort", "joint_torque"),
    "temperature": ("temp", "temperatures", "motor_temperature", "winding_temperature"),
    "voltage": ("volts", "supply_voltage", "bus_voltage", "battery_voltage"),
    "torque_enable": ("enable", "enabled", "torque_enabled", "torque_on"),
    "base_ang_vel": ("gyro", "gyroscope", "angular_velocity", "imu_gyro", "base_angular_velocity"),
    "base_lin_acc": ("accelerometer", "linear_acceleration", "imu_acc", "specific_force", "base_acceleration"),
    "contact": ("contacts", "foot_contact", "feet_contact", "foot_contacts", "contact_state"),
    "foot_force": ("foot_forces", "feet_force", "contact_force", "contact_forces"),
    "base_quat": ("base_orientation", "orientation", "imu_quat", "root_quat"),
    "joint_names": ("joints", "names", "joint_order", "dof_names"),
    "stiffness": ("kp", "p_gain", "p_gains", "gains_p", "position_gain", "position_gains"),
    "damping": ("kd", "d_gain", "d_gains", "gains_d", "velocity_gain", "velocity_gains"),
    "effort_limit": ("torque_limit", "max_torque", "max_effort"),
    "saturation_effort": ("stall_torque", "saturation_torque"),
    "velocity_limit": ("speed_limit", "max_velocity", "no_load_speed"),
}
_KEY_OF_WORD = {word: key for key, words in _OTHER_WORDS.items() for word in words}
SHARED_FACTS = (*DRIVE_FACTS, *LOAD_FACTS, "feet", "imu", "comment")
"""Facts that may be of several recordings."""


def as_fact(name: str) -> str:
    """The fact that another program's name of a gain means, such as ``kp``; other names as they are."""
    meant = _KEY_OF_WORD.get(name.lower(), "")
    return meant if meant in ("stiffness", "damping") else name


def closest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that was probably meant, or None."""
    known = tuple(known)
    if (meant := _KEY_OF_WORD.get(name.lower())) in known:
        return meant
    by_case = {k.lower(): k for k in known}
    matches = difflib.get_close_matches(name.lower(), by_case, n=1, cutoff=0.75)
    return by_case[matches[0]] if matches else None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ", did you mean 'x'?" or ".", to put behind a name that ends a sentence."""
    match = closest(name, known)
    return f", did you mean '{match}'?" if match else "."
