"""What messages of ROS say of joints: states, trajectories, controller states, arrays, and any other with numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import lru_cache
from typing import Any

import numpy as np

Names = tuple[tuple[str, str, str], ...]
"""Of each value its key, series and joint."""

_QUANTITIES = {
    "position": "dof_pos", "positions": "dof_pos", "velocity": "dof_vel", "velocities": "dof_vel",
    "effort": "dof_effort", "efforts": "dof_effort",
}  # fmt: skip
_COMMANDED = ("desired", "reference", "output", "command", "commands")
_MEASURED = ("actual", "feedback", "state")
_FINE = 5_000_000
"""Spacing at which a trajectory of several points is followed [ns]."""
_LONGEST = 86_400_000_000_000
"""Longest trajectory that is followed [ns]: a day."""
_MOST = 600
"""Numbers of a message beyond which it is no message on joints (images, maps)."""

_HEAD = "std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint {}\n"
STATE_DEFINITIONS = {
    "control_msgs/msg/JointTrajectoryControllerState": _HEAD.format("desired")
    + "trajectory_msgs/JointTrajectoryPoint actual\ntrajectory_msgs/JointTrajectoryPoint error\n"
}
"""Messages that older bags hold without their definition, and that the readers do not know."""


def rows_of(message: Any, topic: str) -> Iterator[tuple[int, Names, np.ndarray]]:
    """What a message says: instants after its stamp [ns], what the values are, and the values."""
    joints = getattr(message, "joint_names", None)
    if joints is not None and hasattr(message, "points"):
        yield from _trajectory(message, topic)
        return
    if joints is None:
        joints = getattr(message, "name", None)
    if joints is not None and not isinstance(joints, str) and len(joints):
        named = _named(message, topic, tuple(str(j) for j in joints))
        if named:
            yield 0, tuple(name for name, _ in named), np.array([value for _, value in named])
            return
    flat = list(_numbers(message, ""))
    if flat and len(flat) <= _MOST:
        yield 0, _flat_names(topic, tuple(place for place, _ in flat)), np.array([value for _, value in flat])


def _named(message: Any, topic: str, joints: tuple[str, ...]) -> list[tuple[tuple[str, str, str], float]]:
    """Values of a message that names its joints: its own fields, and those of `desired`, `reference`, ..."""
    result = []
    for name in _names(message.__class__):
        part = getattr(message, name)
        if name in _QUANTITIES:
            result += _per_joint(part, topic, name, joints, _QUANTITIES[name])
        elif name in (*_COMMANDED, *_MEASURED) and is_dataclass(part):
            des = "des_" if name in _COMMANDED else ""
            for inner in _names(part.__class__):
                if inner in _QUANTITIES:
                    result += _per_joint(
                        getattr(part, inner), topic, f"{name}.{inner}", joints, des + _QUANTITIES[inner]
                    )
        elif name == "interface_values":  # control_msgs/DynamicJointState
            for joint, values in zip(joints, part, strict=True):
                for interface, value in zip(values.interface_names, values.values, strict=True):
                    series = _QUANTITIES.get(interface, "")
                    result.append(((f"{topic}:{interface}[{joint}]", series, joint), float(value)))
    return result


def _per_joint(
    values: Any, topic: str, place: str, joints: tuple[str, ...], series: str
) -> list[tuple[tuple[str, str, str], float]]:
    if not hasattr(values, "__len__") or len(values) != len(joints):
        return []
    return [
        ((f"{topic}:{place}[{joint}]", series, joint), float(value))
        for joint, value in zip(joints, values, strict=True)
    ]


def _trajectory(message: Any, topic: str) -> Iterator[tuple[int, Names, np.ndarray]]:
    """A trajectory: its point where it has one, straight lines between its points where it has more."""
    joints, points = tuple(str(j) for j in message.joint_names), message.points
    if not points:
        return
    names: list[tuple[str, str, str]] = []
    columns = []
    for place in ("positions", "velocities", "effort"):
        rows = [getattr(point, place) for point in points]
        if all(len(row) == len(joints) for row in rows):
            names += [(f"{topic}:{place}[{joint}]", f"des_{_QUANTITIES[place]}", joint) for joint in joints]
            columns.append(np.array(rows, dtype=np.float64))
    if not names:
        return
    table = np.concatenate(columns, axis=1)
    if len(points) == 1:
        yield 0, tuple(names), table[0]
        return
    after = np.array([p.time_from_start.sec * 1_000_000_000 + p.time_from_start.nanosec for p in points])
    if after[-1] - after[0] > _LONGEST:
        raise ValueError(
            f"{topic}: a trajectory lasts {1e-9 * (after[-1] - after[0]):.3g} s, expected at most a day. Leave its "
            "messages out of the bag."
        )
    for at in range(int(after[0]), int(after[-1]) + 1, _FINE):
        yield at, tuple(names), np.array([np.interp(at, after, column) for column in table.T])


def _numbers(value: Any, place: str) -> Iterator[tuple[str, float]]:
    """Every number of a message, with its place in it; headers and layouts are left out."""
    if isinstance(value, (bool, int, float, np.number, np.bool_)):
        yield place, float(value)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        for i, item in enumerate(value.ravel()[: _MOST + 1].tolist()):
            yield f"{place}[{i}]", float(item)
    elif is_dataclass(value):
        for name in _names(value.__class__):
            if name not in ("header", "layout"):
                yield from _numbers(getattr(value, name), f"{place}.{name}" if place else name)
    elif isinstance(value, (list, tuple)):
        for i, item in enumerate(value[: _MOST + 1]):
            yield from _numbers(item, f"{place}[{i}]")


@lru_cache(maxsize=512)
def _flat_names(topic: str, places: tuple[str, ...]) -> Names:
    return tuple((f"{topic}:{place}", "", "") for place in places)


@lru_cache(maxsize=512)
def _names(kind: Any) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind) if not field.name.startswith("__"))
