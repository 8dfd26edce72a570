"""The balance of torques along a recording: what its drives gave against what the model's links took.

For each joint, with everything but the delay linear:

    τ_drive(t - delay) = s τ_links + a q̈ + d q̇ + f sign(q̇) + b

τ_drive is the PD law of the stated gains on the logged commands, cut at the stated limits. τ_links is the inverse
dynamics of the model along the measured positions. Armature a and friction f are not negative. d may take back a
damping that is stated too large, b is an encoder bias, and s allows gains or masses that are wrong by a factor. All
terms are smoothed alike, which leaves the equation exact but for its non-linear terms. What remains says how well log
and model agree; nothing is simulated.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter1d

from pace_actuators.identified import DRIVE_FIELDS
from pace_actuators.joint_units import JointType
from pace_optim.problem.inverse_dynamics import LinkMotion, bounded_least_squares, frame_motion, model_of
from pace_optim.problem.moving_base import joints_of_feet
from pace_optim.problem.problem import Problem
from pace_optim.recording.carried import standing_feet

_SMOOTHING = 0.01
"""Standard deviation of the smoothing [s]; of slow recordings 1.5 samples."""
_ROWS = 1500
"""Instants at which a recording is looked at, at most."""
_FEW_ROWS = 200
"""The same of a coarse look."""
_SELDOM = 4
"""Times as many instants where joints are free at times only."""
FEWEST = 60
"""Instants without which a joint is not judged."""
_MOVING = 0.1
"""Of its RMS speed: slower joints may stick, and their friction is anything up to its largest."""
_TOUCHED = 0.01
"""Share of samples that do not count in what is smoothed: more of them, and an instant does not count."""
_FACTOR = 4.0
"""By which stated gains or the model's masses may be wrong; assumed gains by its square and more."""
_ASSUMED_FACTOR = 50.0
_DELAYS = 6
_FEW_DELAYS = 3
"""Delays that are tried; between them the torque is taken to be linear."""


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """One recording as the balance sees it: K samples of n joints, commands at G control steps."""

    name: str
    joints: tuple[str, ...]
    types: tuple[JointType, ...]
    """Whether each joint turns or slides."""
    dt: float
    """Between samples [s]."""
    control_dt: float
    """Between control steps [s]."""
    steps: np.ndarray
    """Control step of each sample, (K,)."""
    position: np.ndarray
    """(K, n) [rad]."""
    target: np.ndarray
    """(G, n) [rad]."""
    target_vel: np.ndarray
    """(G, n) [rad/s]."""
    feed_forward: np.ndarray
    """(G, n) [N m]."""
    stiffness: np.ndarray
    damping: np.ndarray
    effort_limit: np.ndarray
    saturation_effort: np.ndarray
    velocity_limit: np.ndarray
    """The drives in force, (n,) each."""
    assumed: np.ndarray
    """Whether a joint's gains are not stated, (n,) bool."""
    most_bias: np.ndarray
    """Largest encoder bias, (n,) [rad]."""
    most_delay: int
    """Largest delay [control steps]."""
    used: np.ndarray
    """Samples that count, (K,) bool."""
    model: mujoco.MjModel
    """Its links, with the recording's load."""
    gravity: np.ndarray
    """(3,) [m/s²]."""
    ranges: np.ndarray
    """The joints' ranges in the model, (n, 2) [rad]."""
    frame: np.ndarray | None = None
    """Angular velocity [rad/s] and specific force [m/s²] of a base that moves, in the model's axes, (K, 6)."""
    point: np.ndarray | None = None
    """Where that force acts, (3,) [m]."""
    free: np.ndarray | None = None
    """Where joints are free, (K, n) bool; ``None``: everywhere."""
    standing: np.ndarray | None = None
    """Which feet touch the ground, (K, feet) bool."""
    feet: tuple[tuple[str, list[int]], ...] = ()
    """Name of each foot, and the joints that the ground holds where it stands."""
    coarse: bool = False
    """Whether few instants and delays are looked at."""
    _given: dict[tuple[int, int], np.ndarray] = field(default_factory=dict, init=False, repr=False)

    @property
    def time(self) -> np.ndarray:
        """Of the samples, (K,) [s]."""
        return self.dt * np.arange(len(self.position))

    def asked(self, joint: int, delay: int = 0) -> np.ndarray:
        """Torque that a drive is asked for, (K,) [N m], with commands late by so many control steps."""
        at, position = np.maximum(self.steps - delay, 0), self.position[:, joint]
        kp, kd = self.stiffness[joint], self.damping[joint]
        commanded = kp * self.target[at, joint] + kd * self.target_vel[at, joint] + self.feed_forward[at, joint]
        return commanded - kp * position - kd * np.gradient(position, self.dt)

    def given(self, joint: int, delay: int = 0) -> np.ndarray:
        """What its stated limits leave of that, (K,) [N m]."""
        limit, stall, fastest = self.effort_limit[joint], self.saturation_effort[joint], self.velocity_limit[joint]
        torque = np.clip(self.asked(joint, delay), -limit, limit)
        if not (np.isfinite(stall) and np.isfinite(fastest)):
            return torque
        drop = stall / fastest * np.gradient(self.smooth(self.position[:, joint]), self.dt)
        return np.clip(torque, np.minimum(-stall - drop, limit), np.maximum(stall - drop, -limit))

    def smooth_given(self, joint: int, delay: int) -> np.ndarray:
        """:meth:`given`, smoothed; computed once."""
        key = joint, delay
        if key not in self._given:
            self._given[key] = self.smooth(self.given(joint, delay))
        return self._given[key]

    @property
    def width(self) -> float:
        """Standard deviation of the smoothing [samples]."""
        return max(_SMOOTHING / self.dt, 1.5)

    def smooth(self, series: np.ndarray) -> np.ndarray:
        """A series (K, …), smoothed."""
        return gaussian_filter1d(series, self.width, axis=0, mode="nearest")


def views_of(problem: Problem) -> list[View]:
    """The recordings of a problem."""
    rollout = problem.evaluator().rollout(1)
    env, robot = rollout.env, rollout.robot
    n, sim2real = robot.num_joints, problem.env_cfg.sim2real
    result = []
    for r, recording in enumerate(problem.dataset.recordings):
        drive: dict[str, Any] = {name: np.full(n, np.inf) for name in DRIVE_FIELDS}
        for actuator in robot.actuators.values():
            for name, values in drive.items():
                own = getattr(actuator, name)
                values[actuator.joint_indices] = own[min(r, len(own) - 1)].cpu().numpy()
        model = model_of(env, r)
        command = np.asarray(recording.command)
        zero = np.zeros_like(command)
        on = recording.command_torque_enable
        assumed = np.isin(problem.joint_names, list(sim2real.assumed_gains))
        view = View(
            name=recording.name,
            joints=problem.joint_names,
            types=problem.joint_types,
            dt=float(np.median(np.diff(recording.time))),
            control_dt=problem.control_dt,
            steps=recording.sample_steps,
            position=recording.dof_pos,
            target=command,
            target_vel=zero if recording.command_vel is None else recording.command_vel,
            feed_forward=zero if recording.command_effort is None else recording.command_effort,
            **drive,
            assumed=assumed & (recording.drive.stiffness is None),
            most_bias=sim2real.bounds["encoder_bias"].abs().max(dim=1).values.numpy(),
            most_delay=int(np.ceil(float(sim2real.bounds["delay"][0, 1]))),
            used=np.ones(recording.num_samples, dtype=bool) if on is None else on[recording.sample_steps],
            model=model,
            gravity=model.opt.gravity.copy(),
            ranges=robot.data.joint_pos_limits.cpu().numpy(),
            frame=None if recording.frame is None else recording.frame[recording.sample_steps],
            point=recording.frame_point,
            free=None if recording.free is None else recording.free[recording.sample_steps],
            standing=None if recording.frame is None else standing_feet(recording),
            feet=tuple(zip(recording.feet, joints_of_feet(env, recording.feet, recording.label), strict=True)),
        )
        result.append(view)
    return result


@dataclass(frozen=True, kw_only=True, eq=False)
class Links:
    """The smoothed motion of a recording, and the torques that move the model's links along it, at N instants."""

    rows: np.ndarray
    """Samples, (N,)."""
    torque: np.ndarray
    """(N, n) [N m]."""
    speed: np.ndarray
    acceleration: np.ndarray
    direction: np.ndarray
    """Sign of the speed, smoothed like all else; (N, n) each."""

    motion: LinkMotion
    _position: np.ndarray

    @classmethod
    def of(cls, view: View, before: Links | None = None) -> Links:
        """Of a recording.

        Args:
            before: Of the same recording otherwise; joints that move alike under the same gravity are looked at once.
        """
        position = view.smooth(view.position)
        speed = np.gradient(position, view.dt, axis=0)
        acceleration = np.gradient(speed, view.dt, axis=0)
        direction = view.smooth(np.sign(speed))
        edge = int(np.ceil(4 * view.width))
        first = edge + int(np.ceil(view.most_delay * view.control_dt / view.dt))
        few = _FEW_ROWS if view.coarse else _ROWS
        if view.free is not None:  # most of them do not count
            few *= _SELDOM
        every = max(1, int(view.width) if view.free is None else 1, (len(position) - first - edge) // few)
        rows = np.arange(first, len(position) - edge, every)
        if before is not None and before.is_of(view, rows):
            motion = before.motion
        else:
            model = copy.copy(view.model)
            model.opt.gravity[:] = view.gravity
            motion = LinkMotion.of(model, view.joints, position[rows], speed[rows], acceleration[rows])
        frame = None if view.frame is None else frame_motion(view.smooth(view.frame), view.dt)[rows]
        return cls(
            rows=rows,
            torque=motion.torque(frame, view.point),
            speed=speed[rows],
            acceleration=acceleration[rows],
            direction=direction[rows],
            motion=motion,
            _position=view.position,
        )

    def is_of(self, view: View, rows: np.ndarray) -> bool:
        """Whether a recording has the same motion of joints at the same instants, under the same gravity."""
        return (
            view.position is self._position
            and np.array_equal(rows, self.rows)
            and np.array_equal(view.gravity, self.motion.model.opt.gravity)
        )


@dataclass(frozen=True, kw_only=True)
class Balance:
    """How well a joint's torques balance."""

    misfit: float
    """RMS of what is left over the standard deviation of the drive's torque."""
    delay: int
    """Of the commands, the nearest that was tried [control steps]."""


def balances(view: View, links: Links, joints: Iterable[int], further: np.ndarray | None = None) -> dict[int, Balance]:
    """The balance of some joints, without those that hardly move.

    Args:
        further: Torques that may have any part in each joint's, (N, n, m) [N m].
    """
    result, counts = {}, moving(view, links)
    for j in joints:
        if counts[:, j].sum() >= FEWEST and (found := _balance(view, links, j, counts[:, j], further)) is not None:
            result[j] = found
    return result


def moving(view: View, links: Links) -> np.ndarray:
    """At which instants each joint counts: it moves, is free, and no sample nearby is left out; (N, n) bool."""
    speed = np.abs(links.speed)
    result = speed > _MOVING * np.sqrt(np.square(speed).mean(axis=0))
    result &= (view.smooth((~view.used).astype(float))[links.rows] <= _TOUCHED)[:, None]
    if view.free is not None:
        result &= view.smooth((~view.free).astype(float))[links.rows] <= _TOUCHED
    return result


def _balance(view: View, links: Links, j: int, moving: np.ndarray, further: np.ndarray | None) -> Balance | None:
    rows = links.rows[moving]
    columns = [series[moving, j] for series in (links.torque, links.acceleration, links.speed, links.direction)]
    if further is not None:
        columns += list(further[moving, j].T)
    factor = _ASSUMED_FACTOR if view.assumed[j] else _FACTOR
    bias = view.stiffness[j] * view.most_bias[j]
    delays = np.unique(np.linspace(0, view.most_delay, _FEW_DELAYS if view.coarse else _DELAYS).round().astype(int))
    between = 0.5 * max(np.diff(delays), default=1) * view.control_dt
    lower = np.array([1 / factor, 0.0, -view.damping[j], 0.0, -bias, -between])
    upper = np.array([factor, np.inf, np.inf, np.inf, bias, between])
    lower, upper = (
        np.append(each, np.full(len(columns) - 4, sign * np.inf)) for each, sign in ((lower, -1), (upper, 1))
    )
    best = None
    for delay in delays.tolist():
        given = view.smooth_given(j, delay)
        torque, slope = given[rows], (given[rows + 1] - given[rows - 1]) / (2 * view.dt)
        spread = float(np.square(torque - torque.mean()).sum())
        _, left = bounded_least_squares(
            np.column_stack([*columns[:4], np.ones(len(rows)), slope, *columns[4:]]), torque, lower, upper
        )
        if spread > 0 and (best is None or left < best[0]):
            best = left, Balance(misfit=float(np.sqrt(left / spread)), delay=delay)
    return None if best is None else best[1]


def without(view: View, where: np.ndarray) -> View:
    """A recording of which some samples, (K,) bool, do not count."""
    return replace(view, used=view.used & ~where)
