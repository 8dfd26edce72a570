"""What each joint feels along a motion of the whole robot: joints without drives follow through their constraints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

import mujoco
import numpy as np
import torch

from pace_envs import ManagerBasedEnv
from pace_envs.closed_loops import ClosedLoops
from pace_envs.motor_coordinates import MotorCoordinates
from pace_optim.joints.simulation.link_states import LinkChange, LinkStates
from pace_optim.recording.carried import Carried

Parameter = tuple[str, str]
"""An effect on the model, and one of its parameters."""
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

    @classmethod
    def empty(cls, shape: Sequence[int]) -> JointLoad:
        """Room for (T, R, n)."""
        inertia, torque, load = (torch.empty(*shape, dtype=torch.float64) for _ in range(3))
        return cls(inertia=inertia, torque=torque, load=load)

    def put(self, at: tuple[slice, int], felt: Sequence[np.ndarray]) -> None:
        """Write inertia, torque and load of a part."""
        for own, value in zip((self.inertia, self.torque, self.load), felt, strict=True):
            own[at] = torch.from_numpy(value)

    def map(self, change: Callable[[torch.Tensor], torch.Tensor]) -> JointLoad:
        """The same change of each."""
        return JointLoad(inertia=change(self.inertia), torque=change(self.torque), load=change(self.load))

    def less(self, other: JointLoad, times: torch.Tensor) -> JointLoad:
        """This less a multiple of another."""
        return JointLoad(
            inertia=self.inertia - times * other.inertia,
            torque=self.torque - times * other.torque,
            load=self.load - times * other.load,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadChange(JointLoad):
    """What a unit of an effect's parameter changes of what is felt."""

    stiffness: torch.Tensor
    """Of the derivative of the torque by the joint's own position, (T, R, n) [N m/rad]."""

    def map(self, change: Callable[[torch.Tensor], torch.Tensor]) -> LoadChange:
        """The same change of each."""
        return replace(self, **vars(super().map(change)), stiffness=change(self.stiffness))


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
            qpos: Positions.
            qvel: Speeds.
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

        With the speeds of all degrees of freedom v = T v_d of those of the driven joints, bias b and passive torques s
        (springs, viscous and Coulomb friction of joints without drives):

            I_j = (T' M T)_jj,    f_j = I_j a_j - [T' (M a + b - s)]_j

        Args:
            motion: Of T intervals.
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
