"""Facts of the drives that a user declares unknown: which effects find them, and within which bounds."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pace_actuators.effects import EffectCfg, effect_cfgs
from pace_actuators.text import listed
from pace_envs.tasks.pace import GLOBAL, PaceSim2realEnvCfg
from pace_optim.problem.drive_facts import asked_torque, configured_drive, in_force
from pace_optim.recording import Recording
from pace_optim.terminal.choices import UNKNOWN_FACTS

LIMITS = {
    "effort_limit": "torque_limit.effort",
    "saturation_effort": "torque_speed_limit.effort",
    "velocity_limit": "torque_speed_limit.velocity",
}
"""Limit -> the parameter that is it."""
GAINS = {"stiffness": "proportional_gain.gain", "damping": "derivative_gain.gain"}
"""Gain -> the parameter that is a factor of it."""
_OF_THE_REACHED = 0.7
"""Part of the torque that is asked where a search for a limit of it starts."""
_FACTOR = 10.0
"""How far from what is stated a limit is sought, both ways."""


def check_unknown(facts: Iterable[str]) -> None:
    """Refuse what cannot be unknown."""
    if wrong := [fact for fact in facts if fact not in UNKNOWN_FACTS]:
        raise ValueError(f"--unknown {wrong[0]} is not understood. Available: {', '.join(UNKNOWN_FACTS)}.")


def with_unknown(effects: Sequence[EffectCfg | str], facts: Iterable[str]) -> list[EffectCfg | str]:
    """The effects with those that find unknown facts, if they are not among them."""
    named = {cfg.effect_class.name for cfg in effect_cfgs(effects)}
    wanted = dict.fromkeys(UNKNOWN_FACTS[fact] for fact in facts)
    return [*effects, *(name for name in wanted if name not in named)]


def started_from(
    values: Mapping[str, Mapping[str, float]], before: Mapping[str, Mapping[str, float]], facts: Iterable[str]
) -> dict[str, dict[str, float]]:
    """Parameters to start a fit from that also seeks unknown facts: where they lack those, as they were before.

    A factor of a gain that was found since is one of the gain that was found before.
    """
    facts = list(facts)
    effects = {UNKNOWN_FACTS[fact] for fact in facts}
    own = {name: dict(entries) for name, entries in before.items() if name.split(".")[0] in effects}
    result = own | {name: dict(entries) for name, entries in values.items()}
    for label in {GAINS[fact] for fact in facts if fact in GAINS} & set(values):
        first = before.get(label, {})
        result[label] = {key: value * first.get(key, 1.0) for key, value in values[label].items()}
    return result


def lift_limits(
    cfg: PaceSim2realEnvCfg, recordings: Sequence[Recording], facts: Iterable[str]
) -> tuple[list[Recording], dict[str, dict[str, tuple[float, float, float]]]]:
    """Let no stated limit act that is unknown: recordings without it, and where to seek what takes its place.

    A search starts where the limit is reached: beyond, it would not be felt.

    Args:
        cfg: The environment; its drives lose these limits.
        facts: What is unknown; gains among it are left alone.
    """
    facts = [fact for fact in facts if fact in LIMITS]
    line = any(LIMITS[fact].startswith("torque_speed_limit") for fact in facts)
    joints = list(cfg.sim2real.joint_order)
    bounds: dict[str, dict[str, tuple[float, float, float]]] = {}
    if not facts:
        return list(recordings), bounds
    asked, speed = _reached(cfg, recordings, joints)
    for fact, label in LIMITS.items():
        if fact not in facts and not (line and label.startswith("torque_speed_limit")):
            continue
        stated = _stated(cfg, recordings, fact, joints)
        sought = _FACTOR if fact in facts else 1.0
        reached = (speed if fact == "velocity_limit" else asked).tolist()
        bounds[label] = {
            joint: (v / sought, min(max(at, v / sought), v * sought), v * sought)
            for joint, v, at in zip(joints, stated.tolist(), reached, strict=True)
            if math.isfinite(v)
        }
        for drive in cfg.scene.robot.actuators.values():
            setattr(drive, fact, None)
        infinite = np.full(len(joints), np.inf)
        recordings = [replace(r, drive=replace(r.drive, **{fact: infinite})) for r in recordings]
    return list(recordings), bounds


def refined_limits(
    recordings: Sequence[Recording], joints: Collection[str], effects: Sequence[EffectCfg | str]
) -> tuple[list[Recording], dict[str, dict[str, tuple[float, float, float]]], list[EffectCfg | str]]:
    """Let some joints' torque limits be sought from those on that recordings state.

    Args:
        recordings: The recordings; all have these limits, as their torques say them.
        effects: What is fitted; nothing changes where a limit is among it.

    Returns:
        Recordings without these limits, where they are sought, and the effects with what takes their place.
    """
    own = UNKNOWN_FACTS["effort_limit"]
    stated = [np.asarray(each) for r in recordings if (each := r.drive.effort_limit) is not None]
    if not joints or own in {cfg.effect_class.name for cfg in effect_cfgs(effects)}:
        return list(recordings), {}, list(effects)
    names = recordings[0].joint_names
    start = dict(zip(names, np.max(stated, axis=0).tolist(), strict=True))
    bounds = {joint: (start[joint] / _FACTOR, start[joint], start[joint] * _FACTOR) for joint in joints}
    free = [np.where(np.isin(names, list(joints)), np.inf, each) for each in stated]
    told = [replace(r, drive=replace(r.drive, effort_limit=v)) for r, v in zip(recordings, free, strict=True)]
    expression = "|".join(re.escape(joint) for joint in names if joint in joints)
    return told, {LIMITS["effort_limit"]: bounds}, [*effects, f"{own}@{expression}"]


def with_identified(
    cfg: PaceSim2realEnvCfg,
    recordings: Sequence[Recording],
    facts: Iterable[str],
    parameters: Mapping[str, Mapping[str, float]],
    undetermined: Iterable[str],
) -> list[Recording]:
    """Recordings that state what a fit found of facts that were unknown, where they determine it.

    Args:
        cfg: The environment, whose facts hold where a recording states none.
        undetermined: Labels of what the recordings leave open.
    """
    facts, left_open, joints = list(facts), set(undetermined), list(cfg.sim2real.joint_order)
    found: dict[str, dict[str, float]] = identified_limits(facts, parameters, left_open)
    factors = {fact: parameters.get(label, {}) for fact, label in GAINS.items() if fact in facts}
    for fact, by_joint in factors.items():
        label = GAINS[fact]
        found[fact] = {j: v for j, v in by_joint.items() if f"{label}/{j}" not in left_open}

    def stated(recording: Recording) -> Recording:
        changes = {}
        for fact, values in found.items():
            now = _stated(cfg, [recording], fact, joints)
            for j, joint in enumerate(joints):
                value = values.get(joint, values.get(GLOBAL))
                if value is not None:
                    now[j] = value * now[j] if fact in GAINS else value
            changes[fact] = now
        return replace(recording, drive=replace(recording.drive, **changes))

    return [stated(recording) for recording in recordings]


def identified_gains(
    cfg: PaceSim2realEnvCfg,
    recordings: Sequence[Recording],
    facts: Iterable[str],
    parameters: Mapping[str, Mapping[str, float]],
    undetermined: Iterable[str],
    unit_of: Callable[[str, str], str],
) -> list[str]:
    """The gains themselves, of which a fit finds factors, in a sentence each; none where recordings state several.

    Args:
        cfg: The environment, whose gains hold where a recording states none.
        undetermined: Labels of what the recordings leave open.
        unit_of: Unit of a parameter of a joint.
    """
    joints, result = list(cfg.sim2real.joint_order), []
    known = with_identified(cfg, recordings, [fact for fact in facts if fact in GAINS], parameters, undetermined)
    for fact in [fact for fact in GAINS if fact in facts]:
        found = [getattr(recording.drive, fact) for recording in known]
        label, left_open = GAINS[fact], set(undetermined)
        told = [j for j in joints if label in parameters and f"{label}/{j}" not in left_open]
        if told and all(np.array_equal(each, found[0]) for each in found):
            per = {"stiffness": "/{bias}", "damping": " s/{bias}"}[fact]
            units = {j: unit_of("friction", j) + per.format(bias=unit_of("encoder_bias", j)) for j in told}
            values = [f"{found[0][joints.index(j)]:.4g} {units[j]} ({j})" for j in told]
            result.append(f"{fact} found: {listed(values, 12)}")
    return result


def identified_limits(
    facts: Iterable[str], parameters: Mapping[str, Mapping[str, float]], undetermined: Iterable[str]
) -> dict[str, dict[str, float]]:
    """Limits that were unknown, as a drive has them now: by fact and joint, where the recordings determine them."""
    facts, left_open = list(facts), set(undetermined)
    line = any(fact in facts for fact in ("saturation_effort", "velocity_limit"))
    found = {}
    for fact, label in LIMITS.items():
        if fact in facts or (line and label.startswith("torque_speed_limit")):
            values = {j: v for j, v in parameters.get(label, {}).items() if f"{label}/{j}" not in left_open}
            found[fact] = values
    return found


def _reached(
    cfg: PaceSim2realEnvCfg, recordings: Sequence[Recording], joints: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """A torque that the drives were asked for [N m], not the largest, and beyond their largest speed [rad/s], (n,)."""
    torques, speeds, configured = [], [], configured_drive(cfg, joints)
    for recording in recordings:
        speed = np.gradient(recording.dof_pos, recording.time, axis=0)
        asked = asked_torque(in_force(configured, recording), recording, speed, clip=False)
        torques.append(np.quantile(np.abs(asked), 0.98, axis=0))
        speeds.append(np.quantile(np.abs(speed), 0.99, axis=0))
    return _OF_THE_REACHED * np.max(torques, axis=0), np.max(speeds, axis=0) / _OF_THE_REACHED


def _stated(cfg: PaceSim2realEnvCfg, recordings: Sequence[Recording], fact: str, joints: Sequence[str]) -> np.ndarray:
    """A limit as recordings state it, else the configuration, (n,); infinite where neither does."""
    values = [v for recording in recordings if (v := getattr(recording.drive, fact)) is not None]
    configured = configured_drive(cfg, joints)[fact]
    return np.max(values, axis=0) if values else np.where(np.isnan(configured), np.inf, configured)
