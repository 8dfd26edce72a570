"""What each joint feels along a motion of the whole robot: joints without drives follow through their constraints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch

from pace_envs import ManagerBasedEnv
from pace_envs.closed_loops import ClosedLoops
from pace_envs.motor_coordinates import MotorCoordinates
from pace_envs.moving_frame import FrameState, bias_in_frame
from pace_optim.recording.moving_base import Carried


@dataclass(frozen=True, kw_only=True, eq=False)
class JointLoad:
    """What each joint feels in the interval after a control step: (T, R, n) each."""

    inertia: torch.Tensor
    """Rigid-body inertia, without armature [kg m²]."""
    torque: torch.Tensor
    """Torque of gravity, of springs, and of the other joints' motion [N m]."""
    load: torch.Tensor
    """The same without what the other joints' accelerations do: the load that a robot's drives get [N m]."""

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
        """Of an environment as it is, without the drives' armature and viscous friction."""
        robot = env.scene["robot"]
        columns = robot.dof_columns.numpy()
        env.sim.forward()
        models = [env.sim.batch.get_model(r, None) for r in range(env.num_envs)]
        turn = env.sim.coordinates
        for model in models:
            model.dof_armature[columns] = model.dof_damping[columns] = 0.0
            for field, carried in ({} if turn is None else turn.carried).items():
                getattr(model, f"dof_{field}")[carried.columns] = carried.own
        return cls(models=models, columns=columns, loops=robot.closed_loops, coordinates=env.sim.coordinates)

    def feel(self, motion: Motion) -> JointLoad:
        """Inertia of each joint, and the torque that the rest of the robot leaves on it.

        With the speeds of all degrees of freedom v = T v_d of those of the driven joints, bias b and passive torques s
        (springs, viscous and Coulomb friction of joints without drives):

            I_j = (T' M T)_jj,    f_j = I_j a_j - [T' (M a + b - s)]_j
        """
        shape = (*motion.qpos.shape[:2], len(self.columns))
        inertia, torque, load = (np.empty(shape) for _ in range(3))
        qpos, qvel, qacc = (each.numpy() for each in self._of_joints(motion))
        for r, model in enumerate(self.models):
            data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
            carried, friction = self._carried(model, motion, r), model.dof_frictionloss.copy()
            friction[self.columns] = 0.0
            for k in range(shape[0]):
                data.qpos[:], data.qvel[:] = qpos[k, r], qvel[k, r]
                mujoco.mj_fwdPosition(model, data)
                mujoco.mj_fwdVelocity(model, data)
                mujoco.mj_fullM(model, data, mass)
                bias = data.qfrc_bias if carried is None else carried[k]
                missing = mass @ qacc[k, r] + bias - data.qfrc_passive + friction * np.sign(qvel[k, r])
                load[k, r] = -self._efforts(bias)[self.columns]
                if (follow := self.following(data.qpos)) is None:
                    inertia[k, r], missing = mass.diagonal()[self.columns], missing[self.columns]
                else:
                    inertia[k, r], missing = np.einsum("ij,ik,kj->j", follow, mass, follow), follow.T @ missing
                torque[k, r] = inertia[k, r] * motion.qacc[k, r, self.columns].numpy() - missing
        return JointLoad(
            inertia=torch.from_numpy(inertia), torque=torch.from_numpy(torque), load=torch.from_numpy(load)
        )

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

    def _efforts(self, bias: np.ndarray) -> np.ndarray:
        """Torques (nv,) in the columns of motors, of MuJoCo's."""
        return bias if self.coordinates is None else self.coordinates.efforts_of_motors(torch.from_numpy(bias)).numpy()

    def following(self, qpos: np.ndarray) -> np.ndarray | None:
        """How all speeds follow from the drives' at a posture (nq,), (nv, n); ``None``: each is its joint's."""
        if self.loops is None and self.coordinates is None:
            return None
        every = np.eye(self.models[0].nv) if self.loops is None else self.loops.following(qpos)
        if self.coordinates is None:
            return every[:, self.columns]
        driven = self.coordinates.of_driven(torch.eye(len(every), dtype=torch.float64), self.coordinates.columns)
        return (every @ driven.numpy().T)[:, self.columns]

    def _carried(self, model: mujoco.MjModel, motion: Motion, r: int) -> np.ndarray | None:
        """Forces of a recording's motion in the frame of a base that moves, (T, nv); ``None`` where it rests."""
        if motion.frame is None or motion.point is None:
            return None
        count, data = len(motion.qpos), mujoco.MjData(model)
        state = FrameState.empty(model, count)
        qpos, qvel, _ = self._of_joints(motion)
        for k in range(count):
            data.qpos[:], data.qvel[:] = qpos[k, r].numpy(), qvel[k, r].numpy()
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            state.keep(k, data)
        return bias_in_frame(model, state, motion.frame[:, r].numpy(), motion.point[r].numpy())

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
                assert follow is not None  # there are loops
                step[:] = by * follow[:, list(joints)].sum(axis=1)
                mujoco.mj_integratePos(model, moved, step, 1.0)
                result[k, r] = torch.from_numpy(moved) - qpos[k, r]
        return result if self.coordinates is None else self.coordinates.positions_of_motors(result)
