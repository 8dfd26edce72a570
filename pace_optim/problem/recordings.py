"""The recordings that a command line names, on a robot's joints and control grid."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np

from pace_actuators import match_names
from pace_actuators.joint_units import radians, units_for
from pace_actuators.text import listed
from pace_envs.model_file import is_model_file, read_model_file
from pace_envs.motor_coordinates import joint_ranges
from pace_optim.problem.drive_facts import of_joints
from pace_optim.recording import Recording, conform_recording
from pace_optim.recording.commands import command_interval
from pace_optim.recording.conform import of_motors, with_columns
from pace_optim.recording.files import stated_couplings, unused_facts
from pace_optim.recording.gaps import split_at_gaps
from pace_optim.recording.logs import LogReader, Robot, column_names, paired_files, read_map, set_aside, with_rate

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv

_T = TypeVar("_T", str, Recording)
_STILL = 0.02
"""A joint that moves less is held where it is [rad]; a slide, if it moves less than a tenth of it [m]."""


def tell_on_stderr(text: str) -> None:
    """Print something beside a command's results."""
    print(text, file=sys.stderr)


def tell_nobody(text: str) -> None:
    """Print nothing, where recordings are read again."""


@dataclass(frozen=True, kw_only=True)
class Logs:
    """Recordings as their files have them, of some joints of a robot."""

    groups: tuple[tuple[Recording, ...], ...]
    """Recordings of each group of files, with the columns of the joints that are identified alone."""
    joints: tuple[str, ...]
    """Those joints, in the robot's order."""
    held: Mapping[str, float] = field(default_factory=dict)
    """The robot's other joints, and where they are held [rad, of slides m]."""
    note: str = ""
    """What is to be said of them."""

    def state(self, fact: Literal["stiffness", "effort_limit"]) -> bool:
        """Whether each states this fact of all its joints."""
        values = [getattr(each.drive, fact) for group in self.groups for each in group]
        return bool(values) and all(value is not None and bool(np.isfinite(value).all()) for value in values)

    @property
    def command_dt(self) -> float:
        """Shortest time from one command to the next in any of them [s]; infinite where nothing is commanded."""
        every = [each for group in self.groups for each in group if each.is_commanded.any() and each.num_samples > 2]
        return min((each.command_dt or command_interval(each) for each in every), default=math.inf)


def read_logs(
    groups: Sequence[Sequence[str | Path]],
    env: ManagerBasedEnv,
    *,
    joints: str | None = None,
    columns: str | Path | None = None,
    facts: str | Path | None = None,
    rate: float | None = None,
    strict: bool = False,
    tell: Callable[[str], None] = tell_on_stderr,
) -> Logs:
    """Read recordings and logs, and find which of the robot's joints they are of.

    The joints that are not commanded in any recording are held: where the recordings have them, else where the robot
    begins. Two files that are the halves of one log (states, commands) are joined.

    Args:
        groups: Files and folders, each as :class:`pace_optim.recording.logs.LogReader` takes it.
        joints: Regular expression of the joints that are to be identified; ``None``: those of the recordings.
        columns: Column map of the logs among them; ``None``: guessed.
        facts: JSON file of what is true of all of them, where they do not state it.
        rate: Rows per second of logs that have no column of time [Hz].
        strict: Whether one that cannot be used refuses all, instead of being set aside.
        tell: Gets what was understood of logs, and what was set aside.
    """
    chosen = with_rate(None if columns is None else read_map(Path(columns)), rate)
    known = known_robot(env)
    names = known.joint_names
    wanted = () if joints is None else tuple(names[i] for i in sorted(match_names(joints, names)[0]))
    known = replace(known, wanted=wanted)

    driven = env.scene["robot"].driven

    paths = [paired_files([str(path) for path in group]) for group in groups]
    reader = LogReader([path for group in paths for path in group], chosen, facts, strict)

    def read(path: str) -> list[Recording]:
        try:
            found = reader.recordings(path, known)
        except ValueError:
            if not driven.are_coupled or not Path(path).exists():
                raise
            found = reader.recordings(path, known_joints(env))
        return [of_motors(recording, driven) for recording in found]

    warnings: list[str] = []
    try:
        read_groups = [_each(group, read, strict, warnings.append) for group in paths]
    finally:  # a refusal is easier to understand after how the log was read
        left = unused_facts([path for group in paths for path in group], facts)
        for line in (*reader.lines(), *([f"note: {left}"] if left else []), *warnings):
            tell(line)
    every = [recording for group in read_groups for recording in group]
    kept = wanted or _commanded(every, env)
    held, note = _held(every, [name for name in names if name not in kept], env, is_asked=bool(wanted))
    known_names = {*names, *env.cfg.scene.robot.held_joints}
    narrowed = tuple(
        tuple(_of_joints(recording, kept, known_names, is_asked=bool(wanted)) for recording in group)
        for group in read_groups
    )
    return Logs(groups=narrowed, joints=kept, held=held, note=note)


def motors_of_logs(
    task: str, files: Sequence[str | Path], columns: str | Path | None = None
) -> Mapping[str, Mapping[str, float]]:
    """Motors that move several joints: those that files state, or those of a URDF's transmissions that files name.

    Args:
        task: As the command line has it.
        columns: Column map of the logs among them.
    """
    if (stated := stated_couplings(files)) or not is_model_file(task):
        return stated
    urdf = read_model_file(task).urdf
    if urdf is None or not urdf.motors:
        return {}
    chosen = None if columns is None else read_map(Path(columns))
    for file in files:
        names = " ".join(column_names(Path(file), chosen))
        if all(re.search(rf"(?<![^\W_]){re.escape(motor)}(?![^\W_])", names) for motor in urdf.motors):
            return urdf.motors
    return {}


def conform_all(
    recordings: Sequence[Recording],
    env: ManagerBasedEnv,
    control_dt: float,
    *,
    strict: bool = False,
    tell: Callable[[str], None] = tell_on_stderr,
) -> list[Recording]:
    """Put recordings on a robot's joints and control grid, split at their gaps.

    Args:
        recordings: As :func:`read_logs` reads them.
        env: The robot, its other joints held.
        strict: As for :func:`read_logs`.
    """
    robot, known = env.scene["robot"], known_robot(env)
    sim2real, model = env.cfg.sim2real, env.sim.model  # type: ignore[attr-defined]
    undriven = {model.joint(j).name for j in range(model.njnt)}.difference(known.joint_names)

    def conformed(recording: Recording) -> list[Recording]:
        return [
            conform_recording(
                part,
                joint_order=known.joint_names,
                control_dt=control_dt,
                joint_pos_limits=known.limits,
                joint_types=robot.joint_types,
                load_bodies=robot.body_names,
                accepts_load=sim2real.apply_load is not None,
                undriven=undriven,
            )
            for part in split_at_gaps(recording)
        ]

    return _each(recordings, conformed, strict, tell)


def known_robot(env: ManagerBasedEnv) -> Robot:
    """What a log is read for: joints, their limits, and the gains and torque limits that are stated."""
    robot = env.scene["robot"]
    sim2real = getattr(env.cfg, "sim2real", None)
    assumed = np.isin(robot.joint_names, list(getattr(sim2real, "assumed_gains", ())))
    return Robot(
        joint_names=tuple(robot.joint_names),
        limits=robot.data.joint_pos_limits.numpy().copy(),
        joint_types=robot.joint_types,
        stiffness=np.where(assumed, np.nan, of_joints(env, "stiffness")),  # type: ignore[arg-type]
        effort_limit=of_joints(env, "effort_limit"),  # type: ignore[arg-type]
    )


def known_joints(env: ManagerBasedEnv) -> Robot:
    """What a log is read for whose columns are joints that motors move together: nothing is stated of their drives."""
    driven, n = env.scene["robot"].driven, env.scene["robot"].num_joints
    return Robot(
        joint_names=driven.joints,
        limits=joint_ranges(env.sim.model, driven.joints),
        joint_types=env.scene["robot"].joint_types,
        stiffness=np.full(n, np.nan),
        effort_limit=np.full(n, np.inf),
    )


def _each(
    items: Sequence[_T], read: Callable[[_T], list[Recording]], strict: bool, tell: Callable[[str], None]
) -> list[Recording]:
    """What is read of each item; those that cannot be used are set aside with a warning."""
    result: list[Recording] = []
    faults: list[tuple[str, str]] = []
    for item in items:
        try:
            result += read(item)
        except ValueError as error:
            if strict or len(items) == 1 or (isinstance(item, str) and not Path(item).exists()):
                raise
            name = Path(item).name if isinstance(item, str) else item.name
            faults.append((name, " ".join(str(error).split())))
    if faults and not result:
        (_, first), *others = faults
        raise ValueError(first + (f" Neither can {listed(name for name, _ in others)} be used." if others else ""))
    for name, fault in faults:
        tell(set_aside(name, fault))
    return result


def _commanded(recordings: Sequence[Recording], env: ManagerBasedEnv) -> tuple[str, ...]:
    """The robot's joints that recordings command; all where a recording has joints that the robot has not.

    Of such a recording a joint that is missing may be one that is misspelt.
    """
    names = tuple(env.scene["robot"].joint_names)
    known = {*names, *env.cfg.scene.robot.held_joints}
    if not all(recording.joint_names and known.issuperset(recording.joint_names) for recording in recordings):
        return names
    found = {
        name
        for recording in recordings
        for name, commanded in zip(recording.joint_names, recording.is_commanded, strict=True)
        if commanded
    }
    return tuple(name for name in names if name in found)


def _held(
    recordings: Sequence[Recording], names: Sequence[str], env: ManagerBasedEnv, *, is_asked: bool
) -> tuple[dict[str, float], str]:
    """Where joints are held [rad], and what is to be said of it."""
    robot = env.scene["robot"]
    home = dict(zip(robot.joint_names, robot.data.default_joint_pos[0].tolist(), strict=True))
    types = dict(zip(robot.joint_names, robot.joint_types, strict=True))
    still = dict(zip(robot.joint_names, _STILL * np.array(radians(robot.joint_types)), strict=True))
    held, logged = {}, []
    moving: dict[str, list[str]] = {}
    elsewhere = []
    for name in names:
        found = [(r.label, r.dof_pos[:, r.joint_names.index(name)]) for r in recordings if name in r.joint_names]
        held[name] = float(np.median(np.concatenate([each for _, each in found]))) if found else home[name]
        if not found:
            continue
        logged.append(name)
        label, span = max(((label, float(np.ptp(each))) for label, each in found), key=lambda pair: pair[1])
        rests = sorted((float(np.median(each)), label) for label, each in found)
        (low, first), (high, last) = rests[0], rests[-1]
        if span > still[name]:
            moving.setdefault(label, []).append(f"{name} by {units_for(f'{span:.3g} rad', [types[name]])}")
        elif high - low > still[name]:
            held[name] = rests[len(rests) // 2][0]
            here, there = (units_for(f"{place:.3g} rad", [types[name]]) for place in (low, high))
            elsewhere.append(f"{name} rests at {here} in {first}, at {there} in {last}")
    if moving and not is_asked:
        label, those = next(iter(moving.items()))
        raise ValueError(
            f"{label}: joints move without a command: {listed(those, 3)}. Add their commands (des_dof_pos, des_dof_vel "
            "or des_dof_effort). Or name the joints to identify with --joints; the others are then held at their "
            "median."
        )
    if elsewhere and not is_asked:
        raise ValueError(
            f"{listed(elsewhere, 3)}: a joint without commands is held in one place for all recordings. Fit them "
            "apart, or name the joints to identify with --joints."
        )
    if not held:
        before = [f"{name} at {value:.3g}" for name, value in env.cfg.scene.robot.held_joints.items()]
        return held, f"Held as before: {listed(before, 3)}." if before else ""
    places = [f"{name} at {units_for(f'{value:.3g} rad', [types[name]])}" for name, value in held.items()]
    where = (
        "where the recordings have them"
        if len(logged) == len(held)
        else "where the robot begins (its keyframe, or 0)"
        if not logged
        else f"where the recordings have them ({listed(logged, 3)}) or the robot begins"
    )
    note = f"{len(held)} {'joint is' if len(held) == 1 else 'joints are'} held, {where}: {listed(places, 3)}."
    if others := [*(each for those in moving.values() for each in those), *elsewhere]:
        note += f" In the recordings some move ({listed(others, 3)}): what that does to the others is not simulated."
    return held, note


def _of_joints(recording: Recording, kept: Sequence[str], known: set[str], *, is_asked: bool) -> Recording:
    """The recording without columns of joints that are held; as it is where it may be of another robot."""
    names = recording.joint_names
    if tuple(names) == tuple(kept) or not set(kept) <= set(names) or not (is_asked or known >= set(names)):
        return recording
    return with_columns(recording, [names.index(name) for name in kept], tuple(kept))
