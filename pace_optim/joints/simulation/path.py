"""The motion of the whole robot in a reference simulation, and what each joint feels along it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
from scipy import fft, ndimage, optimize

from pace_actuators.effects import EffectCfg, effect_cfgs, get_effect, probe_points
from pace_envs.tasks.pace import GLOBAL
from pace_optim.joints.simulation.joint_load import JointLoad, LinkChange, Links, Motion, Parameter
from pace_optim.problem.free_phases import FreePhases
from pace_optim.problem.problem import Problem
from pace_optim.recording import Recording
from pace_optim.recording.dataset import Dataset
from pace_optim.recording.noise import noise_floor

if TYPE_CHECKING:
    from pace_optim.problem.rollout import Rollout


_SOFTEST, _STIFFEST = 1e-6, 1e24
"""Stiffness of the smoothing, between which it is sought."""


def at_every_step(dataset: Dataset, values: np.ndarray, count: int) -> torch.Tensor:
    """Values at samples, (T, R, n), at control steps, (count, R, n): straight between them, held after the last."""
    steps = np.arange(count)
    result = np.empty((count, *values.shape[1:]))
    for r in range(dataset.num_recordings):
        at = dataset.sampled[:, r].nonzero()[:, 0].numpy()
        taken = at if dataset.sample_offset is None else at + dataset.sample_offset[at, r].numpy()
        for j in range(values.shape[2]):
            result[:, r, j] = np.interp(steps, taken, values[at, r, j])
    return torch.from_numpy(result)


def beside_simulation(dataset: Dataset, shown: torch.Tensor) -> torch.Tensor:
    """How far the robot was from its simulation at control steps, without the measurement's noise, (count, R, n) [rad].

    Args:
        shown: What encoders show in the simulation where there are samples, (count, R, n) [rad].
    """
    count = len(shown)
    error = at_every_step(dataset, (dataset.measured[:count] - shown).numpy(), count)
    for r, recording in enumerate(dataset.recordings):
        dt = float(np.median(np.diff(recording.time)))
        last = int(dataset.sampled[:count, r].nonzero()[-1]) + 1
        if dataset.carried is not None:
            _smooth_phases(error[:, r], dataset.carried.free[:count, r], recording, dt)
            continue
        for j in range(error.shape[2]):
            noise = noise_floor(recording.dof_pos[:, j], dt).sigma
            each = error[:last, r, j].numpy()
            error[:last, r, j] = torch.from_numpy(_smooth(each, noise))
            error[last:, r, j] = error[last - 1, r, j]
    return error


def _smooth_phases(error: torch.Tensor, free: torch.Tensor, recording: Recording, dt: float) -> None:
    """Smooth errors (T, n) in each free phase by itself; a joint that is held is where it was measured."""
    for j in range(error.shape[1]):
        noise = noise_floor(recording.dof_pos[:, j], dt).sigma
        error[:, j] *= free[:, j]
        for (phase,) in ndimage.find_objects(ndimage.label(free[:, j].numpy())[0]):
            error[phase, j] = torch.from_numpy(_smooth(error[phase, j].numpy(), noise))


def _smooth(values: np.ndarray, noise: float) -> np.ndarray:
    """The curve of least bending that is as far from the values as their noise, (T,).

        min Σ (y - x)² + λ Σ (Δ²y)²    with λ such that the mean of (y - x)² is σ²

    What drives a joint beside its model is torque, which is integrated twice: of such errors, hidden in white noise,
    this is the best estimate (Whittaker's graduation, a discrete smoothing spline). Solved in cosines.
    """
    waves = fft.dct(values, norm="ortho")
    bending = (2 - 2 * np.cos(np.pi * np.arange(len(values)) / len(values))) ** 2

    def left(stiffness: float) -> float:
        return float(np.mean((waves * (1 - 1 / (1 + stiffness * bending))) ** 2)) - noise**2

    if left(_STIFFEST) <= 0:
        stiffness = _STIFFEST
    elif left(_SOFTEST) >= 0:
        return values
    else:
        low, high = np.log(_SOFTEST), np.log(_STIFFEST)
        stiffness = float(np.exp(optimize.brentq(lambda x: left(np.exp(x)), low, high, xtol=0.01)))
    return fft.idct(waves / (1 + stiffness * bending), norm="ortho")


_STEP = 1e-4
"""Change of a position for a derivative [rad]."""
_STIFFNESS_EVERY = 8
"""The derivative of the torque varies slowly: it is computed at every so many control steps."""
_SPAN = 0.02
"""Accelerations are differences of slopes over so much time before and after [s]: measured positions have noise."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferencePath:
    """A reference simulation of R recordings at T control steps."""

    position: torch.Tensor
    """(T, R, n) [rad]."""
    feel: JointLoad
    model_effects: dict[Parameter, JointLoad]
    """Change of what is felt per unit of an effect's parameter, by (effect, parameter)."""
    columns: torch.Tensor
    """The joints' degrees of freedom in the model, (n,)."""
    names: tuple[str, ...]
    """The joints; motors that move several of the model's are among them."""
    control_dt: float
    """[s]."""
    rest_inertia: torch.Tensor
    """Inertia without armature that each joint shows in the model's own posture, all others free, (R, n) [kg m²]."""
    phases: FreePhases | None = None
    """What is not known of the free phases of each joint; ``None`` where all bases rest."""

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
        """The load that the drives get at the same steps, (T', R, n) [N m]."""
        return self.feel.load[self._span : len(self.position) - self._span]

    @property
    def _span(self) -> int:
        """Steps over which differences are taken."""
        return max(1, min(round(_SPAN / self.control_dt), (len(self.position) - 1) // 2))

    def on_joints(self, joints: Sequence[int]) -> ReferencePath:
        """Of some of the joints, by index."""
        chosen = list(joints)
        phases = None if self.phases is None else self.phases.on_joints(chosen)
        return self._part(
            (..., chosen),
            rest_inertia=self.rest_inertia[:, chosen],
            columns=self.columns[chosen],
            names=tuple(self.names[j] for j in chosen),
            phases=phases,
        )

    def select(self, recordings: Sequence[int]) -> ReferencePath:
        """Some of the recordings, by index."""
        phases = None if self.phases is None else self.phases.select(recordings)
        rest = self.rest_inertia[list(recordings)]
        return self._part((slice(None), list(recordings)), rest_inertia=rest, phases=phases)

    def at(self, step: torch.Tensor, recording: torch.Tensor) -> ReferencePath:
        """Parts of the recordings: of each (W,) those control steps (T', W); without any, the last one."""

        def of(values: torch.Tensor, steps: torch.Tensor) -> torch.Tensor:
            return values[steps.clamp(max=len(values) - 1), recording]

        intervals = step[:-1]
        return replace(
            self,
            rest_inertia=self.rest_inertia[recording],
            position=of(self.position, step),
            feel=self.feel.map(lambda each: of(each, intervals)),
            model_effects={key: feel.map(lambda each: of(each, intervals)) for key, feel in self.model_effects.items()},
        )

    def _part(self, index: tuple, **changes: Any) -> ReferencePath:
        return replace(
            self,
            position=self.position[index],
            feel=self.feel.map(lambda each: each[index]),
            model_effects={key: feel.map(lambda each: each[index]) for key, feel in self.model_effects.items()},
            **changes,
        )


def reference_path(
    problem: Problem,
    physical: torch.Tensor,
    model_effects: Sequence[str] = (),
    late: torch.Tensor | None = None,
    away: float = math.inf,
) -> ReferencePath:
    """Simulate a candidate on all recordings, and compute what each joint feels on its way.

    Where the robot was measured elsewhere, joints that have neighbours are taken there: what a joint's neighbours do to
    it is what they did, not what the candidate lets them do.

    Args:
        model_effects: Effects on the rigid-body model whose influence is wanted.
        late: Joints that are not taken there, (n,) bool: it may be their log that is late. ``None``: no joint.
        away: Nor are those that are further from it than this, RMS over a recording [rad]: gravity is not linear in
            between.
    """
    problem, values = _on_all_joints(problem, physical, model_effects)
    rollout = _begun(problem, values)
    shown, positions, speeds = rollout.motion(rollout.duration_steps)
    if problem.joints_stand_alone:
        return _along(problem, values, model_effects, rollout, positions, speeds)
    beside = beside_simulation(problem.dataset, shown - _biases(problem, values))
    carried, share = problem.dataset.carried, torch.ones(())
    if carried is not None:  # the part of the time in which each joint is free, (R, n)
        share = carried.free[: len(beside)].double().mean(dim=0).clamp(min=1e-9)
    beside *= (beside.square().mean(dim=0, keepdim=True) / share).sqrt() <= away
    if late is not None:
        beside[..., late] = 0.0
    moved = _taken(rollout, positions, speeds, beside, problem.control_dt)
    return _along(problem, values, model_effects, rollout, *moved)


def measured_path(problem: Problem, physical: torch.Tensor, model_effects: Sequence[str] = ()) -> ReferencePath:
    """What each joint feels along the measured motion, straight between samples.

    For robots whose joints have no neighbours, and all have drives: what those feel depends on their position only.

    Args:
        problem: The problem, without effects.
        physical: A candidate's physical parameters, (size,); its encoder biases count.
        model_effects: Effects on the rigid-body model whose influence is wanted.
    """
    problem, values = _on_all_joints(problem, physical, model_effects)
    rollout = _begun(problem, values)
    sim, steps = rollout.env.sim, rollout.duration_steps
    positions, speeds = sim.qpos.repeat(steps, 1, 1), torch.zeros(steps, *sim.qvel.shape, dtype=torch.float64)
    positions[..., rollout.robot.qpos_columns] = _biases(problem, values) + at_every_step(
        problem.dataset, problem.dataset.measured.numpy(), steps
    )
    return _along(problem, values, model_effects, rollout, positions, speeds)


def _biases(problem: Problem, values: dict[str, dict[str, float]]) -> torch.Tensor:
    """Encoder biases of a candidate, (n,) [rad]."""
    return torch.tensor([values["encoder_bias"][name] for name in problem.joint_names], dtype=torch.float64)


def _taken(
    rollout: Rollout, positions: torch.Tensor, speeds: torch.Tensor, beside: torch.Tensor, dt: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """A motion with its driven joints moved by (T, R, n) [rad]; those without drives follow."""
    robot = rollout.robot
    faster = torch.gradient(beside, spacing=dt, dim=0)[0]
    if (carried := rollout.dataset.carried) is not None:
        faster = _within_phases(beside, faster, carried.free[: len(beside)], dt)
    if robot.closed_loops is None:
        positions[..., robot.qpos_columns] += beside
        speeds[..., robot.dof_columns] += faster
        return positions, speeds
    model, turn, links = rollout.env.sim.model, rollout.env.sim.coordinates, Links.of(rollout.env)
    if turn is not None:
        positions, speeds = turn.positions_of_joints(positions), turn.speeds_of_joints(speeds)
    moved = np.empty(positions.shape[-1])
    for k, r in np.ndindex(positions.shape[:2]):
        moved[:] = positions[k, r]
        follow = links.following(moved)
        mujoco.mj_integratePos(model, moved, follow @ beside[k, r].numpy(), 1.0)
        positions[k, r] = torch.from_numpy(moved)
        speeds[k, r] += torch.from_numpy(follow @ faster[k, r].numpy())
    return (positions, speeds) if turn is None else (turn.positions_of_motors(positions), turn.speeds_of_motors(speeds))


def _begun(problem: Problem, values: dict[str, dict[str, float]]) -> Rollout:
    """One candidate at the beginning of all recordings."""
    rollout = problem.evaluator().rollout(1)
    rollout.start(_vector(problem, values)[None], problem.dataset.sampled)
    return rollout


def _vector(problem: Problem, values: dict[str, dict[str, float]]) -> torch.Tensor:
    """A candidate, physical (size,), without what means nothing on slides."""
    return problem.space.from_dict({p.name: {k: values[p.name][k] for k in p.keys} for p in problem.space.parameters})


def _along(
    problem: Problem,
    values: dict[str, dict[str, float]],
    model_effects: Sequence[str],
    rollout: Rollout,
    positions: torch.Tensor,
    speeds: torch.Tensor,
) -> ReferencePath:
    """What each joint feels along a motion of all, (T, R, nq) and (T, R, nv); closes the rollout's environment."""
    carried = problem.dataset.carried
    motion = Motion.between(positions, speeds, problem.control_dt, carried, problem.loop_dt)
    phases = None
    if carried is not None:
        phases = problem.evaluator().free_phases(_vector(problem, values)).of_single_joints()
    now = {
        (name, parameter.name): torch.tensor([*values[f"{name}.{parameter.name}"].values()], dtype=torch.float64)
        for name in model_effects
        for parameter in get_effect(name).parameters
    }
    links, changes = Links.of(rollout.env), {key: _link_change(rollout, *key, own) for key, own in now.items()}
    feel, felt = links.feel(motion, changes)
    _add_stiffness(problem, links, motion, feel, felt, changes)
    for key, has in now.items():  # each twin has its own part of an effect itself; its neighbours' stays
        feel = feel.less(felt[key], has)
    columns, sim = rollout.robot.dof_columns, rollout.env.sim
    rest_inertia = 1 / sim.friction_weights(columns) - sim.expand("dof_armature")[:, columns]
    rollout.env.close()
    return ReferencePath(
        position=positions[..., rollout.robot.qpos_columns],
        feel=feel,
        model_effects=felt,
        columns=columns,
        rest_inertia=rest_inertia,
        names=tuple(rollout.robot.joint_names),
        control_dt=problem.control_dt,
        phases=phases,
    )


def _within_phases(values: torch.Tensor, slope: torch.Tensor, free: torch.Tensor, dt: float) -> torch.Tensor:
    """Slopes of values (T, R, n) without what jumps where a free phase begins or ends."""
    ahead = torch.zeros_like(values)
    ahead[:-1] = (values[1:] - values[:-1]) / dt
    begins, ends = torch.ones_like(free), torch.ones_like(free)
    begins[1:], ends[:-1] = ~free[:-1], ~free[1:]
    behind = torch.cat([torch.zeros_like(ahead[:1]), ahead[:-1]])
    result = torch.where(ends, behind, torch.where(begins, ahead, slope))
    return result * (free & ~(begins & ends))


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


def _add_stiffness(
    problem: Problem,
    links: Links,
    motion: Motion,
    feel: JointLoad,
    felt: Mapping[Parameter, JointLoad],
    changes: Mapping[Parameter, LinkChange],
) -> None:
    """Write the derivative of f_j - M_j a_j by each joint's own position, and how changes change it."""
    steps, motion = len(motion.qpos), motion.every(_STIFFNESS_EVERY)
    for moved in _one_of_each_tree(problem):
        there, others = links.feel(motion.moved(links.shifts(motion, moved, _STEP)), changes)
        for here, each in ((feel, there), *((felt[key], others[key]) for key in changes)):
            before = here.map(lambda own: own[::_STIFFNESS_EVERY])
            change = each.torque - before.torque - (each.inertia - before.inertia) * motion.qacc[..., links.columns]
            change = (change[..., moved] / _STEP).repeat_interleave(_STIFFNESS_EVERY, dim=0)
            here.stiffness[..., moved] = change[:steps]


def _one_of_each_tree(problem: Problem) -> Iterator[list[int]]:
    """Joints that can be changed at once because none moves another, until all have been."""
    names = problem.joint_names
    for i in range(max(len(tree) for tree in problem.trees)):
        yield [names.index(tree[i]) for tree in problem.trees if i < len(tree)]


def _link_change(rollout: Rollout, effect: str, parameter: str, now: torch.Tensor) -> LinkChange:
    """What a unit of a parameter of an effect on the model changes of the links that joints carry.

    Measured between what each joint has, ``now`` (n,), and null, or where it has null, a probe.
    """
    robot = rollout.robot
    probe = torch.full_like(now, probe_points(get_effect(effect))[0][parameter])
    other = torch.where(now == 0, probe, 0.0)
    here = robot.pseudo_inertias()
    robot.write_effect_parameter_to_sim(effect, parameter, other.expand(robot.num_envs, -1))
    there = robot.pseudo_inertias()
    robot.write_effect_parameter_to_sim(effect, parameter, now.expand(robot.num_envs, -1))
    by = (other - now).tolist()
    return [{at: ((there[at][r] - here[at][r]) / by[at[1]]).numpy() for at in here} for r in range(robot.num_envs)]
