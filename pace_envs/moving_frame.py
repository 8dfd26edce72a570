"""A robot on a base that moves as it was measured: the model stays at rest, and its frame moves.

A joint knows of its base's motion only the angular velocity, the angular acceleration and the specific force. So the
model of a robot on a fixed base serves for one that walks: gravity and Coriolis forces are those of its moving frame.
Position, speed and heading of the base do not matter, and nothing drifts.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import torch

FIELDS = ("cdof", "cdof_dot", "cvel", "cinert", "subtree_com", "qvel")
"""What :func:`bias_in_frame` reads of MuJoCo's data, after its positions and velocities have been computed."""
COLUMNS = 9
"""Numbers of a motion: angular velocity [rad/s], angular acceleration [rad/s²], specific force [m/s²]; in the model's
axes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Course:
    """What a simulation of candidates on recordings is given beside commands."""

    motion: torch.Tensor
    """Of the model's frame in each physics step, (T, parts, R, 9): see :data:`COLUMNS`."""
    point: torch.Tensor
    """Where the specific force was measured, (R, 3) [m], in the model's world."""
    held: torch.Tensor
    """Positions [rad] and speeds [rad/s] at which joints are held, (T, R, n, 2); NaN where they are free."""
    shift: torch.Tensor
    """What is added to them, (num_envs, n, 2): encoder bias, and the unknown part of where a phase begins."""
    push: torch.Tensor
    """What is added to the angular acceleration [rad/s²] and the specific force [m/s²], (num_envs, 6)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameState:
    """MuJoCo's fields of B states of one model, (B, …) each: see :data:`FIELDS`."""

    cdof: np.ndarray
    cdof_dot: np.ndarray
    cvel: np.ndarray
    cinert: np.ndarray
    subtree_com: np.ndarray
    qvel: np.ndarray

    @classmethod
    def empty(cls, model: mujoco.MjModel, count: int) -> FrameState:
        """Room for that many states of a model."""
        shapes = {"cdof": (model.nv, 6), "cdof_dot": (model.nv, 6), "cvel": (model.nbody, 6),
                  "cinert": (model.nbody, 10), "subtree_com": (model.nbody, 3), "qvel": (model.nv,)}  # fmt: skip
        return cls(**{name: np.empty((count, *shapes[name])) for name in FIELDS})

    def keep(self, row: int, data: mujoco.MjData) -> None:
        """Take over a state whose positions and velocities have been computed."""
        for name in FIELDS:
            own = getattr(self, name)[row]
            own[...] = np.reshape(getattr(data, name), own.shape)


def bias_in_frame(model: mujoco.MjModel, state: FrameState, motion: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Forces of the motion on each degree of freedom in a moving frame, with the sign of MuJoCo's ``qfrc_bias``.

    The recursive Newton–Euler algorithm (Featherstone, Rigid Body Dynamics Algorithms, 2008, table 5.1), as MuJoCo's
    ``mj_rne`` without joint accelerations. With ω, α the frame's rotation and f the specific force at a point P, the
    recursion starts, for a tree about c, not at rest under gravity but at

        v₀ = (ω, ω × (c - P))        a₀ = (α, f + α × (c - P))

    so that ω = α = 0 and f = -g gives ``qfrc_bias``.

    Args:
        model: The model, whose base is fixed.
        motion: Of each, (B, 9): ω [rad/s], α [rad/s²], f [m/s²].
        point: Where f acts, (3,) or (B, 3) [m], in the model's world.

    Returns:
        (B, nv) [N m, of slides N].
    """
    velocity, acceleration = motion_of_bodies(model, state, motion, point)
    pushed = np.zeros_like(velocity)
    for body in range(1, model.nbody):
        inertia = state.cinert[:, body]
        momentum = _times_inertia(inertia, velocity[:, body])
        pushed[:, body] = _times_inertia(inertia, acceleration[:, body]) + _force_product(velocity[:, body], momentum)
    for body in range(model.nbody - 1, 0, -1):
        if parent := int(model.body_parentid[body]):
            pushed[:, parent] += pushed[:, body]
    return np.einsum("bji,bji->bj", state.cdof, pushed[:, model.dof_bodyid])


def motion_of_bodies(
    model: mujoco.MjModel, state: FrameState, motion: np.ndarray, point: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Spatial velocities and accelerations of all bodies without joint accelerations, (B, nbody, 6) each.

    They are of points at the centre of mass of a body's tree, in the world's axes, the rotation first, as MuJoCo's
    ``cvel``; gravity is in the accelerations. Arguments as for :func:`bias_in_frame`.
    """
    rotation, turning, force = motion[:, :3], motion[:, 3:6], motion[:, 6:]
    velocity, acceleration = state.cvel.copy(), np.zeros((len(motion), model.nbody, 6))
    for body in range(1, model.nbody):
        parent, first, count = (int(each[body]) for each in (model.body_parentid, model.body_dofadr, model.body_dofnum))
        arm = state.subtree_com[:, int(model.body_rootid[body])] - point
        frame = np.concatenate([rotation, np.cross(rotation, arm)], axis=1)
        velocity[:, body] += frame
        if parent == 0:
            acceleration[:, body] = np.concatenate([turning, force + np.cross(turning, arm)], axis=1)
        else:
            acceleration[:, body] = acceleration[:, parent]
        for dof in range(first, first + count):
            change = state.cdof_dot[:, dof] + _motion_product(frame, state.cdof[:, dof])
            acceleration[:, body] += change * state.qvel[:, dof, None]
    return velocity, acceleration


def _times_inertia(inertia: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Momentum of ten numbers of inertia (B, 10) and a velocity (B, 6), as MuJoCo's ``mju_mulInertVec``."""
    i, x, y, z, a, b, c = inertia.T, *v.T
    return np.stack(
        [
            i[0] * x + i[3] * y + i[4] * z - i[8] * b + i[7] * c,
            i[3] * x + i[1] * y + i[5] * z + i[8] * a - i[6] * c,
            i[4] * x + i[5] * y + i[2] * z - i[7] * a + i[6] * b,
            i[8] * y - i[7] * z + i[9] * a,
            i[6] * z - i[8] * x + i[9] * b,
            i[7] * x - i[6] * y + i[9] * c,
        ],
        axis=1,
    )


def _motion_product(v: np.ndarray, m: np.ndarray) -> np.ndarray:
    """V × m of spatial velocities, (B, 6)."""
    turned = np.cross(v[:, :3], m[:, :3])
    return np.concatenate([turned, np.cross(v[:, :3], m[:, 3:]) + np.cross(v[:, 3:], m[:, :3])], axis=1)


def _force_product(v: np.ndarray, f: np.ndarray) -> np.ndarray:
    """V ×* f of a spatial velocity and a spatial force, (B, 6)."""
    turned = np.cross(v[:, :3], f[:, :3]) + np.cross(v[:, 3:], f[:, 3:])
    return np.concatenate([turned, np.cross(v[:, :3], f[:, 3:])], axis=1)


SOURCE = """
static void cross(double* r, const double* a, const double* b) {
  r[0] = a[1] * b[2] - a[2] * b[1]; r[1] = a[2] * b[0] - a[0] * b[2]; r[2] = a[0] * b[1] - a[1] * b[0];
}
static void times_inertia(double* r, const double* i, const double* v) {
  r[0] = i[0] * v[0] + i[3] * v[1] + i[4] * v[2] - i[8] * v[4] + i[7] * v[5];
  r[1] = i[3] * v[0] + i[1] * v[1] + i[5] * v[2] + i[8] * v[3] - i[6] * v[5];
  r[2] = i[4] * v[0] + i[5] * v[1] + i[2] * v[2] - i[7] * v[3] + i[6] * v[4];
  r[3] = i[8] * v[1] - i[7] * v[2] + i[9] * v[3];
  r[4] = i[6] * v[2] - i[8] * v[0] + i[9] * v[4];
  r[5] = i[7] * v[0] - i[6] * v[1] + i[9] * v[5];
}
static void bias_in_frame(const mjModel* m, mjData* d, const double* motion, const double* point, double* room) {
  const double *w = motion, *turning = motion + 3, *force = motion + 6;
  double *acceleration = room, *pushed = room + 6 * m->nbody, t[3], u[3];
  for (int b = 1; b < m->nbody; ++b) {
    const int parent = m->body_parentid[b], first = m->body_dofadr[b];
    const double* c = d->subtree_com + 3 * m->body_rootid[b];
    const double arm[3] = {c[0] - point[0], c[1] - point[1], c[2] - point[2]};
    double frame[6] = {w[0], w[1], w[2]}, velocity[6], momentum[6], f[6], *a = acceleration + 6 * b;
    cross(frame + 3, w, arm);
    for (int i = 0; i < 6; ++i) velocity[i] = d->cvel[6 * b + i] + frame[i];
    if (parent == 0) {
      cross(t, turning, arm);
      for (int i = 0; i < 3; ++i) { a[i] = turning[i]; a[i + 3] = force[i] + t[i]; }
    } else {
      memcpy(a, acceleration + 6 * parent, 6 * sizeof(double));
    }
    for (int j = first; j < first + m->body_dofnum[b]; ++j) {
      const double *s = d->cdof + 6 * j, *r = d->cdof_dot + 6 * j, v = d->qvel[j];
      cross(t, frame, s);
      for (int i = 0; i < 3; ++i) a[i] += (r[i] + t[i]) * v;
      cross(t, frame, s + 3);
      cross(u, frame + 3, s);
      for (int i = 0; i < 3; ++i) a[i + 3] += (r[i + 3] + (t[i] + u[i])) * v;
    }
    const double* inertia = d->cinert + 10 * b;
    times_inertia(momentum, inertia, velocity);
    times_inertia(f, inertia, a);
    cross(t, velocity, momentum);
    cross(u, velocity + 3, momentum + 3);
    for (int i = 0; i < 3; ++i) f[i] += t[i] + u[i];
    cross(t, velocity, momentum + 3);
    for (int i = 0; i < 3; ++i) f[i + 3] += t[i];
    memcpy(pushed + 6 * b, f, 6 * sizeof(double));
  }
  for (int b = m->nbody - 1; b > 0; --b) {
    const int parent = m->body_parentid[b];
    if (parent) for (int i = 0; i < 6; ++i) pushed[6 * parent + i] += pushed[6 * b + i];
  }
  for (int j = 0; j < m->nv; ++j) {
    const double *s = d->cdof + 6 * j, *f = pushed + 6 * m->dof_bodyid[j];
    d->qfrc_bias[j] = s[0] * f[0] + s[1] * f[1] + s[2] * f[2] + s[3] * f[3] + s[4] * f[4] + s[5] * f[5];
  }
}
"""
"""The same in C, between MuJoCo's ``mj_step1`` and ``mj_step2``; ``room`` has 12 numbers for each body."""
