"""Recordings with gaps in their time stamps, split there: what was commanded and what moved in a gap is not known."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np

from pace_actuators.text import listed

from .checks import MIN_SAMPLES
from .data import Recording
from .keys import COMMAND_SERIES, SAMPLED_SERIES

_STEPS = 3.0
"""Steps of the usual length that a gap is longer than, and ..."""
_SHORTEST = 0.03
"""... how long it is at least [s]: cubics bridge what is shorter."""
_LONGEST = 0.5
"""A gap that is longer than this is never bridged [s]."""
_STILL = 2e-3
"""Joints that move less than this from before a gap to behind it stand still [rad, of slides m]."""
_SLOPE = 5
"""Samples that a slope beside a gap is taken from."""
_PART = 0.5
"""Shorter parts are left out [s]."""
_KEPT = 0.7
"""Share of the samples that parts must keep; else only longer gaps split."""


def split_at_gaps(recording: Recording) -> list[Recording]:
    """The recording from its first command on, or its parts between gaps in which joints moved or commands changed.

    A gap of more than 0.5 s splits in any case.

    Each part begins in motion, with the commands in force there. The first has a note on where it was split, and why:
    samples are missing, or the clock was set ahead while the motion went on.

    Args:
        recording: As it was read, before it is put on a control grid.
    """
    recording = from_first_command(recording)
    time = recording.time
    step = np.diff(time)
    usual = float(np.median(step))
    moving = [
        k
        for k in np.flatnonzero(step > max(_STEPS * usual, _SHORTEST)).tolist()
        if step[k] > _LONGEST or not _is_still(recording, k)
    ]
    if not moving:
        return [recording]
    least, least_samples = 0.0, max(MIN_SAMPLES, round(_PART / usual))
    while True:
        cuts = [k for k in moving if step[k] > least]
        edges: list[int] = [0, *(k + 1 for k in cuts), len(time)]
        parts = [(a, b) for a, b in itertools.pairwise(edges) if b - a >= least_samples]
        if least >= _LONGEST or sum(b - a for a, b in parts) >= _KEPT * len(time):
            break
        least = min(_LONGEST, max(2 * least, _SHORTEST))
    if not cuts:
        return [recording]
    if not parts:
        raise ValueError(
            f"{recording.label}: {len(cuts)} gaps, the longest of {step.max():.3g} s, leave no part of {_PART:g} s. "
            "Record again without losing samples, or check that time is in seconds."
        )
    jumped = [k for k in cuts if _clock_jumped(recording, int(k), usual)]
    words = [
        f"{'the clock jumps ahead by' if k in jumped else 'no samples for'} {step[k]:.3g} s "
        f"at {time[k] - time[0]:.4g} s"
        for k in cuts
    ]
    left = len(time) - sum(b - a for a, b in parts)
    note = f"Split into {len(parts)} part{'s' * (len(parts) > 1)}: {listed(words, 4)}."
    note += f" {left} samples between them are left out." if left else ""
    return [
        _part(recording, a, b, number, note if number == 1 else "", len(parts))
        for number, (a, b) in enumerate(parts, start=1)
    ]


def from_first_command(recording: Recording) -> Recording:
    """The recording from where it is known what is commanded."""
    first = recording.time[0] if recording.des_time is None else recording.des_time[0]
    before = int(np.searchsorted(recording.time, first))
    if not before:
        return recording
    if recording.num_samples - before < MIN_SAMPLES:
        raise ValueError(
            f"{recording.label}: {before} of {recording.num_samples} samples come before the first command, so too "
            "few are left. Record the commands from the beginning on."
        )
    cut = {key: value[before:] for key in ("time", *SAMPLED_SERIES)
           if (value := getattr(recording, key)) is not None}  # fmt: skip
    note = f"The first {recording.time[before] - recording.time[0]:.4g} s were left out: no command is known there."
    return replace(recording, **cut, notes=(*recording.notes, note))


def _is_still(recording: Recording, k: int) -> bool:
    """Whether nothing moves and no command changes over the gap after sample k."""
    gap = float(recording.time[k + 1] - recording.time[k])
    moved = np.abs(recording.dof_pos[k + 1] - recording.dof_pos[k])
    before, after = _slopes(recording, k)
    if np.any(np.maximum(moved, gap * np.maximum(np.abs(before), np.abs(after))) > _STILL):
        return False
    stamps = recording.time if recording.des_time is None else recording.des_time
    first, last = np.searchsorted(stamps, recording.time[k : k + 2], side="right") - 1
    series = (getattr(recording, key) for key in COMMAND_SERIES)
    return all(
        bool(np.all(np.nan_to_num(np.ptp(each[max(first, 0) : last + 1], axis=0)) <= _STILL))
        for each in series
        if each is not None and last >= 0
    )


def _clock_jumped(recording: Recording, k: int, usual: float) -> bool:
    """Whether the motion goes on behind a gap as if one step had passed."""
    gap = float(recording.time[k + 1] - recording.time[k])
    moved = recording.dof_pos[k + 1] - recording.dof_pos[k]
    speed = np.mean(_slopes(recording, k), axis=0)
    one, whole = (float(np.abs(moved - speed * passed).sum()) for passed in (usual, gap))
    return one < 0.3 * whole


def _slopes(recording: Recording, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Speeds just before and behind the gap after sample k, (n,) [rad/s] each."""
    result = []
    for rows in (slice(max(0, k + 1 - _SLOPE), k + 1), slice(k + 1, k + 1 + _SLOPE)):
        time, position = recording.time[rows], recording.dof_pos[rows]
        away = time - time.mean()
        square = float(away @ away)
        result.append(away @ position / square if square else np.zeros(recording.num_joints))
    return result[0], result[1]


def _part(recording: Recording, first: int, end: int, number: int, note: str, count: int) -> Recording:
    """Samples from first to end, with the commands in force while they were taken."""
    begin, last = recording.time[first], recording.time[end - 1]
    rows: dict[str, Any] = {
        key: value[first:end] for key in SAMPLED_SERIES if (value := getattr(recording, key)) is not None
    }
    own = slice(first, end)
    if recording.des_time is not None:
        issued = np.searchsorted(recording.des_time, [begin, last], side="right")
        own = slice(max(0, int(issued[0]) - 1), int(issued[1]))
        rows["des_time"] = recording.des_time[own] - begin
    rows |= {key: value[own] for key in COMMAND_SERIES if (value := getattr(recording, key)) is not None}
    return replace(
        recording,
        **rows,
        time=recording.time[first:end] - begin,
        time_origin=recording.time_origin + float(begin),
        name=recording.name if count == 1 else f"{recording.name} part {number}",
        part_of=recording.name if count > 1 else recording.part_of,
        notes=(*recording.notes, note) if note else (),
    )
