"""Torques that move a robot's links as given: inverse dynamics, on a base that rests or moves."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from pace_envs import ManagerBasedEnv
from pace_envs.closed_loops import ClosedLoops
from pace_envs.motor_coordinates import DrivenJoints
from pace_envs.moving_frame import FrameState, bias_in_frame

_MODEL_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos")
"""What a recording's load may change."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LinkMotion:
    """A motion of K instants of some joints of a model, whose base may still move in any way.

    Passive joints stand where the model's equality constraints hold, and move with the driven ones: v = T v_d. The
    constraints carry what passive links need to the driven joints: τ_d = T' τ, with τ of the links alone.
    """

    model: mujoco.MjModel
    driven: DrivenJoints
    at_rest: np.ndarray
    """Torques of all degrees of freedom on a base that rests, (K, nv) [N m]."""
    bias: np.ndarray
    """Their part that the base changes, (K, nv) [N m]."""
    posture: np.ndarray
    """(K, nq)."""
    velocity: np.ndarray
    """(K, nv)."""
    following: np.ndarray
    """T of the driven joints, (K, nv, n), or (1, nv, n) where it is the same in all postures."""

    @classmethod
    def of(
        cls,
        model: mujoco.MjModel,
        joints: Sequence[str],
        position: np.ndarray,
        speed: np.ndarray,
        acceleration: np.ndarray,
    ) -> LinkMotion:
        """Of n joints.

        Args:
            joints: Names, (n,); motors that move several joints among them.
            position: (K, n) [rad].
            speed: (K, n) [rad/s].
            acceleration: (K, n) [rad/s²].
        """
        driven = DrivenJoints.of_model(model, joints)
        qpos = [model.joint(name).qposadr[0] for name in driven.joints]
        dof = [model.joint(name).dofadr[0] for name in driven.joints]
        position, speed, acceleration = (driven.to_joints(each) for each in (position, speed, acceleration))
        loops = ClosedLoops.of_model(model, dof)
        links = copy.copy(model)
        links.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT  # a violated one would act as a spring
        posture = np.repeat(links.qpos0[None], len(position), 0)
        posture[:, qpos] = position
        velocity, change = np.zeros((2, len(position), model.nv))
        velocity[:, dof], change[:, dof] = speed, acceleration
        following = np.eye(model.nv)[None][..., dof]
        if loops is not None:
            posture, velocity, change, following = loops.along(posture, velocity, change, dof)
        data = mujoco.MjData(links)
        torque, bias = np.empty((2, len(position), model.nv))
        for k in range(len(position)):
            data.qpos[:], data.qvel[:], data.qacc[:] = posture[k], velocity[k], change[k]
            mujoco.mj_inverse(links, data)
            torque[k], bias[k] = data.qfrc_inverse, data.qfrc_bias
        return cls(
            model=links,
            driven=driven,
            at_rest=torque,
            bias=bias,
            posture=posture,
            velocity=velocity,
            following=following,
        )

    @cached_property
    def _state(self) -> FrameState:
        """What a base that moves acts on."""
        state, data = FrameState.empty(self.model, len(self.posture)), mujoco.MjData(self.model)
        for k in range(len(self.posture)):
            data.qpos[:], data.qvel[:] = self.posture[k], self.velocity[k]
            mujoco.mj_fwdPosition(self.model, data)
            mujoco.mj_fwdVelocity(self.model, data)
            state.keep(k, data)
        return state

    def torque(self, frame: np.ndarray | None = None, point: np.ndarray | None = None) -> np.ndarray:
        """Torques of the joints, (K, n) [N m].

        Args:
            frame: How the model's frame moves, (K, 9): see :mod:`pace_envs.moving_frame`; ``None``: it rests.
            point: Where its specific force acts, (3,) [m].
        """
        torque = self.at_rest
        if frame is not None and point is not None:
            torque = torque - self.bias + bias_in_frame(self.model, self._state, frame, point)
        return self.driven.efforts_of_motors((torque[:, None] @ self.following)[:, 0])


def frame_motion(frame: np.ndarray, dt: float) -> np.ndarray:
    """Angular velocity, angular acceleration and specific force, (K, 9), of the first and the last of them, (K, 6)."""
    return np.concatenate([frame[:, :3], np.gradient(frame[:, :3], dt, axis=0), frame[:, 3:]], axis=1)


def model_of(env: ManagerBasedEnv, row: int) -> mujoco.MjModel:
    """One environment's model, with drives that neither weigh nor rub."""
    model = copy.deepcopy(env.sim.model)
    for name in _MODEL_FIELDS:
        getattr(model, name)[:] = env.sim.expand(name)[row].numpy().reshape(getattr(model, name).shape)
    for name in ("dof_armature", "dof_damping", "dof_frictionloss"):
        getattr(model, name)[:] = 0.0
    env.scene["robot"].driven.clear(model)
    return model


def bounded_least_squares(
    table: np.ndarray, values: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, float]:
    """Coefficients of which most are free: what leaves its bounds furthest is held there, one after another.

    Args:
        table: (N, m).
        values: (N,).
        lower: (m,).
        upper: (m,).

    Returns:
        The coefficients, (m,), and the sum of squares that they leave.
    """
    scale = np.sqrt(np.square(table).mean(axis=0)) + 1e-12
    table = table / scale
    square, target = table.T @ table, table.T @ values
    square[np.diag_indices_from(square)] += 1e-9 * len(values)
    low, high = lower * scale, upper * scale
    found, free = np.zeros(len(scale)), np.ones(len(scale), dtype=bool)
    while free.any():
        found[free] = np.linalg.solve(square[np.ix_(free, free)], (target - square[:, ~free] @ found[~free])[free])
        beyond = np.where(free, np.maximum(low - found, found - high), 0.0)
        worst = int(beyond.argmax())
        if beyond[worst] <= 0:
            break
        found[worst], free[worst] = np.clip(found[worst], low[worst], high[worst]), False
    return found / scale, float(np.square(values - table @ found).sum())
