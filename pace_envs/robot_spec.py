"""A robot's model as the environment wants it: its base, joints that are held, and its geoms by name."""

from __future__ import annotations

import itertools
import pickle
import re
import warnings
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from pace_actuators import match_names
from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.link_inertia import write_links
from pace_envs.model_file import compile_model, read_model_file
from pace_envs.motor_coordinates import DrivenJoints, add_motors, fixed_tendon, single_joints

_REMEMBERED, _LARGEST = 8, 2**20
"""Robots that are kept, the last ones, and bytes of their files at most: a fit builds the same robot many times."""
_specs: dict[tuple[bytes, bytes], mujoco.MjSpec] = {}


def load_robot_spec(cfg: ArticulationCfg, *, touches: bool = False) -> mujoco.MjSpec:
    """Read a robot's model file; its base is fixed or floating as the configuration says, and joints are held.

    A file that names no others is read once: a copy takes a fiftieth of the time.

    Args:
        touches: Whether it touches anything: meshes that collide stay, and each geom that collides has a name.
    """
    path = Path(cfg.mjcf_path)
    text = path.read_bytes() if path.is_file() and path.stat().st_size < _LARGEST else b""
    base = cfg.fix_base, cfg.init_state.pos, cfg.init_state.rot
    key = text, pickle.dumps((str(path), touches, cfg.couplings, cfg.links, cfg.held_joints, base))
    if key in _specs:
        return _specs[key].copy()
    file = read_model_file(cfg.mjcf_path, touches=touches)
    spec = file.spec
    add_motors(spec, cfg.couplings, cfg.mjcf_path)
    model = compile_model(spec, cfg.mjcf_path)  # an error names the file
    if touches:
        for note in file.notes:
            warnings.warn(f"{cfg.mjcf_path}: {note}", stacklevel=2)
        _name_geoms(spec)
    write_links(spec, model, cfg.links, cfg.mjcf_path)
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if cfg.fix_base:
        for joint in free:
            base = joint.parent
            base.pos, base.quat = cfg.init_state.pos, cfg.init_state.rot
            spec.delete(joint)
    elif cfg.fix_base is False and not free:
        _let_float(spec, cfg)
    if cfg.held_joints:
        hold_joints(spec, model, _of_joints(model, cfg.held_joints))
    if text and not file.notes and not re.search(rb"file\w*\s*=", text):
        while len(_specs) >= _REMEMBERED:
            del _specs[next(iter(_specs))]
        _specs[key] = spec.copy()
    return spec


def _of_joints(model: mujoco.MjModel, positions: Mapping[str, float]) -> dict[str, float]:
    """Where joints are held, with those of motors in place of the motors' own positions."""
    motors = [name for name in positions if fixed_tendon(model, name) is not None]
    if not motors:
        return dict(positions)
    try:
        driven = DrivenJoints.of_model(model, list(positions))
    except ValueError as error:
        raise ValueError(
            f"Motors that move joints together are held together, or none of them (--joints): {error}"
        ) from None
    places = driven.to_joints(np.array(list(positions.values())))
    return dict(zip(driven.joints, places.tolist(), strict=True))


def find_geoms(spec: mujoco.MjSpec, expressions: str | tuple[str, ...]) -> list[mujoco.MjsGeom]:
    """The colliding geoms that expressions name.

    An expression that matches no name of a geom names bodies, and means all of their geoms.

    Args:
        spec: A robot whose colliding geoms have names.
    """
    geoms = _colliding(spec)
    owners = [geom.parent.name for geom in geoms]
    bodies = list(dict.fromkeys(owners))
    found: set[int] = set()
    for group in match_names(expressions, [*(g.name for g in geoms), *bodies], what="colliding geom or body"):
        named = {bodies[i - len(geoms)] for i in group if i >= len(geoms)}
        found |= {i for i in group if i < len(geoms)} or {i for i, owner in enumerate(owners) if owner in named}
    return [geoms[i] for i in sorted(found)]


def _colliding(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    return [geom for geom in spec.geoms if geom.contype or geom.conaffinity]


def _name_geoms(spec: mujoco.MjSpec) -> None:
    """Name the colliding geoms without a name after their bodies: ``body/0``, ``body/1``."""
    taken = {geom.name for geom in spec.geoms}
    for geom in _colliding(spec):
        if not geom.name:
            names = (f"{geom.parent.name}/{k}" for k in itertools.count())
            geom.name = next(name for name in names if name not in taken)
            taken.add(geom.name)


def _let_float(spec: mujoco.MjSpec, cfg: ArticulationCfg) -> None:
    bases = spec.worldbody.bodies
    if len(bases) != 1 or bases[0].joints:
        names = ", ".join(body.name for body in bases) or "none"
        raise ValueError(
            f"{cfg.mjcf_path} has no base that could float: expected one body without a joint in the world, found "
            f"{names}. Give the base a <freejoint/> in the file, or set fix_base=None."
        )
    bases[0].add_freejoint()


def hold_joints(spec: mujoco.MjSpec, model: mujoco.MjModel, positions: Mapping[str, float]) -> None:
    """Take hinge and slide joints out of a model, their bodies where the joints hold them.

    A body's joints move it by T J₁ J₂ …, with T its pose beside its parent. Held at q, J₂ is a constant C, and

        T J₁ C J₃ … = (T C) (C⁻¹ J₁ C) J₃ …

    so the body's pose becomes T C, and the joints before the held one are turned and moved by C⁻¹. Joints that follow
    a held one by an equality constraint are held too.

    Args:
        spec: The model; it is changed.
        positions: Where joints are held [rad, of slides m], by name.
    """
    positions = _with_followers(model, positions)
    _delete_references(spec, {*positions}, {*_tendons_of(spec, positions)})
    for body in {int(model.joint(name).bodyid[0]) for name in positions}:
        _hold_on(spec, model, body, positions)


def _hold_on(spec: mujoco.MjSpec, model: mujoco.MjModel, body: int, positions: Mapping[str, float]) -> None:
    """Hold joints of one body."""
    own = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    before: list[int] = []
    pose = model.body_quat[body].copy(), model.body_pos[body].copy()
    axes = {j: (model.jnt_axis[j].copy(), model.jnt_pos[j].copy()) for j in own}
    for j in own:
        joint = model.joint(j)
        if joint.name not in positions:
            before.append(j)
            continue
        moved = positions[joint.name] - float(model.qpos0[model.jnt_qposadr[j]])
        axis, anchor = axes[j]
        if int(model.jnt_type[j]) == mujoco.mjtJoint.mjJNT_SLIDE:
            turn, place = np.array([1.0, 0.0, 0.0, 0.0]), moved * axis
        else:
            turn = np.zeros(4)
            mujoco.mju_axisAngle2Quat(turn, axis, moved)
            place = anchor - _rotated(turn, anchor)
        pose = _product(pose[0], turn), pose[1] + _rotated(pose[0], place)
        back = turn * [1.0, -1.0, -1.0, -1.0]
        for i in before:
            axis, anchor = axes[i]
            axes[i] = _rotated(back, axis), _rotated(back, anchor - place)
    element = spec.bodies[body]
    element.set_frame(element.parent.add_frame())
    element.quat, element.pos = pose
    element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    for j in before:
        joint = spec.joint(model.joint(j).name)
        joint.set_frame(element.add_frame())
        joint.axis, joint.pos = axes[j]
    for j in own:
        if model.joint(j).name in positions:
            spec.delete(spec.joint(model.joint(j).name))


def _with_followers(model: mujoco.MjModel, positions: Mapping[str, float]) -> dict[str, float]:
    """The same, with joints that follow held ones."""
    names = [model.joint(j).name for j in single_joints(model)]
    if unknown := [name for name in positions if name not in names]:
        raise ValueError(
            f"{', '.join(unknown)}: no hinge or slide joint of the model, so nothing to hold. Joints: "
            f"{', '.join(names)}."
        )
    result = dict(positions)
    couplings = [e for e in range(model.neq) if int(model.eq_type[e]) == mujoco.mjtEq.mjEQ_JOINT]
    for _ in couplings:
        for e in couplings:
            follower, leader = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            name = model.joint(follower).name
            if leader < 0 or not model.eq_active0[e] or name in result or model.joint(leader).name not in result:
                continue
            zero, of_leader = (float(model.qpos0[model.jnt_qposadr[j]]) for j in (follower, leader))
            moved = result[model.joint(leader).name] - of_leader
            result[name] = zero + float(np.polynomial.polynomial.polyval(moved, model.eq_data[e, :5]))
    return result


def _tendons_of(spec: mujoco.MjSpec, positions: Mapping[str, float]) -> list[str]:
    """Tendons of held joints alone, deleted."""
    result = []
    for tendon in list(spec.tendons):
        joints = [wrap.target.name for wrap in tendon.path if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT]
        held = [name for name in joints if name in positions]
        if not held:
            continue
        if len(held) < len(joints):
            free = [name for name in joints if name not in positions]
            raise ValueError(
                f"The tendon {tendon.name!r} ties {', '.join(held)}, to be held, to {', '.join(free)}. Hold all of "
                "them or none (--joints)."
            )
        result.append(tendon.name)
        spec.delete(tendon)
    return result


def _delete_references(spec: mujoco.MjSpec, joints: set[str], tendons: set[str]) -> None:
    """Delete equality constraints, actuators and sensors of joints and tendons that are gone."""
    kind, drives = mujoco.mjtObj, mujoco.mjtTrn
    gone = {(kind.mjOBJ_JOINT, name) for name in joints} | {(kind.mjOBJ_TENDON, name) for name in tendons}
    ties = {mujoco.mjtEq.mjEQ_JOINT: kind.mjOBJ_JOINT, mujoco.mjtEq.mjEQ_TENDON: kind.mjOBJ_TENDON}
    moved = {
        drives.mjTRN_JOINT: kind.mjOBJ_JOINT,
        drives.mjTRN_JOINTINPARENT: kind.mjOBJ_JOINT,
        drives.mjTRN_TENDON: kind.mjOBJ_TENDON,
    }
    named = [
        *((each, [(ties.get(each.type), each.name1), (ties.get(each.type), each.name2)]) for each in spec.equalities),
        *((each, [(moved.get(each.trntype), each.target)]) for each in spec.actuators),
        *((each, [(each.objtype, each.objname), (each.reftype, each.refname)]) for each in spec.sensors),
    ]
    for element, those in named:
        if gone & set(those):
            spec.delete(element)


def _product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Quaternions multiplied."""
    result = np.zeros(4)
    mujoco.mju_mulQuat(result, one, other)
    return result


def _rotated(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A vector turned by a quaternion."""
    result = np.zeros(3)
    mujoco.mju_rotVecQuat(result, np.ascontiguousarray(vector), quat)
    return result
