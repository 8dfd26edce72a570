"""The motion of the whole robot in a reference simulation, and what each joint feels along it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from pace_actuators.effects import EffectCfg, effect_cfgs, get_effect, probe_points
from pace_envs.tasks.pace import GLOBAL
from pace_optim.problem.problem import Problem
from pace_optim.recording.dataset import Dataset

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv
    from pace_optim.problem.rollout import Rollout

_STEP = 1e-4
"""Change of a position for a derivative [rad]."""
_STIFFNESS_EVERY = 8
"""The derivative of the torque varies slowly: it is computed at every so many control steps."""
_SPAN = 0.02
"""Accelerations are differences of slopes over so much time before and after [s]: measured positions have noise."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JointLoad:
    """What each joint feels in the interval after a control step: (T, R, n) each."""

    inertia: torch.Tensor
    """Rigid-body inertia, without armature [kg m²]."""
    torque: torch.Tensor
    """Torque of gravity and of the other joints' motion [N m]."""
    load: torch.Tensor
    """The same without what the other joints' accelerations do: what a robot's drives are told of their load [N m]."""

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
class ReferencePath:
    """A reference simulation of R recordings at T control steps."""

    position: torch.Tensor
    """(T, R, n) [rad]."""
    feel: JointLoad
    stiffness: torch.Tensor
    """Derivative of the torque by the joint's own position, (T, R, n) [N m/rad]."""
    model_effects: dict[tuple[str, str], JointLoad]
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
        return self.effort(armature).square().mean(dim=(0, 1)).sqrt()

    def effort(self, armature: torch.Tensor) -> torch.Tensor:
        """Torque that moves each joint and holds its load, (T', R, n) [N m]; the first and last steps are left out.

        Args:
            armature: (n,) [kg m²].
        """
        q, span = self.position, self._span
        acceleration = (q[2 * span :] - 2 * q[span:-span] + q[: -2 * span]) / (span * self.control_dt) ** 2
        inertia, torque = (each[span : span + len(acceleration)] for each in (self.feel.inertia, self.feel.torque))
        return (inertia + armature) * acceleration - torque

    def speed(self) -> torch.Tensor:
        """At the same steps, (T', R, n) [rad/s]."""
        return (self.position[2 * self._span :] - self.position[: -2 * self._span]) / (2 * self._span * self.control_dt)

    def load(self) -> torch.Tensor:
        """What the drives are told of their load at the same steps, (T', R, n) [N m]."""
        return self.feel.load[self._span : len(self.position) - self._span]

    @property
    def _span(self) -> int:
        """Steps over which differences are taken."""
        return max(1, min(round(_SPAN / self.control_dt), (len(self.position) - 1) // 2))

    def on_joints(self, joints: Sequence[int]) -> ReferencePath:
        """Of some of the joints, by index."""
        chosen = list(joints)
        return self._part((..., chosen), columns=self.columns[chosen])

    def select(self, recordings: Sequence[int]) -> ReferencePath:
        """Some of the recordings, by index."""
        return self._part((slice(None), list(recordings)))

    def at(self, step: torch.Tensor, recording: torch.Tensor) -> ReferencePath:
        """Parts of the recordings: of each (W,) those control steps (T', W); where there are none, the last one."""

        def of(values: torch.Tensor, steps: torch.Tensor) -> torch.Tensor:
            return values[steps.clamp(max=len(values) - 1), recording]

        intervals = step[:-1]
        return replace(
            self,
            position=of(self.position, step),
            feel=self.feel.map(lambda each: of(each, intervals)),
            stiffness=of(self.stiffness, intervals),
            model_effects={key: feel.map(lambda each: of(each, intervals)) for key, feel in self.model_effects.items()},
        )

    def _part(self, index: tuple, **changes: Any) -> ReferencePath:
        return replace(
            self,
            position=self.position[index],
            feel=self.feel.map(lambda each: each[index]),
            stiffness=self.stiffness[index],
            model_effects={key: feel.map(lambda each: each[index]) for key, feel in self.model_effects.items()},
            **changes,
        )


def reference_path(problem: Problem, physical: torch.Tensor, model_effects: Sequence[str] = ()) -> ReferencePath:
    """Simulate a candidate on all recordings, and compute what each joint feels on its way.

    Args:
        problem: The problem; its own effects count too.
        physical: The candidate's physical parameters, (size,).
        model_effects: Effects on the rigid-body model whose influence is wanted.
    """
    problem, values = _on_all_joints(problem, physical, model_effects)
    rollout = _begun(problem, values)
    robot, positions, velocities = rollout.robot, [], []
    for _ in rollout.simulated(rollout.duration_steps):
        positions.append(robot.data.joint_pos.clone())
        velocities.append(robot.data.joint_vel.clone())
    return _along(problem, values, model_effects, rollout, torch.stack(positions), torch.stack(velocities))


def measured_path(problem: Problem, physical: torch.Tensor, model_effects: Sequence[str] = ()) -> ReferencePath:
    """What each joint feels along the measured motion, straight between samples.

    For robots whose joints have no neighbours: what those feel depends on their position only.

    Args:
        problem: The problem, without effects.
        physical: A candidate's physical parameters, (size,); its encoder biases count.
        model_effects: Effects on the rigid-body model whose influence is wanted.
    """
    problem, values = _on_all_joints(problem, physical, model_effects)
    bias = torch.tensor([values["encoder_bias"][name] for name in problem.joint_names], dtype=torch.float64)
    rollout = _begun(problem, values)
    position = bias + _at_every_step(problem.dataset, rollout.duration_steps)
    return _along(problem, values, model_effects, rollout, position, torch.zeros_like(position))


def _begun(problem: Problem, values: dict[str, dict[str, float]]) -> Rollout:
    """One candidate at the beginning of all recordings."""
    rollout = problem.evaluator().rollout(1)
    rollout.start(problem.space.from_dict(values)[None], problem.dataset.sampled)
    return rollout


def _at_every_step(dataset: Dataset, count: int) -> torch.Tensor:
    """Measured positions at control steps, (count, R, n), straight between samples and held after the last."""
    steps, measured = np.arange(count), dataset.measured.numpy()
    result = np.empty((count, *measured.shape[1:]))
    for r in range(dataset.num_recordings):
        at = dataset.sampled[:, r].nonzero()[:, 0].numpy()
        taken = at if dataset.sample_offset is None else at + dataset.sample_offset[at, r].numpy()
        for j in range(measured.shape[2]):
            result[:, r, j] = np.interp(steps, taken, measured[at, r, j])
    return torch.from_numpy(result)


def _along(
    problem: Problem,
    values: dict[str, dict[str, float]],
    model_effects: Sequence[str],
    rollout: Rollout,
    q: torch.Tensor,
    v: torch.Tensor,
) -> ReferencePath:
    """What each joint feels along a motion, (T, R, n) [rad] and [rad/s]; closes the rollout's environment."""
    middle_q, middle_v = 0.5 * (q[:-1] + q[1:]), 0.5 * (v[:-1] + v[1:])
    motion = (middle_q, middle_v, (v[1:] - v[:-1]) / problem.control_dt)
    models = _models(rollout.env)
    columns = rollout.robot.dof_columns.numpy()
    whole = feel = _feel(models, columns, *motion)
    stiffness = _stiffness(models, columns, problem, *motion)
    changes = {}
    for name in model_effects:
        for parameter in get_effect(name).parameters:
            now = torch.tensor(list(values[f"{name}.{parameter.name}"].values()), dtype=torch.float64)
            change = _change(problem, rollout, name, parameter.name, now, motion, whole)
            feel = feel.less(change, now)  # each twin has its own part of the effect itself; its neighbours' stays
            changes[name, parameter.name] = change
    rollout.env.close()
    return ReferencePath(
        position=q,
        feel=feel,
        stiffness=stiffness,
        model_effects=changes,
        columns=torch.as_tensor(columns),
        control_dt=problem.control_dt,
    )


def _on_all_joints(
    problem: Problem, physical: torch.Tensor, effects: Sequence[str]
) -> tuple[Problem, dict[str, dict[str, float]]]:
    """The problem with these effects on all joints, and the same candidate there: null where it did not have them."""
    names, values = problem.joint_names, problem.space.to_dict(physical)
    had = {cfg.effect_class.name: cfg for cfg in effect_cfgs(problem.env_cfg.sim2real.effects)}
    for effect in effects:
        joints = had[effect].joints(names) if effect in had else []
        for parameter in get_effect(effect).parameters:
            own = values.get(key := f"{effect}.{parameter.name}", {})
            null = parameter.start if parameter.null is None else parameter.null
            values[key] = {j: own.get(j, own.get(GLOBAL, null)) if j in joints else null for j in names}
    others = [cfg for name, cfg in had.items() if name not in effects]
    return problem.with_effects([*others, *(EffectCfg(effect=effect) for effect in effects)]), values


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
) -> JointLoad:
    """Inertia of each joint, and the torque that the rest of the robot leaves on it, -(bias_j + Σ_{k≠j} M_jk a_k)."""
    steps, count, n = q.shape
    own_block = np.ix_(columns, columns)
    inertia, torque, load = (np.empty((steps, count, n)) for _ in range(3))
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
            load[k, r] = -data.qfrc_bias[columns]
            torque[k, r] = load[k, r] - (own @ accelerations[k] - diagonal * accelerations[k])
    return JointLoad(inertia=torch.from_numpy(inertia), torque=torch.from_numpy(torque), load=torch.from_numpy(load))


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
    for moved in _one_of_each_tree(problem):
        shifted = q.clone()
        shifted[..., moved] += _STEP
        there = _feel(models, columns, shifted, v, a)
        change = (there.torque - at.torque) - (there.inertia - at.inertia) * a
        result[..., moved] = change[..., moved] / _STEP
    return result.repeat_interleave(_STIFFNESS_EVERY, dim=0)


def _one_of_each_tree(problem: Problem) -> Iterator[list[int]]:
    """Joints that can be changed at once because none moves another, until all have been."""
    names = problem.joint_names
    for i in range(max(len(tree) for tree in problem.trees)):
        yield [names.index(tree[i]) for tree in problem.trees if i < len(tree)]


def _change(
    problem: Problem,
    rollout: Rollout,
    effect: str,
    parameter: str,
    now: torch.Tensor,
    motion: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    whole: JointLoad,
) -> JointLoad:
    """What a unit of a parameter of an effect on the model changes of each joint's own feel.

    Measured between what the joint has, ``now`` (n,), and null, or where it has null, a probe.
    """
    robot = rollout.robot
    probe = torch.full_like(now, probe_points(get_effect(effect))[0][parameter])
    other = torch.where(now == 0, probe, 0.0)
    result = whole.map(torch.zeros_like)
    for moved in _one_of_each_tree(problem):
        values = now.clone()
        values[moved] = other[moved]
        robot.write_effect_parameter_to_sim(effect, parameter, values.expand(robot.num_envs, -1))
        there = _feel(_models(rollout.env), robot.dof_columns.numpy(), *motion)
        for field in ("inertia", "torque", "load"):
            change = (getattr(there, field) - getattr(whole, field)) / (other - now)
            getattr(result, field)[..., moved] = change[..., moved]
    robot.write_effect_parameter_to_sim(effect, parameter, now.expand(robot.num_envs, -1))
    return result
