"""rosbag2 (.mcap, .db3, folders) and ROS 1 (.bag): every number of every topic over time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pace_actuators.memory import check_memory

from .log import Channel, Log, cleaned
from .messages import STATE_DEFINITIONS, rows_of
from .optional import reader

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
            for connection, received, raw in bag.messages():
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
    for names, rows in groups.items():
        time = (np.array(_times(rows, use_header), dtype=np.int64) - origin) * 1e-9
        values = np.array(rows.values, dtype=np.float64)
        columns = {key: values[:, i] for i, (key, _, _) in enumerate(names)}
        yield cleaned(
            topic,
            time,
            columns,
            series={key: series for key, series, _ in names},
            joint={key: joint for key, _, joint in names},
        )


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
