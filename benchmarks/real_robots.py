"""The real recordings that others have published: what is known of each robot, and how its files become ours.

The recordings are not part of this project. Each folder has its own licence, which is copied beside what is converted
from it.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pace_envs.robots import GO2_JOINTS, SO101_JOINTS
from pace_optim.recording import Drive, Load, Recording, load_recording, save_recording

COUNTS_PER_RAD = 4096 / (2 * math.pi)


@dataclass(frozen=True, kw_only=True)
class RealRobot:
    """One folder of recordings, and how it is divided."""

    name: str
    """Name of the folder."""

    task: str
    """Environment that it is fitted in."""

    suffix: str
    """Of the files in the folder."""

    licence: str
    """Whose recordings they are, and under which licence."""

    convert: Callable[[Recording], Recording]
    """Adds the facts, renames and maps joints."""

    train: tuple[str, ...]
    """Stems of the files that are fitted."""

    validation: tuple[str, ...] = ()
    """Stems of the files that are held out; none holds out the last 30 % of each."""

    optimizer: str = "least_squares"
    """What a fit takes if nothing else is asked for: ``hybrid`` where least squares ends in a wrong valley."""

    windows: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Part of a file that is kept, from and to [s]; whole where not named."""


def servo_drive(duty_per_rad: float, stall_torque: float, no_load_speed: float, joints: int = 1) -> Drive:
    """The PD drive that a servo with a duty cycle is (docs/your_own_robot.md).

    With τ = kt/R (V u - kt q̇) and u = k (q* - q): stiffness k τ_s, damping kt²/R = τ_s / v_0, where τ_s = V kt/R and
    v_0 = V/kt.

    Args:
        duty_per_rad: k [1/rad].
        stall_torque: τ_s at full duty [N m].
        no_load_speed: v_0 at full duty [rad/s].
        joints: Number of joints.
    """
    values = {
        "stiffness": duty_per_rad * stall_torque,
        "damping": stall_torque / no_load_speed,
        "saturation_effort": stall_torque,
        "effort_limit": 2 * stall_torque,  # reached when it brakes from no-load speed
        "velocity_limit": no_load_speed,
    }
    return Drive(**{key: np.full(joints, value) for key, value in values.items()})


def firmware_gain(recording: Recording) -> int:
    """The firmware's kp, which BAM's files have in their names: kp400_sin_sin is 400.

    Raises:
        ValueError: If there is none.
    """
    digits = recording.name.partition("_")[0].removeprefix("kp")
    if not digits.isdigit():
        raise ValueError(
            f"{recording.label}: the name says no firmware gain, expected one like kp400_sin_sin. Rename the file."
        )
    return int(digits)


def _xl330(recording: Recording) -> Recording:
    """Dynamixel XL330-M288: duty = kp * counts / (256 * 885); kt and R are a published fit of another unit."""
    volts, kt, ohms = 7.4, 0.387, 4.02
    duty_per_rad = firmware_gain(recording) * COUNTS_PER_RAD / (256 * 885)
    drive = servo_drive(duty_per_rad, volts * kt / ohms, volts / kt)
    # its speeds are filtered by the firmware
    return replace(recording, dof_vel=None, drive=drive, load=Load(load_mass=0.49, load_length=0.10, arm_mass=0.0))


def _sts3250(recording: Recording) -> Recording:
    """Feetech STS3250: 0.164 duty per rad and unit of kp; 8.78 N m is a public fit, 60° in 0.133 s the data sheet's."""
    drive = servo_drive(0.164 * firmware_gain(recording), 8.78, math.radians(60) / 0.133)
    return replace(recording, dof_vel=None, drive=drive, load=Load(load_mass=1.13, load_length=0.12, arm_mass=0.0))


def _go2(recording: Recording) -> Recording:
    """Unitree Go2: the file names no joints, and its gains are those of Pace-Go2-v0."""
    gains = {"stiffness": np.full(12, 20.0), "damping": np.full(12, 1.5)}
    return replace(recording, joint_names=GO2_JOINTS, drive=Drive(**gains))


SO101_NAMES = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
"""The recordings' names of SO101_JOINTS, in that order. Signs and zeros are the model's: README of the benchmark."""

JAW_COUNTS = 1523.2
"""Encoder counts from jaw 0 to jaw 1, read off the lattice of the values (steps of 6.565e-4)."""

JAW_CLOSED = -0.174533
"""What jaw 0 is taken for [rad]: the model's lower limit. Gravity on the jaw is 3 mN m, so little depends on it."""

SO101_STIFFNESS = 11.6
"""[N m/rad]. From the recordings: mean of what ``real_recordings.py sag`` prints for the model's signs."""


def _so101(recording: Recording) -> Recording:
    """SO-101: joints by the model's names, the jaw in rad, the stiffness that carries the model's weight."""
    if recording.joint_names != SO101_NAMES:
        raise ValueError(
            f"{recording.label}: found the joints {', '.join(recording.joint_names)}; expected "
            f"{', '.join(SO101_NAMES)}. This converter knows no others."
        )
    position, target = recording.dof_pos.copy(), recording.des_dof_pos.copy()
    for series in (position, target):
        series[:, 5] = JAW_CLOSED + series[:, 5] * JAW_COUNTS / COUNTS_PER_RAD
    stall = SO101_STIFFNESS / (0.164 * 16)  # a supply below 12 V; torque and speed follow it alike
    drive = servo_drive(0.164 * 16, stall, stall / (5.51 / 4.71), joints=6)
    # the firmware's D works against the back-EMF, in a unit that is not published: viscous friction stands for both
    drive = replace(drive, damping=np.zeros(6))
    return replace(recording, joint_names=SO101_JOINTS, dof_pos=position, des_dof_pos=target, dof_vel=None, drive=drive)


ROBOTS = {
    robot.name: robot
    for robot in (
        RealRobot(
            name="xl330",
            task="Pace-TestBench-v0",
            suffix=".csv",
            licence="Rhoban, BAM, Apache-2.0",
            convert=_xl330,
            train=(
                *(f"kp{kp}_sin_sin" for kp in (100, 200, 800)),
                *(f"kp{kp}_lift_and_drop" for kp in (200, 800)),
                *(f"kp{kp}_up_and_down" for kp in (100, 800)),
            ),
            optimizer="hybrid",
            validation=("kp400_sin_sin", "kp400_lift_and_drop", "kp400_up_and_down"),
        ),
        RealRobot(
            name="sts3250",
            task="Pace-TestBench-v0",
            suffix=".csv",
            licence="Rhoban, BAM, Apache-2.0",
            convert=_sts3250,
            train=("kp32_lift_and_drop", "kp32_sin_time_square", "kp32_up_and_down"),
            validation=("kp32_sin_sin",),
        ),
        RealRobot(
            name="so101",
            task="Pace-SO101-v0",
            suffix=".npz",
            licence="NVIDIA, SAGE, Apache-2.0",
            convert=_so101,
            train=("chirp_sweep", "friction_gravity", "single_joint_elbow", "step_response"),
            validation=("multisine", "velocity_ramp"),
            windows={
                "chirp_sweep": (80.0, 100.0),  # 1 to 2 Hz
                "friction_gravity": (0.0, 25.0),
                "single_joint_elbow": (45.2, 50.0),  # before, the hand pushes against the table
                "step_response": (10.0, 26.0),
                "multisine": (0.0, 20.0),
                "velocity_ramp": (0.0, 30.0),
            },
        ),
        RealRobot(
            name="go2",
            task="Pace-Go2-v0",
            suffix=".pt",
            licence="DLS Lab, Istituto Italiano di Tecnologia, BSD-3-Clause",
            convert=_go2,
            train=("traj_0",),
        ),
    )
}


def source_folder(robot: RealRobot, source: Path) -> Path:
    """Where a robot's recordings lie.

    Raises:
        ValueError: If they are absent.
    """
    folder = source / robot.name
    if not any(folder.glob(f"*{robot.suffix}")):
        raise ValueError(
            f"{folder} holds no {robot.suffix} files: the real recordings are not part of this project. Name the "
            f"folder that holds {', '.join(ROBOTS)} with --source."
        )
    return folder


def convert_robot(robot: RealRobot, source: Path, output: Path, whole: bool = False) -> list[Path]:
    """Write all of a robot's recordings in our format, their licence beside them.

    Args:
        robot: Which one.
        source: Folder that holds a folder per robot.
        output: Folder that gets a folder per robot.
        whole: Whether to keep all of each file rather than ``robot.windows``.

    Returns:
        The files.

    Raises:
        ValueError: If the recordings are absent or not as expected.
    """
    folder = source_folder(robot, source)
    suffix = ".csv" if robot.suffix == ".csv" else ".npz"
    written = []
    for path in sorted(folder.glob(f"*{robot.suffix}")):
        recording = robot.convert(replace(load_recording(path), name=path.stem))
        if not whole and path.stem in robot.windows:
            recording = cut(recording, *robot.windows[path.stem])
        written.append(save_recording(output / robot.name / f"{path.stem}{suffix}", recording))
    if (licence := folder / "LICENSE").is_file():
        shutil.copy(licence, output / robot.name / "LICENSE")
    return written


def cut(recording: Recording, start: float, end: float) -> Recording:
    """The samples from ``start`` to ``end`` [s]; time begins at 0 again.

    Raises:
        ValueError: If there are fewer than two.
    """
    time = recording.time - recording.time[0]
    inside = (time >= start) & (time <= end)
    if inside.sum() < 2:
        raise ValueError(
            f"{recording.label}: has no samples from {start:g} to {end:g} s; it lasts {time[-1]:g} s. "
            "Choose another part."
        )
    series = {
        key: None if (values := getattr(recording, key)) is None else values[inside]
        for key in ("dof_pos", "des_dof_pos", "dof_vel", "dof_effort", "torque_enable")
    }
    return replace(recording, time=time[inside] - time[inside][0], **series)
