"""A robot's model as the environment wants it: with a fixed or a floating base, and some joints held."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.model_file import compile_model, read_model_file


def load_robot_spec(cfg: ArticulationCfg) -> mujoco.MjSpec:
    """Read a robot's MJCF; its base is fixed or floating as the configuration says, and joints are held.

    Raises:
        ValueError: If the file is missing or no usable MJCF, or a joint cannot be held.
    """
    spec = read_model_file(cfg.mjcf_path).spec
    model = compile_model(spec, cfg.mjcf_path)  # a fault of the file is told with its name
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if cfg.fix_base:
        for joint in free:
            base = joint.parent
            base.pos, base.quat = cfg.init_state.pos, cfg.init_state.rot
            spec.delete(joint)
    if cfg.held_joints:
        hold_joints(spec, model, cfg.held_joints)
    return spec


def hold_joints(spec: mujoco.MjSpec, model: mujoco.MjModel, positions: Mapping[str, float]) -> None:
    """Take hinge and slide joints out of a model, their bodies where the joints hold them.

    A body's joints move it by T J₁ J₂ …, with T its pose beside its parent. Held at q, J₂ is a constant C, and

        T J₁ C J₃ … = (T C) (C⁻¹ J₁ C) J₃ …

    so the body's pose becomes T C, and the joints before the held one are turned and moved by C⁻¹. Joints that follow
    a held one by an equality constraint are held too.

    Args:
        spec: The model; it is changed.
        model: The same, compiled.
        positions: Where joints are held [rad, of slides m], by name.

    Raises:
        ValueError: If there is no such hinge or slide joint, or a tendon ties a held joint to another.
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
    single = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    names = [model.joint(j).name for j in range(model.njnt) if int(model.jnt_type[j]) in single]
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
