"""The motion of the whole robot in a reference simulation, and what each joint feels along it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from pace_actuators.effects import EffectCfg, get_effect, probe_points
from pace_optim.problem import Problem

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv
    from pace_envs.articulation import Articulation

_STEP = 1e-4
"""Change of a position for a derivative [rad]."""
_STIFFNESS_EVERY = 8
"""The derivative of the torque varies slowly: it is computed at every so many control steps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Feel:
    """What each joint feels in the interval after a control step: (T, R, n) each."""

    inertia: torch.Tensor
    """Rigid-body inertia, without armature [kg m²]."""
    torque: torch.Tensor
    """Torque of gravity and of the other joints' motion [N m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferencePath:
    """A reference simulation of R recordings at T control steps."""

    position: torch.Tensor
    """(T, R, n) [rad]."""
    feel: Feel
    stiffness: torch.Tensor
    """Derivative of the torque by the joint's own position, (T, R, n) [N m/rad]."""
    model_effects: dict[tuple[str, str], Feel]
    """Change of what is felt per unit of an effect's parameter, by (effect, parameter)."""
    columns: torch.Tensor
    """The joints' degrees of freedom in the model, (n,)."""
    control_dt: float
    """[s]."""

    def typical_effort(self, armature: torch.Tensor) -> torch.Tensor:
        """RMS torque that moves each joint and holds its load, (n,) [N m].

        Args:
            armature: (n,) [kg m²].
        """
        q, dt = self.position, self.control_dt
        acceleration = (q[2:] - 2 * q[1:-1] + q[:-2]) / dt**2
        effort = (self.feel.inertia[1:] + armature) * acceleration - self.feel.torque[1:]
        return effort.square().mean(dim=(0, 1)).sqrt()

    def on_joints(self, joints: Sequence[int]) -> ReferencePath:
        """Of some of the joints, by index."""
        chosen = list(joints)
        return self._part((..., chosen), columns=self.columns[chosen])

    def select(self, recordings: Sequence[int]) -> ReferencePath:
        """Some of the recordings, by index."""
        return self._part((slice(None), list(recordings)))

    def _part(self, index: tuple, **changes: Any) -> ReferencePath:
        def part(feel: Feel) -> Feel:
            return Feel(inertia=feel.inertia[index], torque=feel.torque[index])

        return replace(
            self,
            position=self.position[index],
            feel=part(self.feel),
            stiffness=self.stiffness[index],
            model_effects={key: part(feel) for key, feel in self.model_effects.items()},
            **changes,
        )


def reference_path(problem: Problem, physical: torch.Tensor, model_effects: Sequence[str] = ()) -> ReferencePath:
    """Simulate a candidate on all recordings, and compute what each joint feels on its way.

    Args:
        problem: The problem; its own effects count too.
        physical: The candidate's physical parameters, (size,).
        model_effects: Effects on the rigid-body model whose influence is wanted.
    """
    rollout = problem.evaluator().rollout(1)
    rollout.start(physical[None], problem.dataset.sampled)
    robot, positions, velocities = rollout.robot, [], []
    for _ in rollout.simulated(rollout.duration_steps):
        positions.append(robot.data.joint_pos.clone())
        velocities.append(robot.data.joint_vel.clone())
    q, v = torch.stack(positions), torch.stack(velocities)
    middle_q, middle_v = 0.5 * (q[:-1] + q[1:]), 0.5 * (v[:-1] + v[1:])
    motion = (middle_q, middle_v, (v[1:] - v[:-1]) / problem.control_dt)
    written = _take_off(robot)
    models = _models(rollout.env)
    columns = robot.dof_columns.numpy()
    feel = _feel(models, columns, *motion)
    stiffness = _stiffness(models, columns, problem, *motion)
    changes = {}
    for name in model_effects:
        for parameter in get_effect(name).parameters:
            key = name, parameter.name
            changes[key] = _change(problem, columns, *key, written.get(key), motion, feel)
    rollout.env.close()
    return ReferencePath(
        position=q,
        feel=feel,
        stiffness=stiffness,
        model_effects=changes,
        columns=torch.as_tensor(columns),
        control_dt=problem.control_dt,
    )


def _take_off(robot: Articulation) -> dict[tuple[str, str], torch.Tensor]:
    """Take effects off the rigid bodies; what they were, (n,) by (effect, parameter)."""
    written: dict[tuple[str, str], torch.Tensor] = {}
    for actuator in robot.actuators.values():
        for effect in [] if actuator.effects is None else actuator.effects.effects:
            if not effect.overrides("write_model"):
                continue
            for parameter in effect.parameters:
                values = written.setdefault((effect.name, parameter.name), torch.zeros(robot.num_joints).double())
                values[actuator.joint_indices] = getattr(effect, parameter.name)[0]
    for effect_name, parameter_name in written:
        robot.write_effect_parameter_to_sim(effect_name, parameter_name, torch.zeros(robot.num_envs, robot.num_joints))
    return written


def _models(env: ManagerBasedEnv) -> list[mujoco.MjModel]:
    """The model of each recording's load; without armature, which the twins have of their own."""
    env.sim.forward()
    models = [env.sim.batch.get_model(r, None) for r in range(env.num_envs)]
    for model in models:
        model.dof_armature[:] = 0.0
    return models


def _feel(
    models: Sequence[mujoco.MjModel],
    columns: np.ndarray,
    q: torch.Tensor,
    v: torch.Tensor,
    a: torch.Tensor,
) -> Feel:
    """Inertia of each joint, and the torque that the rest of the robot leaves on it, -(bias_j + Σ_{k≠j} M_jk a_k)."""
    steps, count, n = q.shape
    own_block = np.ix_(columns, columns)
    inertia, torque = np.empty((steps, count, n)), np.empty((steps, count, n))
    for r, model in enumerate(models):
        data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        data.qpos[:] = model.qpos0
        addresses = model.jnt_qposadr[model.dof_jntid[columns]]
        positions, speeds, accelerations = q[:, r].numpy(), v[:, r].numpy(), a[:, r].numpy()
        for k in range(steps):
            data.qpos[addresses], data.qvel[columns] = positions[k], speeds[k]
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_fullM(model, data, mass)
            own = mass[own_block]
            diagonal = own.diagonal()
            inertia[k, r] = diagonal
            torque[k, r] = -(data.qfrc_bias[columns] + own @ accelerations[k] - diagonal * accelerations[k])
    return Feel(inertia=torch.from_numpy(inertia), torque=torch.from_numpy(torque))


def _stiffness(
    models: Sequence[mujoco.MjModel],
    columns: np.ndarray,
    problem: Problem,
    q: torch.Tensor,
    v: torch.Tensor,
    a: torch.Tensor,
) -> torch.Tensor:
    """Derivative of f_j - M_j a_j by the joint's own position, the i-th joint of each tree at once."""
    some = slice(None, None, _STIFFNESS_EVERY)
    q, v, a = q[some], v[some], a[some]
    at = _feel(models, columns, q, v, a)
    result = torch.zeros_like(q)
    names = problem.joint_names
    for i in range(max(len(tree) for tree in problem.trees)):
        moved = [names.index(tree[i]) for tree in problem.trees if i < len(tree)]
        shifted = q.clone()
        shifted[..., moved] += _STEP
        there = _feel(models, columns, shifted, v, a)
        change = (there.torque - at.torque) - (there.inertia - at.inertia) * a
        result[..., moved] = change[..., moved] / _STEP
    return result.repeat_interleave(_STIFFNESS_EVERY, dim=0)


def _change(
    problem: Problem,
    columns: np.ndarray,
    effect: str,
    parameter: str,
    written: torch.Tensor | None,
    motion: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    base: Feel,
) -> Feel:
    """What a unit of a parameter of an effect on the model changes of each joint's own feel.

    Measured between null and the values that the effect has (n,), or where it has none, a probe's.
    """
    probe = torch.full((len(problem.joint_names),), probe_points(get_effect(effect))[0][parameter], dtype=torch.float64)
    value = probe if written is None else torch.where(written == 0, probe, written)
    inertia, torque = torch.zeros_like(base.inertia), torch.zeros_like(base.torque)
    names = problem.joint_names
    changed = problem.with_effects([EffectCfg(effect=effect)])
    rollout = changed.evaluator().rollout(1)
    for i in range(max(len(tree) for tree in problem.trees)):
        moved = [names.index(tree[i]) for tree in problem.trees if i < len(tree)]
        values = torch.zeros(rollout.env.num_envs, len(names), dtype=torch.float64)
        values[:, moved] = value[moved]
        rollout.robot.write_effect_parameter_to_sim(effect, parameter, values)
        there = _feel(_models(rollout.env), columns, *motion)
        inertia[..., moved] = ((there.inertia - base.inertia) / value)[..., moved]
        torque[..., moved] = ((there.torque - base.torque) / value)[..., moved]
    rollout.env.close()
    return Feel(inertia=inertia, torque=torque)
