"""A robot's MJCF with what its drives' identification says of its joints."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import torch

from pace_actuators import IdentifiedDrives
from pace_actuators.effects.fading_friction import SoftFriction
from pace_envs import ManagerBasedRLEnv, load_env_cfg
from pace_envs.identified import use_identified

_BODY_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat")


def mjcf(drives: IdentifiedDrives) -> tuple[str, list[str]]:
    """The robot's model with identified armature, damping and frictionloss, and changed rigid bodies.

    Raises:
        ValueError: If the environment of the identification is not registered, or its model cannot be read.
    """
    cfg = load_env_cfg(drives.task)
    source = Path(cfg.scene.robot.mjcf_path)
    cfg.scene.num_envs = 1
    cfg.sim.dt, cfg.decimation = drives.at.control_dt, 1
    plain = ManagerBasedRLEnv(cfg)
    use_identified(cfg, drives.path)
    env = ManagerBasedRLEnv(cfg)
    robot, model = env.scene["robot"], env.sim.model
    spec = mujoco.MjSpec.from_file(str(source))
    for name, column in zip(robot.joint_names, robot.dof_columns.tolist(), strict=True):
        joint = spec.joint(name)  # the base parameters: an elastic joint's inertia sits in the drive while it runs
        joint.armature = drives.values("armature", [name])[name]
        joint.frictionloss = drives.values("friction", [name])[name]
        _set_damping(joint, drives.values("viscous_friction", [name])[name])
        joint.solref_friction, joint.solimp_friction = model.dof_solref[column], model.dof_solimp[column]
    for name, time_constant in _soft_frictions(drives, robot.joint_names).items():
        joint = spec.joint(name)
        joint.solref_friction = [time_constant, 1.0]
        joint.solimp_friction = [SoftFriction.impedance, SoftFriction.widest, 0.001, 0.5, 2.0]
    if spec.meshes:
        spec.meshdir = str((source.parent / spec.meshdir).resolve())
    changed = _write_bodies(spec, plain, env)
    notes = _notes(drives, changed)
    env.close()
    plain.close()
    return _with_comment(spec.to_xml(), notes, drives), notes


def _soft_frictions(drives: IdentifiedDrives, joint_names: Sequence[str]) -> dict[str, float]:
    """Time constants [s] of the joints whose friction is that of MuJoCo's own constraint."""
    own = [cfg.joints(joint_names) for cfg in drives.effects if cfg.effect_class is SoftFriction]
    values = drives.values("soft_friction.time_constant", own[0]) if own else {}
    return {name: value for name, value in values.items() if value > 0}


def _set_damping(joint: mujoco.MjsJoint, damping: float) -> None:
    """Linear damping: since MuJoCo 3.5 a joint has a polynomial."""
    if np.ndim(joint.damping):
        joint.damping = [damping, *[0.0] * (len(joint.damping) - 1)]
    else:
        joint.damping = damping


def _write_bodies(spec: mujoco.MjSpec, plain: ManagerBasedRLEnv, env: ManagerBasedRLEnv) -> list[str]:
    """Write the rigid bodies that effects have changed; returns their names."""
    model, changed = env.sim.model, []
    for b in range(1, model.nbody):
        before = {field: plain.sim.expand(field)[0, b] for field in _BODY_FIELDS}
        after = {field: env.sim.expand(field)[0, b] for field in _BODY_FIELDS}
        if all(torch.allclose(before[f], after[f], rtol=1e-12, atol=1e-15) for f in _BODY_FIELDS):
            continue
        body = spec.body(model.body(b).name)
        changed.append(body.name)
        body.explicitinertial = True
        body.mass = float(after["body_mass"])
        body.inertia, body.fullinertia = after["body_inertia"].numpy(), np.full(6, np.nan)
        body.ipos, body.iquat = after["body_ipos"].numpy(), after["body_iquat"].numpy()
        for field, attribute in (("body_pos", "pos"), ("body_quat", "quat")):
            if not torch.equal(before[field], after[field]):
                setattr(body, attribute, after[field].numpy())
    return changed


def _notes(drives: IdentifiedDrives, changed: list[str]) -> list[str]:
    bias = [abs(value) for value in drives.parameters["encoder_bias"].values()]
    delayed = "targets" if drives.delay_mode == "command" else "the controller's torque"
    notes = [
        f"encoder bias (up to {max(bias):.3g} rad): the encoder shows q - bias; it is not in the model.",
        f"delay of {1e3 * drives.delay_s:.3g} ms of {delayed}: it is not in the model.",
        "gains and torque-speed limits of the drives: there are no actuators in the model but those it had.",
    ]
    if changed:
        notes.append(f"changed rigid bodies, which are in the model: {', '.join(changed)}.")
    for effect in drives.effects:
        kind = effect.effect_class
        if kind is SoftFriction:
            notes.append(f"{kind.name} is in the model: solreffriction and solimpfriction of its joints.")
        elif not kind.overrides("write_model"):
            what = kind.equation or (kind.__doc__ or "").strip().splitlines()[0]
            notes.append(f"{kind.name} ({what}): it is not in the model.")
    return notes


def _with_comment(xml: str, notes: list[str], drives: IdentifiedDrives) -> str:
    lines = [f"Joints identified with {drives.task}: armature, damping, frictionloss. What this file cannot hold:"]
    lines += [f"- {note}" for note in notes]
    body = "\n".join(textwrap.fill(line, 118, subsequent_indent="  ") for line in lines)
    body = body.replace("--", "- -")
    head, found, rest = xml.partition("<mujoco")
    return f"{head}<!--\n{body}\n-->\n{found}{rest}"
