"""What links ask of the drives along a motion, and what a change of one link's inertia changes of that."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from pace_envs.moving_frame import FrameState, bias_in_frame, motion_of_bodies

LinkChange = Sequence[Mapping[tuple[int, int], np.ndarray]]
"""By recording, change of the pseudo-inertia of a body, (4, 4), that a joint carries: {(body, joint): change}."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LinkStates:
    """B states of a model on their way."""

    model: mujoco.MjModel
    state: FrameState
    qacc: np.ndarray
    """(B, nv)."""
    place: np.ndarray
    """Of bodies, (B, nbody, 3) [m]."""
    turn: np.ndarray
    """Their axes, (B, nbody, 3, 3)."""
    mass: np.ndarray
    """(B, nv, nv)."""
    bias: np.ndarray
    """(B, nv)."""
    passive: np.ndarray
    """Springs, viscous and Coulomb friction of the model, (B, nv)."""
    follow: np.ndarray
    """Speeds by those of the driven joints, (B, nv, n)."""
    frame: np.ndarray
    """How the model's frame moves, (B, 9): see :mod:`pace_envs.moving_frame`."""
    point: np.ndarray
    """Where its specific force acts, (3,) [m]."""

    @classmethod
    def of(
        cls,
        model: mujoco.MjModel,
        qpos: np.ndarray,
        qvel: np.ndarray,
        qacc: np.ndarray,
        follow: Callable[[np.ndarray], np.ndarray],
        frame: np.ndarray | None = None,
        point: np.ndarray | None = None,
    ) -> LinkStates:
        """Of B positions (B, nq), speeds and accelerations (B, nv).

        Args:
            model: Without constraints; the drives neither weigh nor rub.
            qpos: Positions.
            qvel: Speeds.
            qacc: Accelerations.
            follow: Gives how all speeds follow from the drives' at a posture (nq,).
            frame: How the model's frame moves, (B, 9); ``None``: it rests.
            point: Where its specific force acts, (3,) [m].
        """
        count, data = len(qpos), mujoco.MjData(model)
        state, at = FrameState.empty(model, count), follow(qpos[0])
        place, turn = np.empty((count, model.nbody, 3)), np.empty((count, model.nbody, 9))
        mass, (bias, passive) = np.empty((count, model.nv, model.nv)), np.empty((2, count, model.nv))
        follows = np.empty((count, *at.shape))
        for k in range(count):
            data.qpos[:], data.qvel[:] = qpos[k], qvel[k]
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_fullM(model, data, mass[k])
            bias[k], passive[k], place[k], turn[k] = data.qfrc_bias, data.qfrc_passive, data.xpos, data.xmat
            state.keep(k, data)
            follows[k] = follow(qpos[k])
        if frame is None or point is None:
            frame, point = np.concatenate([np.zeros(6), -model.opt.gravity])[None].repeat(count, 0), np.zeros(3)
        else:
            bias = bias_in_frame(model, state, frame, point)
        return cls(
            model=model,
            state=state,
            qacc=qacc,
            place=place,
            turn=turn.reshape(count, model.nbody, 3, 3),
            mass=mass,
            bias=bias,
            passive=passive - model.dof_frictionloss * np.sign(qvel),
            follow=follows,
            frame=frame,
            point=point,
        )

    def feel(self, direct: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Inertia, torque and load of the joints, (B, n) each.

        Args:
            direct: Speeds by those of the driven joints and of what follows them by a ratio, (nv, n).
            own: Accelerations of the joints, (B, n).
        """
        missing = np.einsum("kij,kj->ki", self.mass, self.qacc) + self.bias - self.passive
        inertia = np.einsum("kij,kil,klj->kj", self.follow, self.mass, self.follow, optimize=True)
        torque = inertia * own - np.einsum("kij,ki->kj", self.follow, missing)
        return inertia, torque, -self.bias @ direct

    def change(
        self, of: Mapping[tuple[int, int], np.ndarray], direct: np.ndarray, own: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What changes of links change of what the joints feel that carry them, (B, n) each.

        V is the velocity field of a body and S that of its joint at unit speed, as (4, 4) matrices on points (x, 1).
        With the body's pseudo-inertia J in the world's axes (Wensing, Kim, Slotine, IEEE Robot. Autom. Lett. 3, 2018),

            M_jj = tr(S' S J),    τ_j = tr(S' A J),    A = V̇ + V V

        where V̇ has the acceleration less gravity.

        Args:
            of: The changes.
            direct: As for :meth:`feel`.
            own: As for it.
        """
        inertia, torque, load = np.zeros((3, *own.shape))
        velocity, at_rest = self._of_bodies
        for (body, joint), change in of.items():
            dofs, ways = self._above(body), self.state.cdof
            pose = np.zeros((len(own), 4, 4))
            pose[:, :3, :3], pose[:, 3, 3] = self.turn[:, body], 1.0
            pose[:, :3, 3] = self.place[:, body] - self.state.subtree_com[:, int(self.model.body_rootid[body])]
            there = pose @ change @ pose.transpose(0, 2, 1)
            moved = _field(np.einsum("kdi,kd->ki", ways[:, dofs], self.follow[:, dofs, joint]))
            alone = _field(np.einsum("kdi,d->ki", ways[:, dofs], direct[dofs, joint]))
            speed = _field(velocity[:, body])
            resting = _field(at_rest[:, body]) + speed @ speed
            whole = resting + _field(np.einsum("kdi,kd->ki", ways[:, dofs], self.qacc[:, dofs]))
            whole[:, :3, 3] += self.model.body_gravcomp[body] * self.model.opt.gravity
            inertia[:, joint] += _trace(moved, moved, there)
            torque[:, joint] -= _trace(moved, whole, there)
            load[:, joint] -= _trace(alone, resting, there)
        return inertia, torque + inertia * own, load

    @cached_property
    def _of_bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Spatial velocities and accelerations without those of joints, (B, nbody, 6) each."""
        return motion_of_bodies(self.model, self.state, self.frame, self.point)

    def _above(self, body: int) -> list[int]:
        """Degrees of freedom that move a body."""
        chain = {0}
        while body:
            chain.add(body)
            body = int(self.model.body_parentid[body])
        return [i for i in range(self.model.nv) if int(self.model.dof_bodyid[i]) in chain]


def _field(motion: np.ndarray) -> np.ndarray:
    """How spatial velocities (B, 6) move a point (x, 1), (B, 4, 4)."""
    result = np.zeros((len(motion), 4, 4))
    x, y, z = motion[:, :3].T
    result[:, 2, 1], result[:, 0, 2], result[:, 1, 0] = x, y, z
    result[:, 1, 2], result[:, 2, 0], result[:, 0, 1] = -x, -y, -z
    result[:, :3, 3] = motion[:, 3:]
    return result


def _trace(a: np.ndarray, b: np.ndarray, j: np.ndarray) -> np.ndarray:
    """tr(A' B J), (B,)."""
    return np.einsum("kij,kij->k", a, b @ j)
