"""Closed kinematic chains: passive joints that put a posture onto the model's equality constraints."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
import torch

from pace_envs.motor_coordinates import SINGLE

_STEPS = 40
"""Newton steps from one posture to the next."""
_LARGEST_STEP = 0.3
"""Largest change of a passive joint in a Newton step [rad or m]."""
_CLOSED = 1e-9
"""Loops are closed when the norm of their constraints' residuals is at most this [m or rad]."""
_NO_NEARER = 1e-6
"""Newton's method ends where its step would lower the residual by less than this part of it."""
_RATTLES = 0.01
"""A joint that the loops leave free leans on its stop on average, if it is nearer to it than this part of its range."""
_FOLLOWS = 1e-6
"""Speeds follow when their constraints are met within this part of the driven joints' speed."""
_TURN = 1e-4
"""Largest motion of a joint over which the change of T is taken [rad or m]."""
_ON_THE_WAY = 20
"""Intermediate postures between a closed one and one that Newton's method does not reach at once."""


@dataclass(eq=False)
class ClosedLoops:
    """Moves a model's passive joints so that its equality constraints hold: connect, weld, joint and tendon.

    Joints that lean on a stop stay there where the loops can be closed so: a spring holds them.

    With r(q) the constraints' residual and J_p its derivative with respect to the passive degrees of freedom,
    Newton's method takes q_p ← q_p - J_p⁺ r until r = 0, from the passive joints' present positions. If that does not
    converge, the joints move there step by step from the model's closed posture. A loop then keeps the assembly that
    it has in the model.
    """

    model: mujoco.MjModel
    """The model; only its kinematics are used."""
    passive: np.ndarray
    """Its degrees of freedom that are free to close the loops."""

    @classmethod
    def of_model(cls, model: mujoco.MjModel, driven: Sequence[int]) -> ClosedLoops | None:
        """The loops of a model; ``None`` if no active constraint ties passive joints.

        Args:
            driven: Degrees of freedom whose positions are given.
        """
        passive = np.setdiff1d(np.arange(model.nv), np.asarray(driven, dtype=int))
        if not len(passive) or not model.neq or not model.eq_active0.any():
            return None
        own = copy.copy(model)
        own.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        own.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        loops = cls(model=own, passive=passive)
        loops._data = mujoco.MjData(own)
        jacobian, _ = loops._constraints(own.qpos0)
        return loops if np.abs(jacobian[:, passive]).any() else None

    def __post_init__(self) -> None:
        """Make room for one posture."""
        self._data = mujoco.MjData(self.model)

    def closed(self, qpos: torch.Tensor, qvel: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Postures and speeds with the passive joints where the loops close, as far as they can be closed.

        Args:
            qpos: Postures, (m, nq).
            qvel: Speeds, (m, nv).

        Returns:
            Both, with new passive parts.
        """
        postures, speeds = qpos.double().cpu().numpy().copy(), qvel.double().cpu().numpy().copy()
        last: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        for row in range(len(postures)):
            if last is not None and np.array_equal(postures[row], last[0]) and np.array_equal(speeds[row], last[1]):
                postures[row], speeds[row] = postures[row - 1], speeds[row - 1]
                continue
            last = postures[row].copy(), speeds[row].copy(), postures[row]
            postures[row] = self.close(postures[row])
            jacobian, _ = self._constraints(postures[row])
            own = speeds[row].copy()
            own[self.passive] = 0.0
            speeds[row][self.passive] = -np.linalg.lstsq(jacobian[:, self.passive], jacobian @ own, rcond=1e-9)[0]
        return torch.from_numpy(postures).to(qpos), torch.from_numpy(speeds).to(qvel)

    def close(self, qpos: np.ndarray) -> np.ndarray:
        """The posture (nq,) with its passive joints where the loops close, or come nearest to closing."""
        loose = self._off_their_stops(qpos)
        here, gap = self._newton(qpos, loose)
        if gap > _CLOSED and len(loose) < len(self.passive):
            here, gap = self._newton(qpos, self.passive)
        if gap <= _CLOSED:
            return here
        start, own = self._newton(self.model.qpos0.copy(), np.arange(self.model.nv))
        if own > _CLOSED:
            return here
        way = np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, way, 1.0, start, qpos)
        way[self.passive] = 0.0
        there = start
        for _ in range(_ON_THE_WAY):
            there = self._moved(there, way / _ON_THE_WAY)
            there, other = self._newton(there, self.passive)
        return there if other < gap else here

    def nearest(self, qpos: np.ndarray) -> np.ndarray:
        """The posture (nq,) with its passive joints as near to closing the loops as they come from where they are."""
        return self._newton(qpos, self.passive)[0]

    def _off_their_stops(self, qpos: np.ndarray, near: float = 0.0) -> np.ndarray:
        """Passive degrees of freedom without those of joints that lean on a stop: they stay there if loops let them.

        Args:
            qpos: A posture, (nq,).
            near: The part of its range by which a joint may be off its stop.
        """
        model = self.model
        joints = model.dof_jntid[self.passive]
        place, (low, high) = qpos[model.jnt_qposadr[joints]], model.jnt_range[joints].T
        single = model.jnt_type[joints] != mujoco.mjtJoint.mjJNT_BALL
        slack = near * (high - low)
        leans = model.jnt_limited[joints].astype(bool) & single & ((place <= low + slack) | (place >= high - slack))
        return self.passive[~leans]

    def following(self, qpos: np.ndarray) -> np.ndarray:
        """How all speeds follow from those of the driven joints at a posture (nq,): v = T v_d, (nv, nv).

        Columns of passive joints are of no meaning; one that nothing ties stands still, and so does one that leans on
        its stop, or rattles there, where the others can follow without it.
        """
        jacobian, _ = self._constraints(qpos)
        driven, loose = np.setdiff1d(np.arange(self.model.nv), self.passive), self._off_their_stops(qpos, _RATTLES)
        for free in (loose, self.passive):
            result = np.eye(self.model.nv)
            result[self.passive] = 0.0
            result[free] = -np.linalg.lstsq(jacobian[:, free], jacobian, rcond=1e-9)[0]
            if np.abs(jacobian @ result[:, driven]).max(initial=0.0) <= _FOLLOWS or len(free) == len(self.passive):
                break
        return result

    def along(
        self, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray, driven: Sequence[int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """A motion of K instants whose passive joints follow the driven ones.

            v = T v_d,    a = T a_d + Ṫ v_d

        Args:
            qpos: Postures, (K, nq).
            qvel: Speeds, (K, nv).
            qacc: Accelerations, (K, nv).
            driven: Degrees of freedom that count, (n,).

        Returns:
            Postures, speeds and accelerations; T, (K, nv, n), or (1, nv, n) where all constraints are linear.
        """
        own, faster = qvel[:, driven], qacc[:, driven]
        if self._is_linear and len(qpos):
            first, posture = self.close(qpos[0]), qpos.copy()
            at = self.following(first)[:, driven]
            places = self.model.jnt_qposadr[self.model.dof_jntid[self.passive]]
            moved = (qpos - qpos[0])[:, self.model.jnt_qposadr[self.model.dof_jntid[list(driven)]]]
            posture[:, places] = first[places] + moved @ at[self.passive].T
            return posture, own @ at.T, faster @ at.T, at[None]
        posture, there = np.empty_like(qpos), np.empty((len(qpos), self.model.nv, own.shape[1]))
        turning, near = np.empty_like(there), qpos[0] if len(qpos) else self.model.qpos0
        places = np.setdiff1d(
            np.arange(self.model.nq), [self.model.jnt_qposadr[self.model.dof_jntid[d]] for d in driven]
        )
        for k in range(len(qpos)):
            wanted = qpos[k].copy()
            wanted[places] = near[places]  # in the assembly of the instant before
            posture[k] = near = self.close(wanted)
            there[k] = self.following(near)[:, driven]
            speed = there[k] @ own[k]
            step = _TURN / max(float(np.abs(speed).max(initial=0.0)), 1e-12)
            turning[k] = (self.following(self._moved(near, step * speed))[:, driven] - there[k]) / step
        follows = np.einsum("kij,kj->ki", there, own)
        return posture, follows, np.einsum("kij,kj->ki", there, faster) + np.einsum("kij,kj->ki", turning, own), there

    @cached_property
    def carrying(self) -> np.ndarray | None:
        """T' where all constraints are linear, (nv, nv): passive joints' torques on the driven joints; else ``None``.

        Passive joints keep theirs.
        """
        if not self._is_linear:
            return None
        result = self.following(self.close(self.model.qpos0.copy())).T
        result[self.passive] = np.eye(self.model.nv)[self.passive]
        return result

    @property
    def _is_linear(self) -> bool:
        """Whether each passive joint is a linear function of others: all active constraints are such."""
        model = self.model
        active = model.eq_active0.astype(bool)
        linear = np.isin(model.eq_type, [mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_TENDON])
        spatial = bool(np.isin(model.wrap_type, [mujoco.mjtWrap.mjWRAP_JOINT], invert=True).any())
        single = np.isin(model.jnt_type[model.dof_jntid[self.passive]], SINGLE).all()
        return bool(
            single
            and (linear | ~active).all()
            and not model.eq_data[active, 2:5].any()
            and not (spatial and (model.eq_type[active] == mujoco.mjtEq.mjEQ_TENDON).any())
        )

    def gap(self, qpos: np.ndarray) -> tuple[float, str]:
        """How far the loops of a posture (nq,) are from closed [m or rad], and the worst constraint's name."""
        _, residual = self._constraints(qpos)
        worst = int(np.abs(residual).argmax())
        return float(np.abs(residual[worst])), self._name(int(self._data.efc_id[worst]))

    def closable(self, qpos: np.ndarray, slack: np.ndarray) -> bool:
        """Whether the loops close when each degree of freedom may be off by some slack (nv,) [rad or m]."""
        moved, gap = self._newton(qpos, np.arange(self.model.nv))
        off = np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, off, 1.0, qpos, moved)
        return gap <= _CLOSED and bool((np.abs(off) <= slack).all())

    def _newton(self, qpos: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, float]:
        """A posture on the constraints, moving some degrees of freedom, and the norm of what remains of them.

        A constraint that these cannot meet does not keep the others from being met.
        """
        best, least = qpos, np.inf
        for _ in range(_STEPS):
            jacobian, residual = self._constraints(qpos)
            gap = float(np.linalg.norm(residual))
            if gap < least:
                best, least = qpos, gap
            if gap <= _CLOSED:
                break
            step = np.zeros(self.model.nv)
            step[free] = -np.linalg.lstsq(jacobian[:, free], residual, rcond=1e-9)[0]
            if np.linalg.norm(jacobian @ step) <= _NO_NEARER * gap:
                break
            qpos = self._moved(qpos, step * min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), 1e-12)))
        return best, least

    def _constraints(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivative (ne, nv) and residual (ne,) of the equality constraints at a posture."""
        data = self._data
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(self.model, data)
        count = data.ne
        return data.efc_J.reshape(-1, self.model.nv)[:count].copy(), data.efc_pos[:count].copy()

    def _moved(self, qpos: np.ndarray, step: np.ndarray) -> np.ndarray:
        moved = qpos.copy()
        mujoco.mj_integratePos(self.model, moved, step, 1.0)
        return moved

    def _name(self, e: int) -> str:
        model = self.model
        if model.eq(e).name:
            return model.eq(e).name
        kind = mujoco.mjtEq(int(model.eq_type[e])).name.removeprefix("mjEQ_").lower()
        obj = {mujoco.mjtObj.mjOBJ_BODY: model.body, mujoco.mjtObj.mjOBJ_SITE: model.site}
        one, other = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        if kind == "joint":
            names = [model.joint(j).name for j in (one, other) if j >= 0]
        elif kind == "tendon":
            names = [model.tendon(t).name for t in (one, other) if t >= 0]
        else:
            names = [obj[mujoco.mjtObj(int(model.eq_objtype[e]))](i).name for i in (one, other)]
        return f"{kind} of {' and '.join(names)}"
