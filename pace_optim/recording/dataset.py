"""The recordings of one fit, side by side on the control grid, split into training and validation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from pace_actuators.text import listed
from pace_optim.recording import Recording, validation_start, with_columns
from pace_optim.recording.carried import GRAVITY, Carried, force_noise, measured_motion, read_earlier
from pace_optim.recording.noise import LEAST_NOISE, noise_floor, noise_variance
from pace_optim.recording.time_base import interpolate_linear
from pace_optim.recording.torque import TorqueChannel

_PAUSE = 6 * 3600.0
"""A pause after which drives are as cold as at the beginning: what comes later is another session [s]."""
_UNIX = 9e8
"""Clocks that show more than this show Unix time [s]."""
_OVERLAP = 0.1
"""Recordings of one clock do not overlap by more than this [s]."""


def session_starts(recordings: Sequence[Recording]) -> tuple[np.ndarray, tuple[str, ...]]:
    """When each recording began since the first of its session, (R,) [s], and a note on each (empty without stamps).

    Stamps place recordings where all show Unix time, or where none does and their spans do not overlap (one clock, and
    not one that starts anew with each file). A pause of more than six hours, such as between days, begins another
    session. Without such stamps the recordings are taken to have been made one after another, in their order.
    """
    began = np.array([recording.start_stamp for recording in recordings])
    if not _one_clock(began, np.array([recording.duration for recording in recordings])):
        return np.cumsum([0.0, *(recording.duration for recording in recordings[:-1])]), ("",) * len(recordings)
    order = np.argsort(began, kind="stable")
    since, session = np.zeros(len(began)), np.zeros(len(began), dtype=int)
    first = until = began[order[0]]
    number = 0
    for r in order:
        if began[r] - until > _PAUSE:
            first, number = began[r], number + 1
        since[r], session[r] = began[r] - first, number
        until = max(until, began[r] + recordings[r].duration)
    which = f"session {{}} of {number + 1}" if number else "its session"
    notes = tuple(
        f"Began {s:.6g} s after the first recording of {which.format(k + 1)}, by its time stamps."
        for s, k in zip(since, session, strict=True)
    )
    return since, notes if len(recordings) > 1 else ("",)


def _one_clock(began: np.ndarray, duration: np.ndarray) -> bool:
    """Whether stamps of all recordings are of one clock."""
    unix = began > _UNIX
    if unix.any():
        return bool(unix.all())
    order = np.argsort(began)
    return bool(np.all(began[order][1:] >= (began + duration)[order][:-1] - _OVERLAP))


_LONGEST = 0.25
"""Time from the beginning in which a slope is sought [s]."""
_DEGREES = (1, 2, 3)
"""Of the polynomials that the motion is taken for there."""
_LENGTHS = 16
"""Numbers of samples that are tried of each."""
_FREEDOM = 2
"""Samples that a window has beyond a polynomial's coefficients, at least."""
_FITS = 2.0
"""Standard deviations of χ² by which a polynomial may miss the samples."""
_STANDS_OUT = 4.0
"""Standard deviations at which a speed is one."""
_CLEAR = 5.0
"""Times the noise that a joint has moved where its motion shows."""
_AT_ONCE = 0.8
"""Part of the speed with which it must have done so: a motion that sets in has less."""
_LEAST_NOISE = 5e-6
"""Of any encoder: a clean simulation has none, and no polynomial fits it [rad]."""


def start_speed(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """The speed of each joint at the first sample, and whether anything is known of it.

    Polynomials of several degrees are fitted to more and more of the first samples. Where one misses them by no more
    than their noise, the polynomial of one degree more gives the slope: what the first one misses is small, not
    nothing. The slope counts that noise moves least:

        v = c₁ of Σ c_i tⁱ,   σ_v² = σ² [(AᵀA)⁻¹]₁₁,   A_ki = t_kⁱ

    Its standard deviation is σ_v and c₂ Δt together, Δt the time between samples: where a held command arrives, the
    acceleration 2 c₂ begins within them. A speed below 4 of them counts as zero: what begins at rest keeps exactly 0.

    Returns:
        Speeds, (n,) [rad/s], and whether a polynomial fits, (n,) bool; as recorded where the recording holds speeds.
    """
    time = recording.time - recording.time[0]
    count = int(np.searchsorted(time, _LONGEST))
    recorded = np.full(recording.num_joints, np.nan) if recording.dof_vel is None else recording.dof_vel[0]
    speed, known = np.nan_to_num(recorded), ~np.isnan(recorded)
    for joint in np.flatnonzero(~known).tolist():
        position = recording.dof_pos[:, joint]
        noise = max(noise_floor(position, float(np.median(np.diff(time)))).sigma, _LEAST_NOISE)
        found = _slope(time[:count], position[:count], noise)
        if found is not None:
            slope, std = found
            moves = abs(slope) > _STANDS_OUT * std and _at_once(time, position, slope, noise)
            speed[joint], known[joint] = slope if moves else 0.0, True
    return speed, known


def _at_once(time: np.ndarray, position: np.ndarray, slope: float, noise: float) -> bool:
    """Whether the first samples that could stand out of the noise move with a speed: at rest, they have not yet."""
    first = min(int(np.searchsorted(time, _CLEAR * noise / abs(slope))), len(time) - 1)
    first = max(first, 1)
    return float(position[first] - position[0]) / float(time[first]) / slope > _AT_ONCE


def _slope(time: np.ndarray, position: np.ndarray, noise: float) -> tuple[float, float] | None:
    """The surest slope at the beginning and its standard deviation; ``None`` where no polynomial fits."""
    best: tuple[float, float, float] | None = None
    for degree in _DEGREES:
        least = degree + 2 + _FREEDOM
        for count in np.unique(np.geomspace(least, max(least, len(time)), _LENGTHS).astype(int)).tolist():
            if count > len(time):
                continue
            scaled, moved = time[:count] / time[count - 1], position[:count] - position[0]
            powers = np.vander(scaled, degree + 2, increasing=True)
            fewer = powers[:, :-1]
            missed = np.square(fewer @ np.linalg.lstsq(fewer, moved, rcond=None)[0] - moved).sum() / noise**2
            freedom = count - degree - 1
            if missed > freedom + _FITS * np.sqrt(2 * freedom):
                continue
            _, slope, bend, *_ = np.linalg.lstsq(powers, moved, rcond=None)[0] / time[count - 1]
            noisy = noise * np.sqrt(np.linalg.inv(powers.T @ powers)[1, 1]) / time[count - 1]
            if best is None or noisy < best[0]:
                best = float(noisy), float(slope), float(np.hypot(noisy, bend * scaled[1]))
    return None if best is None else best[1:]


_TURN = 4.0
"""Of a robot that walks, so much time is trained and validated on in turns [s]."""
_TURN_STARTS = 10
"""Beginnings of turns that are tried."""
_SETTLING = 1.0
"""Time after which a wrong speed at the beginning has died out [s]."""
_LEAST_TORQUE_NOISE = 1e-3
"""Part of a torque's root mean square that its noise is at least: simulations are no better."""
_CHANGE = 0.02
"""Part of its largest value by which a condition changes that says something."""
_SHORTEST = 3.0
"""A recording that is no longer than this many times that keeps its beginning."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Work:
    """How hard drives worked in a session, bin by bin."""

    begin: torch.Tensor
    """Of each bin since the session began, (B,) [s]."""
    end: torch.Tensor
    """The same, (B,) [s]."""
    square: torch.Tensor
    """Mean square of the torque that was asked, (B, n) [N² m²]."""

    def on_joints(self, joints: Sequence[int]) -> Work:
        """That of some joints, by index."""
        return replace(self, square=self.square[:, list(joints)])

    def heat(self, time: torch.Tensor, time_constant: torch.Tensor, joints: Any = slice(None)) -> torch.Tensor:
        """What it has made of the heat h by an instant, T dh/dt + h = τ², h = 0 at first, (rows, joints) [N² m²].

        Args:
            time: Since the session began, (rows, 1) [s].
            time_constant: T, (rows, joints) [s].
        """
        edges = (each.to(time_constant) for each in (self.begin, self.end))
        first, last = (torch.exp(-(time - edge).clamp(min=0.0)[:, :, None] / time_constant[:, None]) for edge in edges)
        return ((last - first) * self.square.to(time_constant)[:, joints]).sum(dim=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Condition:
    """What was logged of the drives' conditions, as a line of straight parts over each of R recordings."""

    time: torch.Tensor
    """When the first of its places was since the session began, and how long it is to the next, (R, 2) [s]."""
    values: torch.Tensor
    """At the places, (R, n, places) [°C or V]; zero for joints of which nothing was logged."""
    known: torch.Tensor
    """Joints of which it was logged in all recordings, (n,) bool."""

    @property
    def varies(self) -> torch.Tensor:
        """Joints on which it changes by more than a fiftieth, (n,) bool: of others it says nothing."""
        low, high = self.values.amin(dim=(0, 2)), self.values.amax(dim=(0, 2))
        return self.known & (high - low > _CHANGE * torch.maximum(high.abs(), low.abs()))


@dataclass(frozen=True, kw_only=True, eq=False)
class Torques:
    """Measured torques of R recordings, laid out like their positions, and what their errors weigh."""

    measured: torch.Tensor
    """(T, R, n) [N m]; zero where it is not known."""
    known: torch.Tensor
    """Where it is, (T, R, n) bool."""
    noise: torch.Tensor
    """Standard deviation of what is taken for a torque's noise, (n,) [N m]."""
    floor: torch.Tensor
    """That of its noise by itself, (n,) [N m]."""
    position_noise: float
    """That of a position [rad]."""
    after: torch.Tensor
    """By how much later than its sample it was measured, (T, R) [control steps]."""
    lag: torch.Tensor
    """How late a sensor shows a torque, (n,) [control steps]; below 0: it is early."""

    @classmethod
    def of(cls, dataset: Dataset, channel: TorqueChannel, held: bool) -> Torques:
        """Those of a dataset's recordings.

        Args:
            channel: Which joints' torques count, and their noise.
            held: Whether drives hold their torques for a control step.
        """
        names = dataset.recordings[0].joint_names
        measured, known = torch.zeros_like(dataset.measured), torch.zeros(dataset.measured.shape, dtype=torch.bool)
        after = torch.zeros(measured.shape[:2], dtype=torch.float64)
        for r, recording in enumerate(dataset.recordings):
            at = torch.as_tensor(recording.sample_steps)
            if recording.effort_offset is not None:
                after[at, r] = torch.as_tensor(recording.effort_offset)
            if recording.dof_effort is not None:
                values = torch.as_tensor(recording.dof_effort)
                measured[at, r], known[at, r] = values.nan_to_num(nan=0.0), values.isfinite()
        known &= torch.tensor([name in channel.noise for name in names])
        known[: math.ceil(max(0.0, *channel.lag.values())) + 1] = False
        size = (measured.square() * known).sum(dim=(0, 1)) / known.sum(dim=(0, 1)).clamp(min=1)
        noise, floor, lag = (
            torch.tensor([own.get(name, 0.0) for name in names], dtype=torch.float64)
            for own in (channel.noise, channel.floor, channel.lag)
        )
        variance = noise_variance([dataset.recordings[r] for r in dataset.trained()])
        return cls(
            measured=measured,
            known=known,
            noise=torch.zeros_like(noise),
            floor=torch.maximum(floor, _LEAST_TORQUE_NOISE * size.sqrt()),
            position_noise=max(variance, LEAST_NOISE**2) ** 0.5,
            after=after.floor() if held else after,
            lag=lag,
        ).with_noise(noise)

    def with_noise(self, noise: torch.Tensor) -> Torques:
        """The same where this is taken for noise, (n,) [N m], but for what is below the floor."""
        return replace(self, noise=torch.maximum(noise, self.floor))

    @property
    def weight(self) -> torch.Tensor:
        """Noise of a position over that of a torque, (n,) [rad/(N m)]: so weighed, both have the same noise."""
        followed = self.known.any(dim=1).any(dim=0)
        return torch.where(followed, self.position_noise / self.noise.clamp(min=1e-300), 0.0)

    def at(self, step: Any, recording: Any) -> Torques:
        """Those of some control steps and recordings, by index."""
        known, after = self.known[step, recording], self.after[step, recording]
        return replace(self, measured=self.measured[step, recording], known=known, after=after)


_OVER_TIME = (
    "command", "command_vel", "command_effort", "measured", "measured_vel", "sampled", "train", "torque_enable",
    "ee_pose", "sample_offset", "settling",
)  # fmt: skip
"""What a dataset has at each control step of each recording."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Dataset:
    """R recordings of n joints, padded to the longest; T control steps.

    Padding holds the last command and has no samples.
    """

    recordings: tuple[Recording, ...]
    """The recordings, conformed."""
    command: torch.Tensor
    """Position targets, (T, R, n) [rad]; for joints without, their first position (they have no position loop)."""
    command_vel: torch.Tensor | None
    """Velocity targets, (T, R, n) [rad/s], zero for joints without; ``None`` if no joint has any."""
    command_effort: torch.Tensor | None
    """Torques commanded, (T, R, n) [N m], zero for joints without; ``None`` if no joint has any."""
    measured: torch.Tensor
    """Encoder positions, (T, R, n) [rad]; zero where there is no sample."""
    measured_vel: torch.Tensor
    """Measured speeds, from the recording or by differences, (T, R, n) [rad/s]; zero where there is no sample."""
    sampled: torch.Tensor
    """Where there is a sample, (T, R) bool."""
    train: torch.Tensor
    """Where there is a sample to train on, (T, R) bool."""
    torque_enable: torch.Tensor | None
    """Whether the drives give torque, (T, R) bool; ``None`` when always."""
    ee_pose: torch.Tensor | None
    """Measured pose of the end effector, (T, R, 3) [m] or (T, R, 7); ``None`` where a recording has none."""
    sample_offset: torch.Tensor | None
    """By how much later than its step each sample was taken, (T, R) [control steps]; ``None`` where never."""
    validation_only: tuple[bool, ...]
    """For each recording, whether none of it is trained on."""
    session_start: torch.Tensor
    """When each recording began since the first of its session, (R,) [s]: by time stamps where all have them, else as
    if they had been made one after another in this order."""
    start_time: torch.Tensor
    """When its first sample was taken, since the recording began, (R,) [s]; not zero of a window."""
    start_vel: torch.Tensor
    """Speed at the first sample, (R, n) [rad/s]: as recorded, else the slope where it stands out of the noise."""
    work: Work | None = None
    """How hard the drives worked in the session; ``None`` where that is not known."""
    settling: torch.Tensor | None = None
    """Samples that are neither trained on nor validated on, (T, R) bool: a recording begins in motion, and its speed
    is not known; ``None`` without any."""
    carried: Carried | None = None
    """How bases move, and where joints are held; ``None`` where all bases rest."""
    torques: Torques | None = None
    """Measured torques that a fit follows; ``None``: positions alone."""

    @cached_property
    def weight(self) -> torch.Tensor | None:
        """Root of what each sample of each joint counts, (T, R, n); ``None``: all the same.

        A joint counts where it is free: there in proportion to how seldom that is, so that means over all samples are
        means over those where it is free. What is trained on and what is not is weighed apart.
        """
        if self.carried is None:
            return None
        free = self.carried.free & self.sampled[..., None]
        result = torch.zeros(free.shape, dtype=torch.float64)
        for part in (self.train, self.sampled & ~self.train):
            own = free & part[..., None]
            share = own.sum(dim=(0, 1)) / part.sum().clamp(min=1)
            result += own * (1 / share.clamp(min=1e-9)).sqrt()
        return result

    @property
    def num_recordings(self) -> int:
        """Number of recordings R."""
        return len(self.recordings)

    @property
    def validation(self) -> torch.Tensor:
        """Where there is a sample that is not trained on, (T, R) bool."""
        return self.sampled & ~self.train if self.settling is None else self.sampled & ~self.train & ~self.settling

    def condition(self, name: str, places: int = 33) -> Condition | None:
        """A condition of the drives over each recording; ``None`` where some recording has none of it.

        Args:
            name: Of what was logged: ``temperature`` or ``voltage``.
            places: How many instants there are to a recording, evenly from its first sample to its last.
        """
        if any(getattr(recording, name) is None for recording in self.recordings):
            return None
        lines, starts = [], (self.session_start - self.start_time).tolist()
        for recording in self.recordings:
            at = np.linspace(recording.time[0], recording.time[-1], places)
            lines.append(interpolate_linear(recording.time, getattr(recording, name), at).T)
        spans = [(recording.time[0], recording.duration / (places - 1)) for recording in self.recordings]
        values = torch.as_tensor(np.stack(lines))
        return Condition(
            time=torch.tensor([(start + first, step) for start, (first, step) in zip(starts, spans, strict=True)]),
            values=values.nan_to_num(nan=0.0),
            known=values.isfinite().all(dim=2).all(dim=0),
        )

    def at(self, step: Any, recording: Sequence[int] | torch.Tensor) -> Dataset:
        """Some control steps (T', W) of some recordings (W,), by index: each becomes a recording."""
        series = {name: value[step, recording] for name in _OVER_TIME if (value := getattr(self, name)) is not None}
        return replace(
            self,
            **series,
            recordings=tuple(self.recordings[r] for r in recording),
            validation_only=tuple(self.validation_only[r] for r in recording),
            session_start=self.session_start[recording],
            start_time=self.start_time[recording],
            start_vel=self.start_vel[recording],
            carried=None if self.carried is None else self.carried.at(step, recording),
            torques=None if self.torques is None else self.torques.at(step, recording),
        )

    def select(self, indices: Sequence[int]) -> Dataset:
        """Some of the recordings, by index."""
        chosen = list(indices)
        carried = None if self.carried is None else self.carried.select(chosen)
        return replace(self.at(slice(None), chosen), carried=carried)

    def to(self, device: torch.device, dtype: torch.dtype) -> Dataset:
        """The same with all tensors on a device, numbers of a type; itself where nothing changes."""
        if self.command.device == device and self.command.dtype == dtype:
            return self
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        for name, value in values.items():
            if isinstance(value, torch.Tensor):
                values[name] = value.to(device, dtype if value.is_floating_point() else value.dtype)
        return Dataset(**values)

    def on_joints(self, joints: Sequence[int]) -> Dataset:
        """The same of some of the joints, by index."""
        chosen = list(joints)
        names = tuple(self.recordings[0].joint_names[j] for j in chosen)
        of_joints = ("command", "command_vel", "command_effort", "measured", "measured_vel", "start_vel")
        series = {name: value[..., chosen] for name in of_joints if (value := getattr(self, name)) is not None}
        return replace(
            self,
            **series,
            recordings=tuple(with_columns(recording, chosen, names) for recording in self.recordings),
            carried=None if self.carried is None else self.carried.on_joints(chosen),
            work=None if self.work is None else self.work.on_joints(chosen),
            torques=None,
        )

    def with_imu_delays(self, delays: Mapping[str, float]) -> Dataset:
        """The same with IMUs that are read later than encoders by so much [s], by the name of whole recordings."""
        every = tuple(
            recording
            if recording.frame is None or not (delay := delays.get(recording.part_of or recording.name, 0.0))
            else replace(recording, frame=read_earlier(recording.frame, delay, recording.control_dt))
            for recording in self.recordings
        )
        return replace(self, recordings=every, carried=_carried(every, len(self.measured)))

    def trained(self) -> list[int]:
        """Indices of the recordings that have samples to train on."""
        return self.train.any(dim=0).nonzero()[:, 0].tolist()

    def last_step(self, where: torch.Tensor) -> int:
        """Control steps up to and including the last true entry of a (T, R) mask."""
        steps = where.any(dim=1).nonzero()
        return int(steps[-1]) + 1 if len(steps) else 0

    def names(self, which: str) -> list[str]:
        """Names of what is trained on or validated on: whole recordings, or their parts in time."""
        result = []
        for r, (recording, validation_only) in enumerate(zip(self.recordings, self.validation_only, strict=True)):
            parts = {"train": bool(self.train[:, r].any()), "validation": bool(self.validation[:, r].any())}
            if not parts[which]:
                continue
            whole = validation_only or not parts["validation"]
            share = float(getattr(self, which)[:, r].sum()) / float(self.sampled[:, r].sum())
            place = "first " if which == "train" else "last "
            in_turns = recording.frame is not None
            part = f"{'' if in_turns else place}{100 * share:.0f} %{' in turns' if in_turns else ''}"
            result.append(recording.name if whole else f"{recording.name} ({part})")
        return result


def make_dataset(
    recordings: Sequence[Recording], validation: Sequence[Recording] = (), train_fraction: float = 0.7
) -> Dataset:
    """Lay recordings side by side.

    Args:
        recordings: To train on, conformed to the same joints and control step.
        validation: Never trained on. Without any, the last part in time of each recording is kept for it.
        train_fraction: Which part of each recording is trained on when ``validation`` is empty; 1 keeps nothing. Of
            a base that moves, it is that part of every 4 s or so.
    """
    every = (*recordings, *validation)
    if not recordings:
        raise ValueError("There is no recording to train on. Name at least one with --data.")
    session_start, notes = session_starts(every)
    every = tuple(replace(r, notes=(*r.notes, note)) if note else r for r, note in zip(every, notes, strict=True))
    steps, n = max(len(_command(r)) for r in every), every[0].num_joints
    shape = (steps, len(every))
    command = torch.zeros(*shape, n, dtype=torch.float64)
    measured, measured_vel = torch.zeros_like(command), torch.zeros_like(command)
    sampled, train = torch.zeros(shape, dtype=torch.bool), torch.zeros(shape, dtype=torch.bool)
    enable, offset = torch.ones(shape, dtype=torch.bool), torch.zeros(shape, dtype=torch.float64)
    start_vel, settling = torch.zeros(len(every), n, dtype=torch.float64), torch.zeros(shape, dtype=torch.bool)
    noted = []
    for r, recording in enumerate(every):
        _hold(command[:, r], _command(recording))
        at = torch.as_tensor(recording.sample_steps)
        if recording.sample_offset is not None:
            offset[at, r] = torch.as_tensor(recording.sample_offset)
        measured[at, r] = torch.as_tensor(recording.dof_pos)
        measured_vel[at, r] = torch.as_tensor(_speed(recording))
        sampled[at, r] = True
        if recording.command_torque_enable is not None:
            _hold(enable[:, r], recording.command_torque_enable)
        if r < len(recordings):
            whole = bool(validation) or train_fraction >= 1
            trained = np.arange(recording.num_samples) < validation_start(recording, min(train_fraction, 0.99))
            if recording.frame is not None:
                trained = _trained_in_turns(recording, train_fraction)
            train[at[torch.from_numpy(trained | whole)], r] = True
        speed, known = start_speed(recording)
        start_vel[r] = torch.as_tensor(speed)
        if not known.all() and recording.duration > _SHORTEST * _SETTLING:
            settling[at[recording.time - recording.time[0] < _SETTLING], r] = True
            recording = replace(recording, notes=(*recording.notes, _unknown_start(recording, known)))
        noted.append(recording)
    return Dataset(
        recordings=tuple(noted),
        command=command,
        command_vel=_further([r.command_vel for r in every], command),
        command_effort=_further([r.command_effort for r in every], command),
        measured=measured,
        measured_vel=measured_vel,
        sampled=sampled,
        train=train & ~settling,
        torque_enable=None if bool(enable.all()) else enable,
        ee_pose=_poses(every, steps),
        sample_offset=offset if bool(offset.any()) else None,
        validation_only=tuple(r >= len(recordings) for r in range(len(every))),
        session_start=torch.as_tensor(session_start),
        start_time=torch.zeros(len(every), dtype=torch.float64),
        start_vel=start_vel,
        settling=settling if bool(settling.any()) else None,
        carried=_carried(every, steps),
    )


def _trained_in_turns(recording: Recording, fraction: float) -> np.ndarray:
    """Which samples of a moving base are trained on, (K,) bool: what a robot does changes as it walks.

    Turns begin where the parts of the joints' free times that are held out differ least from what is asked for.
    """
    turns, count = max(1, round(recording.duration / _TURN)), recording.num_samples
    time = np.arange(count) * turns / count
    ways = [(time + begin) % 1.0 < fraction for begin in np.arange(_TURN_STARTS) / _TURN_STARTS]
    if recording.free is None:
        return ways[0]
    free = recording.free[recording.sample_steps].astype(float)
    free = free[:, free.any(axis=0)]
    off = [np.abs(free[trained].sum(axis=0) / free.sum(axis=0) - fraction).max(initial=0.0) for trained in ways]
    return ways[int(np.argmin(off))]


def _carried(recordings: Sequence[Recording], steps: int) -> Carried | None:
    """How bases move, laid out like commands; those of recordings that say nothing rest."""
    if all(recording.frame is None for recording in recordings):
        return None
    n, count = recordings[0].num_joints, len(recordings)
    base, point = torch.zeros(steps, count, 6, dtype=torch.float64), torch.zeros(count, 3, dtype=torch.float64)
    motion, free = torch.zeros(steps, count, n, 2, dtype=torch.float64), torch.ones(steps, count, n, dtype=torch.bool)
    std, noise = torch.zeros(count, n, 2, dtype=torch.float64), torch.zeros(steps, count, 3, dtype=torch.float64)
    base[..., 5] = GRAVITY
    for r, recording in enumerate(recordings):
        if recording.frame is None:
            continue
        _hold(base[:, r], recording.frame)
        point[r] = torch.as_tensor(recording.frame_point)
        measured, deviation = measured_motion(recording)
        _hold(motion[:, r], measured)
        std[r] = torch.as_tensor(deviation)
        _hold(noise[:, r], force_noise(recording.frame[:, 3:], recording.control_dt))
        if recording.free is not None:
            free[: len(recording.free), r] = torch.as_tensor(recording.free)
            free[len(recording.free) :, r] = False
        free[0, r] = False
    return Carried(base=base, point=point, measured=motion, free=free, start_std=std, force_std=noise)


def _further(commands: Sequence[np.ndarray | None], position: torch.Tensor) -> torch.Tensor | None:
    """Commands beside those of position, laid out like these; zero where a recording has none."""
    if all(each is None for each in commands):
        return None
    result = torch.zeros_like(position)
    for r, each in enumerate(commands):
        if each is not None:
            _hold(result[:, r], each)
    return result


def _poses(recordings: Sequence[Recording], steps: int) -> torch.Tensor | None:
    """Measured poses at the samples, of the columns that all have, (T, R, 3) or (T, R, 7)."""
    found = [recording.real_ee_pose for recording in recordings]
    known = [pose for pose in found if pose is not None]
    if len(known) < len(found):
        return None
    columns = min(pose.shape[1] for pose in known)
    result = torch.zeros(steps, len(known), columns, dtype=torch.float64)
    for r, (pose, recording) in enumerate(zip(known, recordings, strict=True)):
        result[torch.as_tensor(recording.sample_steps), r] = torch.as_tensor(pose[:, :columns])
    return result


def _hold(row: torch.Tensor, values: np.ndarray) -> None:
    """Fill a row over time, and hold the last value to its end."""
    row[: len(values)], row[len(values) :] = torch.as_tensor(values), torch.as_tensor(values[-1])


def _speed(recording: Recording) -> np.ndarray:
    """Speeds as recorded, by differences where they were not, (T, n) [rad/s]."""
    if recording.dof_vel is not None and not np.isnan(recording.dof_vel).any():
        return recording.dof_vel
    difference = np.gradient(recording.dof_pos, recording.time, axis=0)
    return (
        difference
        if recording.dof_vel is None
        else np.where(np.isnan(recording.dof_vel), difference, recording.dof_vel)
    )


def _unknown_start(recording: Recording, known: np.ndarray) -> str:
    joints = listed([name for name, yes in zip(recording.joint_names, known, strict=True) if not yes], 3)
    return (
        f"It begins in motion, and its first samples do not show the speed of {joints}: the first {_SETTLING:g} s are "
        "left out. Begin at rest, or record speeds (dof_vel)."
    )


def _command(recording: Recording) -> np.ndarray:
    if recording.command is None:
        raise ValueError(f"{recording.label}: not on the control grid. Call conform_recording first.")
    return recording.command
