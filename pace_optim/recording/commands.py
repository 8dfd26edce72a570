"""What was commanded, on the control grid: held from each instant to the next, as drives hold it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from pace_actuators.drive_result import CommandTiming

from .data import Recording
from .keys import COMMAND_SERIES
from .time_base import TimeBase, hold_on_grid

GRID_COMMANDS = {"des_dof_pos": "command", "des_dof_vel": "command_vel", "des_dof_effort": "command_effort"}
"""The field of a conformed recording that holds each command on the control grid."""
_EVEN = 2e-3
"""An interval this near to a tenth of a millisecond or to a whole number of Hz is that."""
_OFTEN = 0.1
"""Part of the changes of the most active joint's command that show another joint's interval."""
_CHANCE = 0.5
"""Part of the common changes that chance would have, of which commands of one clock have more."""
_FOLLOWS = 0.1
"""Part of a command's deviation by which the ticks that are counted follow the timer, whose rate is not known yet."""


def commands_on_grid(recording: Recording, base: TimeBase, control_dt: float) -> dict[str, Any]:
    """The commands of a recording on the control grid, and as its own series.

    Args:
        recording: Before its samples were put on the grid; no sample comes before its first command.
        control_dt: Control step [s].
    """
    stride, count = base.sample_stride, base.num_steps
    result: dict[str, Any] = {"command": np.repeat(recording.dof_pos[:1], count, axis=0)}
    instants = (recording.time if recording.des_time is None else recording.des_time) - recording.time[0]
    if base.exact:  # the grid has the clock's drift
        instants = instants * ((base.num_samples - 1) * stride * control_dt / recording.duration)
    for key in COMMAND_SERIES:
        if (values := getattr(recording, key)) is None:
            continue
        if recording.des_time is None and base.exact:
            held = np.repeat(values, stride, axis=0)[:count]
        else:
            held = hold_on_grid(instants, values, control_dt, count)
        none = np.isnan(values).all(axis=0)
        if recording.des_time is not None:
            result[key] = held
        elif base.sample_at is None:  # placed samples keep their own
            result[key] = held[::stride]
        result[GRID_COMMANDS[key]] = np.where(none, result["command"] if key == "des_dof_pos" else 0.0, held)
    if recording.des_time is not None:
        result["des_time"] = control_dt * np.arange(count)
    return result


def acting_loops(recording: Recording, stiffness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which joints' drives act on the position and on the speed, (n,) bool each.

        τ = kp (q* − q) + kd (q̇* − q̇) + τ_ff

    A position loop needs a target. Damping that the recording states, or that stands alone (kp = 0), acts on the
    measured speed whether or not a speed is commanded. The damping of a configured position loop goes with that loop.

    Args:
        recording: What is commanded, and what it states of its drives.
        stiffness: kp in force, (n,) [N m/rad].
    """
    position = recording.has_position_command
    alone = np.full(recording.num_joints, recording.drive.damping is not None) | (stiffness == 0.0)
    return position, position | recording.has_velocity_command | alone


def command_interval(recording: Recording) -> float:
    """Time from one command to the next, as they were logged [s]: repeated commands do not count.

    Instants of a separate clock may be those of several clocks together: the interval is that of one of them.

    Args:
        recording: As `load_recording` gives it.
    """
    instants = recording.time if recording.des_time is None else recording.des_time
    series = [values for key in COMMAND_SERIES if (values := getattr(recording, key)) is not None]
    every = np.nan_to_num(np.concatenate(series, axis=1))
    if len(every) != len(instants):  # one for each control step
        instants = np.linspace(instants[0], instants[-1], len(every))
    new = np.diff(every, axis=0) != 0
    changed = [np.any(new, axis=1)] if recording.des_time is None else _of_clocks(new)
    most = max(int(each.sum()) for each in changed)
    steps = [np.diff(instants[1:][each]) for each in changed if each.sum() >= max(2, _OFTEN * most)]
    if not steps:  # no command follows another: as often as there are commands, or samples
        steps = [np.diff(instants if len(instants) > 1 else recording.time)]
    interval = min(float(np.median(each)) for each in steps)
    even = min((1 / max(1, round(1 / interval)), round(interval, 4)), key=lambda each: abs(each - interval))
    return even if abs(even / interval - 1) < _EVEN else interval


def _of_clocks(new: np.ndarray) -> list[np.ndarray]:
    """When the commands of each clock change, (T,) bool each.

    Commands of one clock change at the same instant about as often as chance has it, those of two clocks hardly ever.

    Args:
        new: When each command changes, (T, n) bool.
    """
    together = new.T.astype(float) @ new
    count = together.diagonal()
    often = count >= max(2, _OFTEN * count.max())
    same = (together > _CHANCE * np.outer(count, count) / max(1, len(new))) & np.outer(often, often)
    number, of = connected_components(same, directed=False)
    return [np.any(new[:, of == k], axis=1) for k in range(number)]


def command_timing(recordings: Iterable[Recording]) -> CommandTiming | None:
    """When commands came against an even timer, over recordings whose commands have a separate clock.

    The k-th tick of a timer is at t₀ + k T. Ticks are counted along the stamps, and a straight line through them gives
    t₀ and T. What a stamp is off by is jitter; a tick without a stamp is a lost command.

    Args:
        recordings: As `load_recording` gives them.

    Returns:
        ``None`` where none has such stamps, or where they follow no timer: nine in ten lie further apart than half
        an interval.
    """
    off, steps, ticks, came = list[np.ndarray](), list[float](), 0, 0
    for own in (each.des_time for each in recordings):
        if own is None or len(own) < 3:
            continue
        interval = float(np.median(np.diff(own)))
        count, at = np.zeros(len(own)), own[0]
        for k in range(1, len(own)):
            passed = round((own[k] - at) / interval)
            at += passed * interval
            at += _FOLLOWS * (own[k] - at)
            count[k] = count[k - 1] + passed
        step, start = np.polyfit(count, own - own[0], 1)
        off.append(own - own[0] - start - step * count)
        steps.append(float(step))
        ticks, came = ticks + int(count[-1]) + 1, came + len(np.unique(count))
    if not off:
        return None
    interval = float(np.median(steps))
    early, late = (float(each) for each in np.quantile(np.concatenate(off), (0.05, 0.95)))
    if late - early > interval / 2:
        return None
    return CommandTiming(interval_s=interval, early_s=-early, late_s=late, lost=1 - came / ticks)


def timing_note(recording: Recording) -> str:
    """When the commands of a recording came, in a sentence; "" where it does not stamp them."""
    timing = command_timing([recording])
    if timing is None:
        return ""
    every, early, late = 1e3 * timing.interval_s, 1e3 * timing.early_s, 1e3 * timing.late_s
    return (
        f"Commands came every {every:.4g} ms, nine in ten from {early:.2g} ms before to {late:.2g} ms after their "
        f"tick, and {100 * timing.lost:.2g} % are lost: each is held from its own stamp."
    )
