"""Putting identified drives into an environment's robot."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from pace_actuators import IdentifiedDrives, PaceDCMotorCfg, match_names, resolve_joint_values
from pace_actuators.drive_result import ALL, CURE
from pace_actuators.effects import effect_cfgs
from pace_actuators.identified import DRIVE_FIELDS
from pace_actuators.representable import HERE, check_representable
from pace_actuators.text import listed, plural, spoken
from pace_envs import mdp
from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.manager_based_env import ManagerBasedEnvCfg
from pace_envs.managers import EventTermCfg
from pace_envs.motor_coordinates import SINGLE
from pace_envs.registration import set_physics_dt
from pace_envs.robot_spec import load_robot_spec
from pace_envs.task_source import EnvironmentRecord

GAINS = ("stiffness", "damping")
"""Fields of a drive that a model file may leave open."""
_FAR_ABOVE_NOISE = 10.0
"""An error of this many times the noise is no residual of noise."""
_SAME = 0.01
"""Relative difference of gains and limits that does not count."""
_MOST = 4
"""Labels that a sentence names, at most."""


def use_identified(
    cfg: ManagerBasedEnvCfg,
    identified: IdentifiedDrives | str | Path,
    *,
    randomize_std: float | None = None,
    gains: bool = False,
    on_the_rig: bool = False,
    own_step: bool = False,
) -> list[str]:
    """Give the robot of an environment the drives that a fit identified.

    Armature, frictions, encoder bias, delay, delay mode, effects and the inertial parameters of links become the
    identified ones. Gains and limits stay the environment's: they are the policy's controller. Gains that a model file
    did not state and that were assumed become the recordings'. Where the identification took steps of second order, so
    does the environment on the processor, and at its control step as fine ones; on a GPU drives take half a step back
    (``PaceDCMotorCfg.second_order``).

    Args:
        cfg: The environment; it is changed.
        identified: ``result.json``, the run's folder, or what has been read of it.
        randomize_std: Draw every environment's drives with this many standard deviations around the identified values;
            ``None`` does not.
        gains: Also take over the gains and limits of the recordings, as far as the result says them.
        on_the_rig: Whether the robot is held as in the recording: with the effects of what held it.
        own_step: Keep the environment's physics step.

    Returns:
        What the environment cannot represent, in words.

    Raises:
        ValueError: If the result is unusable, or its joints are not the robot's.
    """
    drives = IdentifiedDrives.of(identified)
    notes = check_representable(drives, HERE)
    if taken := {joint for own in _recorded_gains(cfg.scene.robot, drives).values() for joint in own}:
        notes.append(f"gains of {plural(len(taken), 'joint')}: the recordings', as the model file states none")
    cfg.scene.robot.actuators = groups = _identified_groups(cfg.scene.robot, drives, gains, on_the_rig)
    cfg.scene.robot.links = {**cfg.scene.robot.links, **drives.links}
    if cfg.sim.device == "cpu" and any(drive.second_order for drive in groups.values()):
        cfg.sim.integrator = "leapfrog"
        at = _loop_dt(drives)
        if abs(cfg.sim.dt - at) < 1e-9 and drives.at.physics_dt < at * (1 - 1e-6) and not own_step:
            set_physics_dt(cfg, drives.at.physics_dt)
    if randomize_std is not None:
        cfg.events = {
            **cfg.events,
            "identified_drives": EventTermCfg(
                func=mdp.randomize_identified_drives,
                mode="startup",
                params={"drives": drives, "scale": randomize_std},
            ),
        }
    return notes


def doubts(cfg: ManagerBasedEnvCfg, identified: IdentifiedDrives | str | Path) -> list[str]:
    """Why an environment may not want the drives that a fit identified, in sentences; none if all is well.

    Args:
        cfg: The environment, with its own gains and limits.
        identified: As for :func:`use_identified`.
    """
    drives = IdentifiedDrives.of(identified)
    found = doubts_of_fit(drives)
    if drives.undetermined:
        found.append(
            f"{listed(map(_named, sorted(drives.undetermined)), _MOST)} was not determined by the recordings and keeps "
            "its prior. Record a motion that shows it. [W24]"
        )
    return found + _other_drives(cfg.scene.robot, drives)


def doubts_of_fit(drives: IdentifiedDrives) -> list[str]:
    """Why the values of a fit may not be the robot's, in sentences; none if all is well."""
    found, far = [], drives.times_noise is not None and drives.times_noise >= _FAR_ABOVE_NOISE
    if far:
        found.append(
            f"the fit ended at {drives.times_noise:,.0f} times the measurement noise, so its values compensate for "
            "missing physics. Find it with pace diagnose before you use them. [W22]"
        )
    if drives.at_bound:
        found.append(
            f"{listed(map(_named, drives.at_bound), _MOST)} ended at a bound of the fit, so the value is the bound's. "
            f"{'Find the missing physics' if far else 'Widen bounds and fit again'}. [W23]"
        )
    return found


def _named(label: str) -> str:
    """``payload.mass/wrist`` as "payload mass of wrist"."""
    name, _, key = label.partition("/")
    return spoken(name) if key == ALL else f"{spoken(name)} of {key}"


def load_identified_cfg(drives: IdentifiedDrives) -> Any:
    """The configuration of the environment in which drives were identified, from the record in their result."""
    return EnvironmentRecord.read(drives.environment, drives.task, drives.path, CURE).load_cfg(str(drives.path))


def set_step(cfg: ManagerBasedEnvCfg, dt: float) -> None:
    """Let physics and drives of an environment run at another time step; the policy keeps its rate.

    Args:
        cfg: The environment; it is changed.
        dt: Time step [s].
    """
    step_dt = cfg.sim.dt * cfg.decimation
    decimation = round(step_dt / dt) if dt > 0 else 0
    if decimation < 1 or abs(decimation * dt - step_dt) > 1e-9:
        raise ValueError(
            f"The time step is {dt:g} s, expected a whole fraction of the environment's step of {step_dt:g} s, such as "
            f"{step_dt / 8:g}."
        )
    cfg.sim.dt, cfg.decimation = dt, decimation


def set_identified_step(cfg: ManagerBasedEnvCfg, identified: IdentifiedDrives | str | Path) -> str | None:
    """Let physics and drives run at the control step of an identification: its values hold the errors of that step.

    Args:
        cfg: The environment; it is changed, unless its step is as fine already, or no multiple of that step.
        identified: ``result.json``, the run's folder, or what has been read of it.

    Returns:
        What was changed, in words.
    """
    drives, before = IdentifiedDrives.of(identified), cfg.sim.dt
    dt = _loop_dt(drives)
    whole = cfg.sim.dt * cfg.decimation / dt
    if dt >= before * (1 - 1e-6) or abs(whole - round(whole)) > 1e-6:
        return None
    set_step(cfg, dt)
    return step_note(cfg, drives, before)


def step_note(cfg: ManagerBasedEnvCfg, drives: IdentifiedDrives, before: float) -> str:
    """At which steps drives and physics run, and what makes a fine step longer; empty if nothing was changed.

    Args:
        cfg: The environment with identified drives.
        drives: These.
        before: The task's own step [s].
    """
    step, control = cfg.sim.dt, drives.at.control_dt
    if step >= before * (1 - 1e-6):
        return ""
    loop = max(step, _loop_dt(drives))
    note = f"drives {1e3 * loop:g} ms, physics {1e3 * step:g} ms, as in the fit (task: {1e3 * before:g} ms)"
    if step >= control * (1 - 1e-6):
        return note
    cure = f"fit again with --physics_dt {control:g} --drive_dt {control:g}"
    return f"{note}. Fine steps are slow: to train faster, {cure} (docs/training.md)"


def _loop_dt(drives: IdentifiedDrives) -> float:
    """Period of the fastest drive's loop in the identification [s]."""
    return min([drives.at.control_dt, *drives.drive.get("drive_dt", {}).values()])


def _other_drives(robot: ArticulationCfg, drives: IdentifiedDrives) -> list[str]:
    """Gains and limits of the environment that are not those of the recordings."""
    found, robot = [], _with_recorded_gains(robot, drives)
    for name in DRIVE_FIELDS:
        differs: dict[tuple[float, float], list[str]] = {}
        for _, drive, own in _groups(robot):
            if (configured := getattr(drive, name)) is None:
                continue
            values = resolve_joint_values(configured, own, field=name).tolist()
            for joint, value in zip(own, values, strict=True):
                recorded = drives.drive.get(name, {}).get(joint)
                if recorded is not None and abs(value - recorded) > _SAME * max(abs(value), abs(recorded)):
                    differs.setdefault((float(recorded), value), []).append(joint)
        if differs:
            pairs = [
                f"{value:g} and {recorded:g} ({listed(each, _MOST)})" for (recorded, value), each in differs.items()
            ]
            found.append(
                f"{name} differs between this task and the recordings: {'; '.join(pairs)}. Set the task's to the "
                "robot's, or to the recordings' if you do not know. [W25]"
            )
    return found


def _identified_groups(
    robot: ArticulationCfg, drives: IdentifiedDrives, gains: bool, on_the_rig: bool
) -> dict[str, PaceDCMotorCfg]:
    result, used = {}, set()
    for group, drive, own in _groups(_with_recorded_gains(robot, drives)):
        identified = [joint for joint in drives.joint_names if joint in own]
        if not identified:
            result[group] = drive
            continue
        if missing := [joint for joint in own if joint not in identified]:
            raise ValueError(
                f"{drives.path} has no values for {', '.join(missing)} of the actuator group {group!r}. Put joints "
                "that were not identified into a separate group."
            )
        used |= set(identified)
        result[group] = _merged(drive, drives, identified, gains, on_the_rig)
    if left := [joint for joint in drives.joint_names if joint not in used]:
        raise ValueError(
            f"{drives.path} is of another robot: it has {', '.join(left)}, and the robot has "
            f"{', '.join(joint for _, _, own in _groups(robot) for joint in own)}. "
            "Use the result of a fit of this robot."
        )
    return result


def assumed_gains(robot: ArticulationCfg) -> dict[str, list[str]]:
    """Joints whose stiffness or damping no file states and no task has changed, by field."""
    found: dict[str, list[str]] = {name: [] for name in GAINS}
    for _, drive, joints in _groups(robot):
        for i, name in enumerate(GAINS):
            values = resolve_joint_values(getattr(drive, name), joints, field=name).tolist()
            found[name] += [
                joint
                for joint, value in zip(joints, values, strict=True)
                if joint in robot.assumed_gains and math.isclose(value, robot.assumed_gains[joint][i])
            ]
    return found


def _recorded_gains(robot: ArticulationCfg, drives: IdentifiedDrives) -> dict[str, dict[str, float]]:
    """The recordings' gains of joints whose gains are assumed, by field and joint."""
    return {
        name: {joint: float(drives.drive[name][joint]) for joint in joints if joint in drives.drive.get(name, {})}
        for name, joints in assumed_gains(robot).items()
    }


def _with_recorded_gains(robot: ArticulationCfg, drives: IdentifiedDrives) -> ArticulationCfg:
    """The robot with these."""
    gains, groups = _recorded_gains(robot, drives), {}
    for group, drive, joints in _groups(robot):
        changed: dict[str, Any] = {}
        for name, values in gains.items():
            own = resolve_joint_values(getattr(drive, name), joints, field=name).tolist()
            changed[name] = {re.escape(j): values.get(j, value) for j, value in zip(joints, own, strict=True)}
        groups[group] = replace(drive, **changed) if any(gains.values()) else drive
    return replace(robot, actuators=groups)


def _groups(robot: ArticulationCfg) -> Iterator[tuple[str, PaceDCMotorCfg, list[str]]]:
    """Each group of drives with its name and its joints, in its order."""
    names = robot.joint_order or [j.name for j in load_robot_spec(robot).joints if j.type in SINGLE]
    for group, drive in robot.actuators.items():
        yield group, drive, [names[i] for found in match_names(drive.joint_names_expr, names) for i in found]


def _merged(
    drive: PaceDCMotorCfg, drives: IdentifiedDrives, joints: list[str], gains: bool, on_the_rig: bool
) -> PaceDCMotorCfg:
    fields: dict[str, Any] = drives.cfg_fields([re.escape(joint) for joint in joints], on_the_rig=on_the_rig)
    del fields["joint_names_expr"]
    if not gains:
        fields = {name: value for name, value in fields.items() if name not in DRIVE_FIELDS}
    found = {effect.effect_class.name for effect in fields["effects"]}
    kept = [effect for effect in effect_cfgs(drive.effects) if effect.effect_class.name not in found]
    return replace(drive, **fields | {"delay": 0.0, "effects": (*kept, *fields["effects"])})
