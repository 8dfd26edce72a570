"""Recordings of a robot whose base moves, brought onto its model: how it moves, when joints are free.

Where no contact is logged, the swings of the legs say which joints are free.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from scipy import ndimage
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from pace_actuators.text import listed
from pace_envs import ManagerBasedEnv
from pace_envs.motor_coordinates import DrivenJoints
from pace_optim.problem.drive_facts import acting_gains, asked_torque, drive_in
from pace_optim.problem.inverse_dynamics import LinkMotion, bounded_least_squares, frame_motion, model_of
from pace_optim.problem.kinematic_trees import independent_trees
from pace_optim.recording import Recording
from pace_optim.recording.carried import free_phases, standing_feet
from pace_optim.recording.data import ImuPose
from pace_optim.recording.keys import did_you_mean
from pace_optim.recording.time_base import interpolate_linear


def on_moving_base(recording: Recording, env: ManagerBasedEnv) -> Recording:
    """A conformed recording with its base's motion in the model's axes, and where its joints are free.

    Args:
        recording: On the robot's joints and control grid.
        env: The robot, its base fixed in the model.
    """
    if recording.base_ang_vel is None or recording.base_lin_acc is None:
        return recording
    axes, point = imu_pose(env.sim.model, recording.imu, recording.label)
    at = recording.sample_steps
    steps = np.arange(int(at[-1]) + 1)
    when = at if recording.sample_offset is None else at + recording.sample_offset
    shown = np.concatenate([recording.base_ang_vel @ axes.T, recording.base_lin_acc @ axes.T], axis=1)
    frame = interpolate_linear(when, shown, steps)
    legs, names = joints_of_feet(env, recording.feet, recording.label), recording.feet
    standing, how = standing_feet(recording), "a leg counts while its foot is in the air"
    if standing is None and _gains_are_stated(recording, env):
        legs = trees_of(env)
        names = tuple(recording.joint_names[joints[0]] for joints in legs)
        standing = standing_legs(recording, env, legs, shown, point)
        how = "no contact is logged: a leg counts while its drives' torques balance without a force of the ground"
    free = np.ones((len(steps), recording.num_joints), dtype=bool)
    if standing is None:
        said = (
            "nothing says when feet touch the ground: all of the recording counts. A robot that walks needs contact "
            "or foot_force, or gains that are stated."
        )
    elif recording.contact is None and recording.foot_force is None and not standing.any():
        said = (
            "no contact is logged: the drives' torques balance without a force of the ground, so all of the recording "
            "counts."
        )
    else:
        dt = float(np.median(np.diff(recording.time)))
        sample = np.searchsorted(at, steps, side="right") - 1
        for leg, joints in enumerate(legs):
            free[:, joints] &= free_phases(standing[:, leg], dt)[sample][:, None]
        said = f"{how}: {_swings(recording, names, legs, free)}"
        without = [tree[0] for tree in trees_of(env) if not any(set(tree) & set(leg) for leg in legs)]
        if without:
            footless = listed((recording.joint_names[joint] for joint in without), 6)
            said += f" No foot is on the legs or arms of {footless}, which count as free: name all feet that touch."
    notes = (*recording.notes, f"The base moves as the IMU shows, and {said}")
    return replace(recording, frame=frame, frame_point=point, free=free, notes=notes)


def _gains_are_stated(recording: Recording, env: ManagerBasedEnv) -> bool:
    """Whether the drives' torques are known."""
    return recording.drive.stiffness is not None or not env.cfg.sim2real.assumed_gains  # type: ignore[attr-defined]


def _swings(recording: Recording, names: Sequence[str], legs: Sequence[Sequence[int]], free: np.ndarray) -> str:
    """How often each leg swings, and which joints never do."""
    said = []
    for name, joints in zip(names, legs, strict=True):
        own = free[:, joints[0]]
        phases = int((np.diff(own.astype(int), prepend=0) == 1).sum())
        said.append(f"{name} {100 * own.mean():.0f} % of the time in {phases} swings")
    held = [name for i, name in enumerate(recording.joint_names) if not free[:, i].any()]
    never = (
        f" {listed(held, 6)}: always held by the ground, so nothing of them is identified. Lift that leg, or record it "
        "in the air."
        if held
        else ""
    )
    return f"{listed(said)}.{never}"


def imu_pose(model: mujoco.MjModel, imu: ImuPose, label: str) -> tuple[np.ndarray, np.ndarray]:
    """The IMU's axes as columns in the model's world, (3, 3), and where it is, (3,) [m]."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    if imu.body:
        bodies = [model.body(b).name for b in range(1, model.nbody)]
        if imu.body not in bodies:
            raise ValueError(
                f"{label}: imu.body is {imu.body!r}{did_you_mean(imu.body, bodies)} Bodies: {listed(bodies)}."
            )
        body, turned, axes = model.body(imu.body).id, np.empty(9), data.body(imu.body).xmat.reshape(3, 3)
        mujoco.mju_quat2Mat(turned, np.asarray(imu.quat))
        point, axes = data.body(imu.body).xpos + axes @ np.asarray(imu.pos), axes @ turned.reshape(3, 3)
    else:
        sites = [model.site(s).name for s in range(model.nsite)]
        if imu.site not in sites:
            raise ValueError(
                f"{label}: the model has no site {imu.site!r}, where the IMU is; it has {listed(sites)}. Add a site of "
                'that name to the base, or state the fact imu, such as {"body": "base", "pos": [0.1, 0, 0.02]}.'
            )
        body, site = int(model.site(imu.site).bodyid[0]), data.site(imu.site)
        point, axes = site.xpos.copy(), site.xmat.reshape(3, 3).copy()
    if int(model.body_weldid[body]) != 0:
        raise ValueError(
            f"{label}: the IMU is on {model.body(body).name!r}, which joints move; expected it on the base. Name a "
            "site or body of the base in the fact imu."
        )
    return axes, point


def joints_of_feet(env: ManagerBasedEnv, feet: Sequence[str], label: str) -> list[list[int]]:
    """For each foot, the joints that the ground holds where it stands, by index: all of its kinematic tree.

    Args:
        feet: Bodies, geoms, sites or legs: a leg's name begins those of its joints.
    """
    robot, model = env.scene["robot"], env.sim.model
    names, trees, result = list(robot.joint_names), trees_of(env), []
    for foot in feet:
        own = chain_of_foot(model, foot, names)
        if not own:
            known = [model.body(b).name for b in range(1, model.nbody)]
            raise ValueError(
                f"{label}: feet names {foot!r}, which is no body, geom, site or leg of the model"
                f"{did_you_mean(foot, known)} Bodies: {listed(known)}. Correct the name."
            )
        result.append(sorted({j for tree in trees if set(tree) & set(own) for j in tree}))
    return result


def trees_of(env: ManagerBasedEnv) -> list[list[int]]:
    """Joints that move each other, by index."""
    names = list(env.scene["robot"].joint_names)
    return [[names.index(name) for name in tree] for tree in independent_trees(env)]


def chain_of_foot(model: mujoco.MjModel, foot: str, joints: Sequence[str]) -> list[int]:
    """Joints of the leg of a foot, by index; none where the model has no such foot."""
    begins = re.compile(re.escape(foot) + r"(?![A-Za-z0-9])", re.IGNORECASE)
    return _chain(model, foot, joints) or [j for j, name in enumerate(joints) if begins.match(name)]


def _chain(model: mujoco.MjModel, name: str, joints: Sequence[str]) -> list[int]:
    """Joints between the world and a body, geom or site, by index; none where the model has no such thing."""
    body = -1
    for kind, owner in ((mujoco.mjtObj.mjOBJ_BODY, None), (mujoco.mjtObj.mjOBJ_GEOM, model.geom_bodyid),
                        (mujoco.mjtObj.mjOBJ_SITE, model.site_bodyid)):  # fmt: skip
        found = mujoco.mj_name2id(model, kind, name)
        if body < 0 <= found:
            body = found if owner is None else int(owner[found])
    result: list[int] = []
    while body > 0:
        first = int(model.body_jntadr[body])
        own = [model.joint(j).name for j in range(first, first + int(model.body_jntnum[body]))]
        result += [joints.index(joint) for joint in own if joint in joints]
        body = int(model.body_parentid[body])
    return result


_SMOOTHING = 0.01
"""Standard deviation of the smoothing [s]; of slow recordings 1.5 samples."""
_EDGE = 4.0
"""Ends of a recording that do not count, in standard deviations of the smoothing."""
_SHARES = (0.05, 0.1, 0.2)
"""Parts of the instants to which the equation is fitted ..."""
_FEWEST = 60
"""... and so many at least."""
_MOST = 20_000
"""Instants that are looked at."""
_GROWTHS = 4
"""Fits to all instants that balance."""
_DELAYS = 6
"""That are tried."""
_STEPS = 20
"""Of concentration, at most."""
_HANGS = 0.5
"""Misfit of all instants, over the torque's standard deviation, below which a leg never stands."""
_FOUND = 0.12
"""Misfit of those that balance, over the deviation of their torque, that is in the air; the joints' geometric mean."""
_BALANCED = 0.1
"""Part of the torque's standard deviation that is left in the air at most."""
_SMEARED = 1.5
"""So many standard deviations of the smoothing, the ground's force shows before and after it acts."""
_AT_ONCE = 5000
"""Instants whose inverse dynamics are computed together."""


def standing_legs(
    recording: Recording, env: ManagerBasedEnv, legs: Sequence[Sequence[int]], frame: np.ndarray, point: np.ndarray
) -> np.ndarray | None:
    """Which legs the ground holds, (T, legs) bool; ``None`` where no leg is ever found in the air.

    Args:
        recording: On the robot's joints and control grid, with gains that are stated.
        env: The robot, its base fixed in the model.
        frame: Angular velocity [rad/s] and specific force [m/s²] of the base at the samples, (T, 6).
        point: Where that force was measured, (3,) [m].
    """
    dt = float(np.median(np.diff(recording.time)))
    width = max(_SMOOTHING / dt, 1.5)
    edge = int(np.ceil(_EDGE * width))
    inner = np.arange(edge, recording.num_samples - edge)
    if len(inner) < _FEWEST:
        return None
    balances = _balances(recording, env, frame, point, dt, width)
    left = [_left_of(balances, joints, inner) for joints in legs]
    if all(each is None for each in left):
        return None
    result = np.ones((recording.num_samples, len(legs)), dtype=bool)
    for leg, each in enumerate(left):
        if each is not None:
            result[:, leg] = ndimage.binary_erosion(
                each > _BALANCED, iterations=round(_SMEARED * width), border_value=1
            )
    return result


@dataclass(frozen=True, kw_only=True, eq=False)
class _Balance:
    """The equation with one delay of the commands, at T instants of n joints."""

    drive: np.ndarray
    """Torques of the drives, (T, n) [N m]."""
    links: np.ndarray
    """What the links take, (T, n) [N m]."""
    table: np.ndarray
    """What the coefficients are multiplied by, (T, n, 5)."""
    lower: np.ndarray
    upper: np.ndarray
    """Bounds of the coefficients, (n, 5)."""

    def left(self, joints: Sequence[int], rows: np.ndarray) -> np.ndarray:
        """What is left of some joints at all instants if the equation is fitted to those of ``rows``, (T, joints)."""
        result = []
        for j in joints:
            values, table = self.drive[:, j] - self.links[:, j], self.table[:, j]
            found, _ = bounded_least_squares(table[rows], values[rows], self.lower[j], self.upper[j])
            result.append(values - table @ found)
        return np.stack(result, axis=1)


def _balances(
    recording: Recording, env: ManagerBasedEnv, frame: np.ndarray, point: np.ndarray, dt: float, width: float
) -> list[_Balance]:
    """One for each delay that is tried."""
    sim2real = env.cfg.sim2real  # type: ignore[attr-defined]
    position, frame = (gaussian_filter1d(each, width, axis=0) for each in (recording.dof_pos, frame))
    speed = np.gradient(position, dt, axis=0)
    acceleration = np.gradient(speed, dt, axis=0)
    direction = gaussian_filter1d(np.sign(speed), width, axis=0)
    model, base, links = model_of(env, 0), frame_motion(frame, dt), np.empty_like(position)
    for first in range(0, len(position), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        motion = LinkMotion.of(model, recording.joint_names, position[part], speed[part], acceleration[part])
        links[part] = motion.torque(base[part], point)
    delays = np.unique(np.linspace(0, math.ceil(float(sim2real.bounds["delay"][0, 1])), _DELAYS).round().astype(int))
    between = 0.5 * max(np.diff(delays), default=1) * recording.control_dt
    own = drive_in(env, recording)
    kp, kd = acting_gains(own, recording)
    bias = kp * sim2real.bounds["encoder_bias"].abs().max(dim=1).values.numpy()
    nothing, anything, late = np.zeros_like(kp), np.full_like(kp, np.inf), np.full_like(kp, between)
    result = []
    for delay in delays.tolist():
        drive = gaussian_filter1d(asked_torque(own, _later(recording, delay)), width, axis=0)
        terms = [acceleration, speed, direction, np.ones_like(speed), np.gradient(drive, dt, axis=0)]
        result.append(
            _Balance(
                drive=drive,
                links=links,
                table=np.stack(terms, axis=-1),
                lower=np.stack([nothing, -kd, nothing, -bias, -late], axis=-1),
                upper=np.stack([anything, anything, anything, bias, late], axis=-1),
            )
        )
    return result


def _later(recording: Recording, delay: int) -> Recording:
    """The recording with commands that come so many control steps later."""
    commands: dict[str, Any] = {
        name: series[np.maximum(np.arange(len(series)) - delay, 0)]
        for name in ("command", "command_vel", "command_effort")
        if (series := getattr(recording, name)) is not None
    }
    return replace(recording, **commands)


def _left_of(balances: Sequence[_Balance], joints: Sequence[int], inner: np.ndarray) -> np.ndarray | None:
    """The largest of what is left of a leg's joints, over the standard deviations of their torques, (T,).

    ``None`` where the leg is never in the air; zeros where it always is. Of all delays and beginnings, those count of
    which the instants that balance have most of the leg's motion.
    """
    own = list(joints)
    looked = inner[:: 1 + len(inner) // _MOST]
    moved = balances[0].table[looked][:, own, :2]
    energy = (np.square(moved) / moved.var(axis=0)).sum(axis=(1, 2))
    fastest = np.argsort(-energy)
    best: tuple[float, np.ndarray] | None = None
    for balance in balances:
        spread = np.maximum(balance.drive[looked][:, own].std(axis=0), 1e-9)
        if (_rms(balance.left(own, looked)[looked]) < _HANGS * spread).all():
            return np.zeros(len(balance.drive))
        for share in _SHARES:
            count = min(max(_FEWEST, round(share * len(looked))), len(looked))
            rows = _concentrated(balance, own, looked, looked[fastest[:count]])
            for _ in range(_GROWTHS):
                left = np.abs(balance.left(own, rows) / spread).max(axis=1)
                rows = looked[left[looked] < _BALANCED]
                if len(rows) < _FEWEST:
                    break
            else:
                misfit = _rms(balance.left(own, rows)[rows]) / np.maximum(balance.drive[rows][:, own].std(axis=0), 1e-9)
                gain = float(energy[left[looked] < _BALANCED].sum())
                if np.log(misfit).mean() < math.log(_FOUND) and (best is None or gain > best[0]):
                    best = gain, left
    return None if best is None else best[1]


def _concentrated(balance: _Balance, joints: list[int], looked: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """As many instants as ``rows`` has, of ``looked``, that the equation fits best."""
    for _ in range(_STEPS):
        left = balance.left(joints, rows)
        size = (np.square(left[looked]) / np.square(left[rows]).mean(axis=0)).sum(axis=1)
        closest = np.sort(looked[np.argpartition(size, len(rows) - 1)[: len(rows)]])
        if np.array_equal(closest, rows):
            break
        rows = closest
    return rows


def _rms(series: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(series).mean(axis=0))


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
