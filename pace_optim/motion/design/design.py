"""The search for a motion: random candidates, and the best of each tree of joints."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from pace_actuators.joint_units import JointType, units_for
from pace_envs.tasks.pace import GLOBAL, PaceCfg
from pace_optim.estimate.error_bars.uncertainty import Uncertainty
from pace_optim.estimate.error_bars.warnings import in_words
from pace_optim.motion.design.motion_check import MotionLimits
from pace_optim.motion.signals import Trajectory
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import Problem

from .information import Information, ProblemOf, expected_uncertainty, information_of, mean_log_error
from .joint_motion import JointMotion, command, rooms, within_speed

_SMALLEST_GAIN = 1e-9


@dataclass(frozen=True, kw_only=True)
class DesignCfg:
    """Settings of the search."""

    noise: float = 1e-4
    """Standard deviation of the encoder's white noise [rad]."""
    candidates: tuple[int, ...] = (20, 12, 12)
    """Motions tried in each round: the first anywhere, the following near the best so far."""
    width: tuple[float, ...] = (0.3, 0.1)
    """How near, for each round but the first: standard deviation as a share of the room."""
    reach: float = 1.0
    """Width of the range that targets may take, as a multiple of what the robot's excitation states."""
    seed: int = 0
    """Seed of the candidates."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not (np.isfinite(self.noise) and self.noise > 0):
            raise ValueError(f"The noise is {self.noise:g} rad; expected a finite number above 0. 1e-4 is usual.")
        if not 0.05 <= self.reach <= 1000:
            raise ValueError(
                f"reach is {self.reach:g}; expected 0.05 to 1000. 1 keeps to the range that PaceCfg.excitation states."
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class Design:
    """The motion that was chosen, and the expected error bars."""

    trajectory: Trajectory
    """The targets."""
    joints: tuple[JointMotion | None, ...]
    """How each joint moves; ``None`` where the unoptimised motion is kept."""
    space: ParameterSpace
    """The parameters, for labels, units and ranges."""
    joint_types: tuple[JointType, ...]
    """Whether each joint turns or slides."""
    slowed: tuple[str, ...]
    """Joints whose targets, in the motion asked for, are faster than their drives; the unoptimised motion is
    that one made slower there."""
    before: Uncertainty
    """Error bars expected of the unoptimised motion."""
    after: Uncertainty
    """Error bars expected of the chosen one."""
    criterion_asked: float
    """``mean_log_error`` of the motion asked for."""
    criterion_before: float
    """``mean_log_error`` of the unoptimised motion."""
    criterion_after: float
    """``mean_log_error`` of the chosen one."""
    noise: float
    """Standard deviation of the encoder's white noise [rad]."""
    tried: int
    """Candidates simulated."""


def optimize_motion(
    problem_of: ProblemOf,
    sim2real: PaceCfg,
    unoptimized: Trajectory,
    limits: MotionLimits,
    x: torch.Tensor,
    *,
    excitation: str,
    min_frequency: float,
    max_frequency: float,
    control_dt: float,
    duration: float | None = None,
    cfg: DesignCfg | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> Design:
    """Choose each joint's amplitude, centre, band and phases so that the expected error bars are smallest.

    Every round simulates candidates; each joint of a candidate is drawn separately. Then, one tree after another, the
    candidate that lowers the criterion most replaces the present motion, until none lowers it. That is the exchange of
    Fedorov (Theory of Optimal Experiments, 1972), with trees instead of measurements. So the result is never worse than
    the unoptimised motion: the one asked for, made smaller where its targets are faster than the drives.

    A candidate's tree counts only if all its joints keep their limits. Targets stay in the joint limits and below the
    drive's no-load speed. Simulated positions stay in the joint limits, and torques below theirs. Error bars hold near
    x: they are as good as the guess of the parameters.

    Args:
        problem_of: Makes the robot's problem from trajectories.
        unoptimized: The motion asked for, made from the same request.
        x: Where the parameters are expected to be, normalised (size,).
        min_frequency: Lower end of the widest band [Hz].
        max_frequency: Upper end of the widest band [Hz].
        duration: Of the trajectory [s]; ``None`` means the excitation's usual one.
    """
    cfg = cfg or DesignCfg()
    rng = np.random.default_rng([cfg.seed, 2])
    problem = problem_of([unoptimized])
    every_room = rooms(sim2real, limits, min_frequency, max_frequency, cfg.reach)
    report("expected error bars of the unoptimised motion")
    slower = within_speed(unoptimized, every_room, control_dt)
    asked, start = information_of(problem_of, [unoptimized, slower], limits, x)
    search = _Search(problem=problem, noise=cfg.noise, best=start, target=slower.des_dof_pos.copy())
    before = search.value
    for number, count in enumerate(cfg.candidates):
        report(f"round {number + 1} of {len(cfg.candidates)}: {count} candidates")
        trajectories, motions = [], []
        for c in range(count):
            drawn = [
                room.draw(rng) if number == 0 or joint is None else room.vary(joint, rng, cfg.width[number - 1])
                for room, joint in zip(every_room, search.joints, strict=True)
            ]
            trajectory, made = command(
                f"candidate {c}", excitation, sim2real, drawn, every_room, control_dt=control_dt, duration=duration
            )
            trajectories.append(trajectory)
            motions.append(made)
        search.exchange(information_of(problem_of, trajectories, limits, x), trajectories, motions)
    sandwiches = [start.total(), search.best.total()]
    expected = [expected_uncertainty(problem, *sandwich, cfg.noise, x) for sandwich in sandwiches]
    return Design(
        trajectory=replace(unoptimized, name=f"{unoptimized.name}_optimized", des_dof_pos=search.target),
        joints=tuple(search.joints),
        space=problem.space,
        joint_types=problem.joint_types,
        before=expected[0],
        after=expected[1],
        slowed=tuple(f.joint for f in asked.findings if f.quantity == "speed"),
        criterion_asked=mean_log_error(*asked.total(), cfg.noise, search.free),
        criterion_before=before,
        criterion_after=search.value,
        noise=cfg.noise,
        tried=sum(cfg.candidates),
    )


class _Search:
    """The best motion so far, tree by tree."""

    def __init__(self, problem: Problem, noise: float, best: Information, target: np.ndarray):
        index = {name: j for j, name in enumerate(problem.joint_names)}
        self.trees = [[index[name] for name in tree] for tree in problem.trees]
        self.names = problem.joint_names
        self.noise = noise
        self.free = (problem.space.upper > problem.space.lower).numpy()
        self.best = best
        self.target = target
        self.joints: list[JointMotion | None] = [None] * len(index)
        self.value = self._value(best)

    def exchange(
        self,
        informations: Sequence[Information],
        trajectories: Sequence[Trajectory],
        motions: Sequence[Sequence[JointMotion]],
    ) -> None:
        """Take from the candidates what lowers the criterion, one tree after another, until nothing does."""
        beyond = {k: {finding.joint for finding in each.findings} for k, each in enumerate(informations)}
        improved = True
        while improved:
            improved = False
            for t, tree in enumerate(self.trees):
                allowed = [k for k in beyond if not any(self.names[j] in beyond[k] for j in tree)]
                values = [self._value(self.best.with_tree(t, informations[k])) for k in allowed]
                if not values or min(values) >= self.value - _SMALLEST_GAIN:
                    continue
                k = allowed[int(np.argmin(values))]
                self.best, self.value, improved = self.best.with_tree(t, informations[k]), min(values), True
                self.target[:, tree] = trajectories[k].des_dof_pos[:, tree]
                for j in tree:
                    self.joints[j] = motions[k][j]

    def _value(self, information: Information) -> float:
        return mean_log_error(*information.total(), self.noise, self.free)


def design_table(design: Design) -> list[str]:
    """Expected error bars of every parameter, before and after; how each joint moves; what stays unknown.

    Returns:
        Its lines.
    """
    space = design.space
    own = [p for p in space.parameters if not p.shared]
    joints = design.trajectory.joint_names
    width = max(len(joint) for joint in [*joints, "joint"])
    titles = [f"{p.name} [{' or '.join(dict.fromkeys(p.units or (p.unit,)))}]" for p in own]
    columns = [max(len(title), 19) for title in titles]
    noise = units_for(f"{design.noise:g} rad", design.joint_types)
    lines = [
        f"expected error bars (one standard deviation) for encoder noise of {noise}: "
        f"unoptimised -> optimised, {design.tried} candidates tried",
        "  ".join(["joint".ljust(width), *(t.rjust(c) for t, c in zip(titles, columns, strict=True)), "  motion"]),
    ]
    for j, joint in enumerate(joints):
        cells = [_change(design, f"{p.name}/{joint}").rjust(c) for p, c in zip(own, columns, strict=True)]
        lines.append("  ".join([joint.ljust(width), *cells, f"  {_motion(design, j)}"]))
    lines += [f"{p.name}: {_change(design, f'{p.name}/{GLOBAL}')} {p.unit}" for p in space.parameters if p.shared]
    before, after = (100 * math.exp(v) for v in (design.criterion_before, design.criterion_after))
    lines.append(
        f"geometric mean of the error bars: {before:.3g} % -> {after:.3g} % of the bound range "
        f"({math.exp(design.criterion_before - design.criterion_after):.2f} times better)"
    )
    if design.slowed:
        lines.append(
            f"The motion asked for has targets faster than the drive on {', '.join(design.slowed)} (its error bars: "
            f"{100 * math.exp(design.criterion_asked):.3g} %); unoptimised is the same, smaller where too fast."
        )
    return lines + _unknown("unoptimised", design.before) + _unknown("optimised", design.after)


def _change(design: Design, label: str) -> str:
    i = design.space.labels.index(label)
    return " -> ".join("-" if math.isnan(u.std[i]) else f"{u.std[i]:.2g}" for u in (design.before, design.after))


def _motion(design: Design, j: int) -> str:
    motion = design.joints[j]
    if motion is None:
        return "as it was"
    place = units_for(f"{motion.centre:+.2f} ± {abs(motion.amplitude):.2f} rad", design.joint_types[j : j + 1])
    return f"{place}, {motion.min_frequency:.2g} to {motion.max_frequency:.2g} Hz"


def _unknown(which: str, uncertainty: Uncertainty) -> list[str]:
    lines = [f"{which}: the recording cannot separate {in_words(group)}." for group in uncertainty.indistinguishable]
    if uncertainty.no_influence:
        lines.append(f"{which}: no influence: {', '.join(uncertainty.no_influence)}.")
    return lines
