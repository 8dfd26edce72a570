"""rosbag2 (.mcap, .db3, folders) and ROS 1 (.bag): every number of every topic over time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pace_actuators.memory import check_memory
from pace_optim.recording.time_base import interpolate_linear

from .log import Channel, Log, cleaned, reader

_CLOCKS_AGREE = 0.5
"""Header stamps further than this from the instants of arrival are of another clock [s]."""
_AT_ONCE = 100_000
"""Messages after which it is looked again whether there is memory for more."""
_BYTES_PER_ROW = 10_000
"""Memory of a message's numbers, of the longest ones."""
_GOOD = 0.98
"""Share of messages whose header must hold a stamp."""


class _Rows:
    """Messages of one topic that have the same names."""

    def __init__(self) -> None:
        self.received: list[int] = []
        self.stamped: list[int] = []
        self.message: list[int] = []
        self.after: list[int] = []
        self.values: list[np.ndarray] = []


def read_rosbag(path: Path) -> Log:
    """Read a bag; channels are called ``/topic:field[joint]``."""
    highlevel = reader("rosbags.highlevel", path)
    typesys = reader("rosbags.typesys", path)
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE if path.suffix != ".bag" else typesys.Stores.ROS1_NOETIC)
    for name, text in STATE_DEFINITIONS.items():
        store.register(typesys.get_types_from_msg(text, name))
    tables: dict[str, dict[tuple[tuple[str, str, str], ...], _Rows]] = {}
    unread: dict[str, str] = {}
    count = 0
    try:
        with highlevel.AnyReader([path], default_typestore=store) as bag:
            for number, (connection, received, raw) in enumerate(bag.messages()):
                if connection.topic in unread:
                    continue
                try:
                    message = bag.deserialize(raw, connection.msgtype)
                except (KeyError, highlevel.AnyReaderError) as error:
                    unread[connection.topic] = f"{connection.msgtype} ({type(error).__name__})"
                    continue
                for after, names, values in rows_of(message, connection.topic):
                    count += 1
                    if count % _AT_ONCE == 0:
                        check_memory(
                            _AT_ONCE * _BYTES_PER_ROW, f"{path}: reading beyond {count:.3g} messages", "Cut it."
                        )
                    rows = tables.setdefault(connection.topic, {}).setdefault(names, _Rows())
                    rows.received.append(received + after)
                    stamp = _stamp(message)
                    rows.stamped.append(stamp + after if stamp else 0)
                    rows.message.append(number)
                    rows.after.append(after)
                    rows.values.append(values)
    except ValueError:
        raise
    except Exception as error:  # readers raise many kinds for a damaged file
        text = " ".join(str(error).split())[:200]
        raise ValueError(
            f"{path}: cannot be read as a bag ({type(error).__name__}: {text}). Copy it again, or run ros2 bag reindex."
        ) from error
    every = [rows for groups in tables.values() for rows in groups.values()]
    if not every:
        raise ValueError(
            f"{path}: holds no message with numbers in it. Record the topics of joint states and commands."
        )
    use_header, note = _clock(every)
    notes = [note, *(f"{topic}: not read, it is {what}." for topic, what in unread.items())]
    origin = min(min(_times(rows, use_header)) for rows in every)
    channels: dict[str, Channel] = {}
    for topic, groups in tables.items():
        for each, more in _channels(topic, groups, use_header, origin):
            notes += more
            for channel in each:
                channels[channel.key] = _joined(channels.get(channel.key), channel)
    seconds = origin * 1e-9
    return Log(name=path.stem, channels=channels, time_origin=seconds if seconds > 9e8 else 0.0, notes=tuple(notes))


def _channels(
    topic: str, groups: dict[tuple[tuple[str, str, str], ...], _Rows], use_header: bool, origin: int
) -> Iterator[tuple[list[Channel], list[str]]]:
    by_joints: dict[frozenset[str], list[_Rows]] = {}
    for names, rows in groups.items():
        by_joints.setdefault(frozenset(joint for _, _, joint in names), []).append(rows)
    for names, rows in groups.items():
        alike = by_joints[frozenset(joint for _, _, joint in names)]
        kept = _not_replaced(rows, alike, use_header)
        time = (np.array(_times(rows, use_header), dtype=np.int64) - origin)[kept] * 1e-9
        values = np.array(rows.values, dtype=np.float64)[kept]
        columns = {key: values[:, i] for i, (key, _, _) in enumerate(names)}
        yield cleaned(
            topic,
            time,
            columns,
            series={key: series for key, series, _ in names},
            joint={key: joint for key, _, joint in names},
        )


def _not_replaced(rows: _Rows, alike: Sequence[_Rows], use_header: bool) -> np.ndarray:
    """Which rows count, (T,) bool: a trajectory ends where a later message begins.

    Args:
        alike: Those of the same topic and joints.
    """
    if not any(any(each.after) for each in alike):
        return np.ones(len(rows.values), dtype=bool)
    message = np.concatenate([each.message for each in alike])
    begin = np.concatenate([np.array(_times(each, use_header)) - each.after for each in alike])
    order = np.argsort(message, kind="stable")
    next_begin = np.append(np.minimum.accumulate(begin[order][::-1])[::-1], np.iinfo(np.int64).max)
    later = np.searchsorted(message[order], rows.message, side="right")
    return np.array(_times(rows, use_header)) < next_begin[later]


def _joined(one: Channel | None, other: Channel) -> Channel:
    """Two parts of one channel: a topic whose messages name different joints."""
    if one is None:
        return other
    time, index = np.unique(np.concatenate([one.time, other.time]), return_index=True)
    values = np.concatenate([one.values, other.values])[index]
    return Channel(
        key=one.key, table=one.table, time=time, values=values, series=one.series, joint=one.joint or other.joint
    )


def _stamp(message: Any) -> int:
    """The stamp in a message's header [ns], or 0."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _clock(every: list[_Rows]) -> tuple[bool, str]:
    """Whether header stamps can be used, and what to say about it."""
    late, stamped, count = [], 0, 0
    for rows in every:
        received, header = np.array(rows.received), np.array(rows.stamped)
        has = header > 0
        stamped, count = stamped + int(has.sum()), count + len(has)
        if has.mean() > _GOOD:
            late.append(float(np.median((received - header)[has])) * 1e-9)
    if not late:
        return False, "Time is when messages were received: their headers hold no stamps."
    if max(abs(each) for each in late) > _CLOCKS_AGREE:
        return False, (
            "Time is when messages were received: header stamps are of another clock "
            f"({max(late, key=abs):.3g} s from it)."
        )
    some = "" if stamped == count else ", and when they were received for those without"
    return True, f"Time is the stamp in the messages' headers{some} (received {1e3 * max(late):.3g} ms later at most)."


def _times(rows: _Rows, use_header: bool) -> list[int]:
    if use_header and np.mean(np.array(rows.stamped) > 0) > _GOOD:
        return [stamp or received for stamp, received in zip(rows.stamped, rows.received, strict=True)]
    return rows.received


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
    count = int(-(-(after[-1] - after[0]) // _FINE))
    for first in range(0, count + 1, _AT_ONCE):  # the memory is looked at in between
        steps = np.arange(first, min(first + _AT_ONCE, count + 1))
        instants = np.minimum(after[0] + _FINE * steps, after[-1])
        for at, values in zip(instants.tolist(), interpolate_linear(after, table, instants), strict=True):
            yield at, tuple(names), values


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
