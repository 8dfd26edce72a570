"""What each joint feels along a motion of the whole robot: joints without drives follow through their constraints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from types import MappingProxyType

import mujoco
import numpy as np
import torch

from pace_envs import ManagerBasedEnv
from pace_envs.closed_loops import ClosedLoops
from pace_envs.motor_coordinates import MotorCoordinates
from pace_envs.moving_frame import FrameState, bias_in_frame, motion_of_bodies
from pace_optim.recording.carried import Carried

Parameter = tuple[str, str]
"""An effect on the model, and one of its parameters."""
LinkChange = Sequence[Mapping[tuple[int, int], np.ndarray]]
"""By recording, change of the pseudo-inertia of a body, (4, 4), that a joint carries: {(body, joint): change}."""
_AT_ONCE = 4096
"""Control steps whose states are kept together."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JointLoad:
    """What each joint feels in the interval after a control step: (T, R, n) each."""

    inertia: torch.Tensor
    """Rigid-body inertia, without armature [kg m²]."""
    torque: torch.Tensor
    """Torque of gravity, of springs, and of the other joints' motion [N m]."""
    load: torch.Tensor
    """The same without what the other joints' accelerations do: the load that a robot's drives get [N m]."""

    stiffness: torch.Tensor
    """Derivative of the torque by the joint's own position [N m/rad]."""

    @classmethod
    def empty(cls, shape: Sequence[int]) -> JointLoad:
        """Room for (T, R, n)."""
        return cls(**{each.name: torch.empty(*shape, dtype=torch.float64) for each in fields(cls)})

    def put(self, at: tuple[slice, int], felt: Sequence[np.ndarray]) -> None:
        """Write inertia, torque and load of a part."""
        for own, value in zip((self.inertia, self.torque, self.load), felt, strict=True):
            own[at] = torch.from_numpy(value)

    def map(self, change: Callable[[torch.Tensor], torch.Tensor]) -> JointLoad:
        """The same change of each."""
        return JointLoad(**{name: change(own) for name, own in vars(self).items()})

    def less(self, other: JointLoad, times: torch.Tensor) -> JointLoad:
        """This less a multiple of another."""
        return JointLoad(**{name: own - times * getattr(other, name) for name, own in vars(self).items()})


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """A motion of the whole robot in the intervals between control steps, passive joints too."""

    qpos: torch.Tensor
    """In the middle of each interval, (T, R, nq)."""
    qvel: torch.Tensor
    """There, (T, R, nv)."""
    qacc: torch.Tensor
    """In it, (T, R, nv)."""
    frame: torch.Tensor | None = None
    """How the model's frame moves there, (T, R, 9): see :mod:`pace_envs.moving_frame`; ``None``: it rests."""
    point: torch.Tensor | None = None
    """Where its specific force acts, (R, 3) [m]."""

    @classmethod
    def between(
        cls, qpos: torch.Tensor, qvel: torch.Tensor, dt: float, carried: Carried | None = None, loop_dt: float = 0.0
    ) -> Motion:
        """The motion between control steps, of positions (T, R, nq) and speeds (T, R, nv) at them.

        Args:
            dt: Control step [s].
            carried: How the base moves; ``None``: it rests.
            loop_dt: Time for which drives hold their torques [s].
        """
        middle, speed = 0.5 * (qpos[:-1] + qpos[1:]), 0.5 * (qvel[:-1] + qvel[1:])
        frame = None if carried is None else carried.motion(1, dt, loop_dt)[: len(middle), 0]
        point = None if carried is None else carried.point
        return cls(qpos=middle, qvel=speed, qacc=(qvel[1:] - qvel[:-1]) / dt, frame=frame, point=point)

    def every(self, steps: int) -> Motion:
        """One interval in so many."""
        frame = None if self.frame is None else self.frame[::steps]
        return replace(self, qpos=self.qpos[::steps], qvel=self.qvel[::steps], qacc=self.qacc[::steps], frame=frame)

    def course(self, at: tuple[slice, int]) -> tuple[np.ndarray | None, np.ndarray | None]:
        """How the frame moves in a part of a recording, (T', 9), and the point (3,)."""
        if self.frame is None or self.point is None:
            return None, None
        return self.frame[at].numpy(), self.point[at[1]].numpy()

    def moved(self, by: torch.Tensor) -> Motion:
        """With other positions, by (T, R, nq)."""
        return replace(self, qpos=self.qpos + by)


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Links:
    """The rigid bodies of a robot, one model for each recording's load, and the degrees of freedom that are driven."""

    models: Sequence[mujoco.MjModel]
    columns: np.ndarray
    """The driven joints' degrees of freedom, (n,)."""
    loops: ClosedLoops | None
    """What passive joints follow."""
    coordinates: MotorCoordinates | None = None
    """Of motors that move several joints; motions and what is felt are theirs."""

    @classmethod
    def of(cls, env: ManagerBasedEnv) -> Links:
        """Of an environment as it is, without the drives' armature and friction, and without constraints."""
        robot = env.scene["robot"]
        columns = robot.dof_columns.numpy()
        env.sim.forward()
        models = [env.sim.batch.get_model(r, None) for r in range(env.num_envs)]
        turn = env.sim.coordinates
        for model in models:
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
            model.dof_armature[columns] = model.dof_damping[columns] = model.dof_frictionloss[columns] = 0.0
            for field, carried in ({} if turn is None else turn.carried).items():
                getattr(model, f"dof_{field}")[carried.columns] = carried.own
        return cls(models=models, columns=columns, loops=robot.closed_loops, coordinates=turn)

    def feel(
        self, motion: Motion, changes: Mapping[Parameter, LinkChange] = MappingProxyType({})
    ) -> tuple[JointLoad, dict[Parameter, JointLoad]]:
        """Inertia of each joint, and the torque that the rest of the robot leaves on it; and how changes change these.

        The stiffness is left open.

        With the speeds of all degrees of freedom v = T v_d of those of the driven joints, bias b and passive torques s
        (springs, viscous and Coulomb friction of joints without drives):

            I_j = (T' M T)_jj,    f_j = I_j a_j - [T' (M a + b - s)]_j

        Args:
            changes: What a unit of effects' parameters changes of links.
        """
        shape = (*motion.qpos.shape[:2], len(self.columns))
        felt = JointLoad.empty(shape)
        changed = {key: JointLoad.empty(shape) for key in changes}
        qpos, qvel, qacc = (each.numpy() for each in self._of_joints(motion))
        own = motion.qacc[..., self.columns].numpy()
        for r, model in enumerate(self.models):
            for first in range(0, shape[0], _AT_ONCE):
                at = slice(first, first + _AT_ONCE), r
                states = LinkStates.of(model, qpos[at], qvel[at], qacc[at], self.following, *motion.course(at))
                felt.put(at, states.feel(self._carried, own[at]))
                for key, change in changes.items():
                    changed[key].put(at, states.change(change[r], self._carried, own[at]))
        return felt, changed

    def _of_joints(self, motion: Motion) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """MuJoCo's own positions (T, R, nq), speeds and accelerations (T, R, nv) of a motion."""
        turn = self.coordinates
        if turn is None:
            return motion.qpos, motion.qvel, motion.qacc
        return (
            turn.positions_of_joints(motion.qpos),
            turn.speeds_of_joints(motion.qvel),
            turn.speeds_of_joints(motion.qacc),
        )

    @cached_property
    def _direct(self) -> np.ndarray:
        """How speeds follow from the drives' where nothing else does, (nv, n)."""
        every = torch.eye(self.models[0].nv, dtype=torch.float64)
        turn = self.coordinates
        driven = every if turn is None else turn.of_driven(every, turn.columns).T
        return driven[:, self.columns].numpy()

    @cached_property
    def _carried(self) -> np.ndarray:
        """The same with joints that follow by a ratio: drives carry them, (nv, n)."""
        carrying = None if self.loops is None or self.coordinates is not None else self.loops.carrying
        return self._direct if carrying is None else carrying.T @ self._direct

    def following(self, qpos: np.ndarray) -> np.ndarray:
        """How all speeds follow from the drives' at a posture (nq,), (nv, n)."""
        return self._direct if self.loops is None else self.loops.following(qpos) @ self._direct

    def shifts(self, motion: Motion, joints: Sequence[int], by: float) -> torch.Tensor:
        """What moves when some of the driven joints move, one of each tree, (T, R, nq)."""
        result = torch.zeros_like(motion.qpos)
        model = self.models[0]
        places = model.jnt_qposadr[model.dof_jntid[self.columns[list(joints)]]]
        if self.loops is None:
            result[..., places] = by
            return result
        step, moved = np.zeros(model.nv), np.empty(model.nq)
        qpos, _, _ = self._of_joints(motion)
        for k in range(result.shape[0]):
            for r in range(result.shape[1]):
                moved[:] = qpos[k, r]
                follow = self.following(moved)
                step[:] = by * follow[:, list(joints)].sum(axis=1)
                mujoco.mj_integratePos(model, moved, step, 1.0)
                result[k, r] = torch.from_numpy(moved) - qpos[k, r]
        return result if self.coordinates is None else self.coordinates.positions_of_motors(result)
