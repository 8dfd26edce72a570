"""How a base went, for pictures: by its IMU, and by the feet that stand.

No fit depends on it. The gyroscope turns the base, the accelerometer keeps it upright, and each foot that stands stays
where it is:

    R' = R exp(ω dt)        p' = p + mean over standing feet of (R f - R' f')

with f a foot's place in the base's frame. The lowest foot that stands is on the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from pace_envs.motor_coordinates import DrivenJoints
from pace_optim.problem.moving_base import chain_of_foot
from pace_optim.recording import Recording
from pace_optim.recording.moving_base import standing_feet

_UPRIGHT = 1.0
"""Time in which the accelerometer's direction replaces that of the gyroscope [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BasePath:
    """The base at K samples, and its feet."""

    pose: np.ndarray
    """Position [m] and quaternion (w, x, y, z) of the model's world, (K, 7)."""
    standing: np.ndarray
    """Which feet touch the ground, (K, feet) bool; no feet where nothing says it."""
    feet: list[tuple[str, list[float]]]
    """Body of each foot, and its place in it [m]."""


def base_path(recording: Recording, model: mujoco.MjModel, joint_names: Sequence[str]) -> BasePath | None:
    """The path of a recording that has a frame; ``None``: its base rests.

    Args:
        recording: Conformed, its base as :func:`~pace_optim.problem.moving_base.on_moving_base` has it.
        model: The robot on a fixed base.
        joint_names: Columns of the recording.
    """
    if recording.frame is None or not recording.base_moves:
        return None
    frame, dt = recording.frame[recording.sample_steps], float(np.median(np.diff(recording.time)))
    turned = _orientations(frame, dt)
    standing = standing_feet(recording)
    if standing is None:
        standing = np.zeros((len(frame), 0), dtype=bool)
    feet = [_place(model, foot, joint_names) for foot in recording.feet[: standing.shape[1]]]
    position = _positions(turned, standing, _feet_at(model, joint_names, recording.dof_pos, feet))
    pose = np.concatenate([position, turned.as_quat(scalar_first=True)], axis=1)
    return BasePath(
        pose=pose, standing=standing, feet=[(model.body(body).name, place.tolist()) for body, place in feet]
    )


def _orientations(frame: np.ndarray, dt: float) -> Rotation:
    """By a complementary filter: fast turns by the gyroscope, where up is by the accelerometer."""
    begin = frame[: max(1, round(0.5 * _UPRIGHT / dt)), 3:].mean(axis=0)
    now = Rotation.align_vectors([[0.0, 0.0, 1.0]], [begin])[0].as_matrix()
    result = np.empty((len(frame), 3, 3))
    for k, row in enumerate(frame):
        result[k] = now
        up = row[3:] / max(float(np.linalg.norm(row[3:])), 1e-9)
        wrong = np.cross(up, now[2])  # now[2] is where up should be, in the frame
        now = now @ Rotation.from_rotvec((row[:3] + wrong / _UPRIGHT) * dt).as_matrix()
    return Rotation.from_matrix(result)


def _positions(turned: Rotation, standing: np.ndarray, feet: np.ndarray) -> np.ndarray:
    """Where the base is, (K, 3) [m]."""
    result = np.zeros((len(standing), 3))
    if not standing.shape[1]:
        return result
    level = np.stack([turned.apply(feet[:, f]) for f in range(feet.shape[1])], axis=1)
    step = np.zeros(3)
    for k in range(1, len(result)):
        both = standing[k] & standing[k - 1]
        if both.any():
            step = (level[k - 1, both] - level[k, both]).mean(axis=0)
        result[k] = result[k - 1] + step
    height = np.where(standing, -level[..., 2], -np.inf).max(axis=1)
    known = np.flatnonzero(np.isfinite(height))
    if len(known):
        result[:, 2] = np.interp(np.arange(len(result)), known, height[known])
    return result


def _feet_at(
    model: mujoco.MjModel, joint_names: Sequence[str], position: np.ndarray, feet: Sequence[tuple[int, np.ndarray]]
) -> np.ndarray:
    """Places of feet in the model's world, (K, feet, 3) [m]."""
    driven, data = DrivenJoints.of_model(model, joint_names), mujoco.MjData(model)
    at = [int(model.joint(name).qposadr[0]) for name in driven.joints]
    result = np.empty((len(position), len(feet), 3))
    for k, row in enumerate(driven.to_joints(np.nan_to_num(position))):
        data.qpos[at] = row
        mujoco.mj_kinematics(model, data)
        for f, (body, place) in enumerate(feet):
            result[k, f] = data.xpos[body] + data.xmat[body].reshape(3, 3) @ place
    return result


def _place(model: mujoco.MjModel, foot: str, joint_names: Sequence[str]) -> tuple[int, np.ndarray]:
    """The body of a foot and its place in it [m]: its site, geom or body, else the far end of its leg."""
    for kind, owner, places in (
        (mujoco.mjtObj.mjOBJ_SITE, model.site_bodyid, model.site_pos),
        (mujoco.mjtObj.mjOBJ_GEOM, model.geom_bodyid, model.geom_pos),
    ):
        if (found := mujoco.mj_name2id(model, kind, foot)) >= 0:
            return int(owner[found]), places[found].copy()
    joint = max(model.joint(joint_names[j]).id for j in chain_of_foot(model, foot, joint_names))
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, foot)
    body = int(model.jnt_bodyid[joint]) if body < 0 else body
    geoms = [
        g for g in range(model.ngeom) if int(model.body_weldid[model.geom_bodyid[g]]) == int(model.body_weldid[body])
    ]
    if not geoms:
        return body, model.body_ipos[body].copy()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    far = max(geoms, key=lambda g: float(np.linalg.norm(data.geom_xpos[g] - data.xanchor[joint])))
    return int(model.geom_bodyid[far]), model.geom_pos[far].copy()
