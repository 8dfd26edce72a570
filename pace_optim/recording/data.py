"""The data classes of a recording: what was measured, what was commanded, and the facts that go with it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pace_actuators.text import listed


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """The drive in force while recording; one value per joint, None where the file does not say."""

    stiffness: np.ndarray | None = None
    """Proportional gain, (n,) [N m/rad]."""
    damping: np.ndarray | None = None
    """Derivative gain, (n,) [N m s/rad]."""
    effort_limit: np.ndarray | None = None
    """Largest torque, (n,) [N m]."""
    saturation_effort: np.ndarray | None = None
    """Stall torque of the torque-speed line, (n,) [N m]."""
    velocity_limit: np.ndarray | None = None
    """No-load speed of the torque-speed line, (n,) [rad/s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Load:
    """The load carried while recording; empty or None where the file does not say."""

    added_mass: Mapping[str, float] = field(default_factory=dict)
    """Mass added to a body, {body: kg}."""
    added_mass_at: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    """Where it is, in the body's frame, {body: (x, y, z)} [m]; a mass without is at its body's centre of mass."""
    load_mass: float | None = None
    """Point mass at the end of the test bench's arm [kg]."""
    load_length: float | None = None
    """Distance of that mass from the axis [m]."""
    arm_mass: float | None = None
    """Mass of the test bench's uniform rod [kg]."""


@dataclass(frozen=True, kw_only=True)
class ImuPose:
    """Where an IMU is on the base, and how it is turned."""

    site: str = "imu"
    """Name of the model's site; not used where a body is named."""
    body: str = ""
    """Body that it is fixed to, of a pose that is stated."""
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """In that body's frame [m]."""
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """From the IMU's axes to that body's, (w, x, y, z)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """One recording of n joints over T samples.

    `dof_pos[k]` is measured at `time[k]`. What is commanded (`des_...`: at least one of the three) is issued at the
    same instants, or at those of `des_time`, and holds until the next, as drives hold it. In every series but `dof_pos`
    a column of NaN says that the joint has none. `load_recording` gives a recording as its file has it;
    `conform_recording` puts it on a simulation's grid and fills `command`, `command_vel` and `command_effort`.
    """

    name: str
    """The file's "name", or the stem of its path."""
    joint_names: tuple[str, ...]
    """Names in the order of the columns; empty when the file has none (a conformed recording has them)."""
    time: np.ndarray
    """Instants, (T,) [s]; starts at 0 once conformed."""
    dof_pos: np.ndarray
    """Encoder positions, (T, n) [rad]."""
    des_dof_pos: np.ndarray | None = None
    """Commanded positions, (T, n) or (T', n) [rad]."""
    des_dof_vel: np.ndarray | None = None
    """Commanded speeds, (T, n) or (T', n) [rad/s]."""
    des_dof_effort: np.ndarray | None = None
    """Commanded torques (feed-forward, or all there is), (T, n) or (T', n) [N m]."""
    des_time: np.ndarray | None = None
    """Instants of the commands on the clock of `time`, (T',) [s]; None: those of `time`."""
    dof_vel: np.ndarray | None = None
    """Measured speeds, (T, n) [rad/s]."""
    dof_effort: np.ndarray | None = None
    """Torques that the drive measures or asks for, (T, n) [N m]."""
    temperature: np.ndarray | None = None
    """Temperature of each joint's motor, (T, n) [°C]."""
    voltage: np.ndarray | None = None
    """Voltage of each drive's supply, (T, n) [V]."""
    torque_enable: np.ndarray | None = None
    """False where the drive gives no torque, (T,) bool."""
    real_ee_pose: np.ndarray | None = None
    """Measured pose of the end effector in the base's frame, (T, 3) [m], or (T, 7) with a quaternion (w, x, y, z)."""
    base_ang_vel: np.ndarray | None = None
    """Angular velocity of a base that moves, in the IMU's axes, (T, 3) [rad/s]."""
    base_lin_acc: np.ndarray | None = None
    """Specific force of it at the IMU, in its axes, (T, 3) [m/s²]: +9.81 upwards at rest."""
    base_quat: np.ndarray | None = None
    """Orientation of it in the world, (T, 4), (w, x, y, z): drawn, not needed."""
    contact: np.ndarray | None = None
    """Which feet touch the ground, (T, feet) bool."""
    foot_force: np.ndarray | None = None
    """Force on each foot, (T, feet) or (T, feet, 3) [N]."""
    feet: tuple[str, ...] = ()
    """Bodies, geoms, sites or legs that these are of."""
    couplings: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Motors that move several joints, {motor: {joint: ratio}}, where the robot's model does not have them."""
    imu: ImuPose = field(default_factory=ImuPose)
    """Where the IMU is."""
    time_origin: float = 0.0
    """What the log's own clock showed at `time` = 0 [s]: Unix time where the log has it."""
    drive: Drive = field(default_factory=Drive)
    """The drive in force."""
    load: Load = field(default_factory=Load)
    """The load carried."""
    sample_stride: int = 1
    """Control steps per sample (set by `conform_recording`)."""
    sample_at: np.ndarray | None = None
    """Nearest control step of each sample, (T,), where they do not lie on every `sample_stride`-th; else None."""
    sample_offset: np.ndarray | None = None
    """By how much later than that each of these samples was taken, (T,) [control steps]."""
    effort_offset: np.ndarray | None = None
    """By how much later than its sample each `dof_effort` was measured, (T,) [control steps]; None: with it."""
    command: np.ndarray | None = None
    """Commanded positions on the control grid, ((T - 1) * sample_stride + 1, n) [rad]; None until conformed.

    A joint without position commands (see `has_position_command`) keeps its first position here.
    """
    command_vel: np.ndarray | None = None
    """Commanded speeds on the control grid [rad/s], zero for joints that have none; None where no joint has any."""
    command_effort: np.ndarray | None = None
    """Commanded torques on the control grid [N m], zero for joints that have none; None where no joint has any."""
    command_torque_enable: np.ndarray | None = None
    """`torque_enable` on the control grid, or None."""
    unit_stated: tuple[str, ...] = ()
    """Joints whose positions' unit the log itself states: no advice doubts it."""
    notes: tuple[str, ...] = ()
    """What a user should know about this recording, in plain sentences."""
    source: str = ""
    """Path of the file."""
    logged: Recording | None = None
    """The same as it was logged, where it was resampled or its commands have a separate clock."""
    command_dt: float | None = None
    """Time between two commands as they were logged [s]; None until conformed."""
    part_of: str = ""
    """Name of the recording that this is a part of; empty: it is whole."""
    frame: np.ndarray | None = None
    """Angular velocity [rad/s] and specific force [m/s²] of the base in the model's axes at control steps, (steps, 6);
    None until it has been conformed to a robot, and where the base rests."""
    frame_point: np.ndarray | None = None
    """Where that force acts, (3,) [m], in the model's world."""
    free: np.ndarray | None = None
    """Where only its drive and the base act on a joint, (steps, n) bool; None: everywhere."""

    @property
    def control_dt(self) -> float:
        """Control step [s], once conformed."""
        last = self.num_samples - 1
        offset = 0.0 if self.sample_offset is None else float(self.sample_offset[last] - self.sample_offset[0])
        return self.duration / (float(self.sample_steps[last]) + offset)

    @property
    def base_moves(self) -> bool:
        """Whether the base moves, once conformed."""
        return self.frame is not None and bool(np.ptp(self.frame, axis=0).any())

    @property
    def num_samples(self) -> int:
        """Number of samples T."""
        return len(self.time)

    @property
    def num_joints(self) -> int:
        """Number of joints n."""
        return self.dof_pos.shape[1]

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def start_stamp(self) -> float:
        """What the log's own clock showed at the first sample [s]: Unix time where the log has it."""
        return self.time_origin + float(self.time[0])

    @property
    def has_position_command(self) -> np.ndarray:
        """Which joints have position commands, (n,) bool; the others have no position loop."""
        return _has_values(self.des_dof_pos, self.num_joints)

    @property
    def has_velocity_command(self) -> np.ndarray:
        """Which joints have velocity commands, (n,) bool."""
        return _has_values(self.des_dof_vel, self.num_joints)

    @property
    def has_effort_command(self) -> np.ndarray:
        """Which joints have torque commands, (n,) bool."""
        return _has_values(self.des_dof_effort, self.num_joints)

    @property
    def is_commanded(self) -> np.ndarray:
        """Which joints have commands of any kind, (n,) bool."""
        return self.has_position_command | self.has_velocity_command | self.has_effort_command

    @property
    def sample_steps(self) -> np.ndarray:
        """Control step of each sample, (T,); once conformed."""
        return np.arange(self.num_samples) * self.sample_stride if self.sample_at is None else self.sample_at

    @property
    def sampled_command(self) -> np.ndarray:
        """`command` at the samples, (T, n) [rad]."""
        if self.command is None:
            raise ValueError(f"{self.label}: not on the control grid. Call conform_recording first.")
        return self.command[self.sample_steps]

    @property
    def label(self) -> str:
        """How messages call this recording: its path, or its name when it came from no file."""
        return self.source or self.name


def validation_start(recording: Recording, fraction: float = 0.7) -> int:
    """Return the index of the first sample to validate on; samples before it are for training.

    Args:
        recording: The recording to split in time.
        fraction: Share of the samples used for training, between 0 and 1.
    """
    if not 0.0 < fraction < 1.0:
        raise ValueError(
            f"{recording.label}: found a training share of {fraction}; expected a number between 0 and 1. "
            "Use 0.7 to validate on the last 30 %."
        )
    return min(max(round(fraction * recording.num_samples), 1), recording.num_samples - 1)


def _has_values(series: np.ndarray | None, num_joints: int) -> np.ndarray:
    return np.zeros(num_joints, dtype=bool) if series is None else ~np.isnan(series).all(axis=0)


_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WITH_UNIT = re.compile(rf"({_NUMBER.pattern})(?: [^\W\d][\w/²]*)?")


def notes_by_kind(recordings: Sequence[Recording]) -> list[str]:
    """Notes with the recordings that have them; of those that differ in numbers alone, others show these numbers.

    Args:
        recordings: In the order of the notes.
    """
    kinds: dict[str, list[tuple[str, str]]] = {}
    for recording in recordings:
        for note in recording.notes:
            kinds.setdefault(_NUMBER.sub("#", note), []).append((recording.name, note))
    result = []
    for told in kinds.values():
        note = told[0][1]
        alike = listed(dict.fromkeys(name for name, text in told if text == note), 6)
        others = {name: text for name, text in told if text != note}
        numbers = [f"{name}: {', '.join(_other_numbers(note, text))}" for name, text in others.items()]
        more = f" ({'; '.join(numbers[:3])}{f' and {len(numbers) - 3} more' if len(numbers) > 3 else ''})"
        result.append(f"{alike}: {note}{more if numbers else ''}")
    return result


def _other_numbers(note: str, other: str) -> list[str]:
    """The numbers of a note that differ from those of another, with their units."""
    pairs = zip(_WITH_UNIT.finditer(note), _WITH_UNIT.finditer(other), strict=True)
    return [second[0] for first, second in pairs if first[1] != second[1]]
