"""From commands and a truth to recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pace_optim.recording import Drive, Recording

from .dynamics import Dynamics, _overriders
from .hidden import HiddenEffect, effect_named
from .rigid_body import ModelChange, RigidBody
from .robot import DRIVE_FIELDS, PlantRobot
from .state import Drives
from .truth import PlantCfg, Run, Truth, per_joint


def simulate_runs(robot: PlantRobot, runs: Sequence[Run], truth: Truth, cfg: PlantCfg | None = None) -> list[Recording]:
    """Make recordings of a robot with hidden effects, all side by side.

    At every control instant the encoder is read, that instant's target is issued, the controller computes, and its
    torque holds until the next, except that a late target acts when it arrives. The robot starts at rest with its
    encoder at the first target.

    Args:
        runs: Commands, gains and loads of each recording; commands of the same length.
        cfg: How the plant is stepped and measured.
    """
    return simulate_truths(robot, runs, [truth], cfg)[0]


def simulate_truths(
    robot: PlantRobot, runs: Sequence[Run], truths: Sequence[Truth], cfg: PlantCfg | None = None
) -> list[list[Recording]]:
    """The same for several truths with the same effects, delay mode and noise; indexed by truth, then by run."""
    return [[motion.recording for motion in motions] for motions in simulate_motions(robot, runs, truths, cfg)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """A recording, and what no encoder sees."""

    recording: Recording
    """What is written."""
    position: np.ndarray
    """Where the encoder's side of each joint is, (T, n) [rad]."""
    torque: np.ndarray
    """The motors' torque at the end of each control step, (T, n) [N m]."""


def simulate_motions(
    robot: PlantRobot, runs: Sequence[Run], truths: Sequence[Truth], cfg: PlantCfg | None = None
) -> list[list[Motion]]:
    """The same with positions and torques, indexed by truth, then by run."""
    cfg = cfg or PlantCfg()
    _check(robot, runs, truths)
    logged, seen, torque, drives = _Session(robot, runs, truths, cfg).run()
    time = np.arange(len(runs[0].command)) * cfg.control_dt
    result = []
    for i, _ in enumerate(truths):
        rows = range(i * len(runs), (i + 1) * len(runs))
        result.append(
            [
                Motion(
                    recording=Recording(
                        name=run.name,
                        joint_names=robot.joint_names,
                        time=time,
                        dof_pos=np.ascontiguousarray(logged[:, row]),
                        des_dof_pos=run.command,
                        drive=Drive(**{field: drives[field][row].copy() for field in DRIVE_FIELDS}),
                        load=run.load,
                    ),
                    position=seen[:, row],
                    torque=torque[:, row],
                )
                for row, run in zip(rows, runs, strict=True)
            ]
        )
    return result


def _check(robot: PlantRobot, runs: Sequence[Run], truths: Sequence[Truth]) -> None:
    if not runs or not truths:
        raise ValueError(f"There are {len(runs)} runs and {len(truths)} truths; expected at least one of each.")
    shape = (len(runs[0].command), robot.num_joints)
    for run in runs:
        if run.command.shape != shape or shape[0] < 2:
            raise ValueError(f"The command of {run.name!r} has shape {run.command.shape}; expected {shape}.")
    first = truths[0]
    for truth in truths:
        if set(truth.effects) != set(first.effects) or truth.delay_mode != first.delay_mode:
            raise ValueError("Truths that are simulated together must have the same effects and delay mode.")


@dataclass(eq=False)
class _Session:
    """Rows: truth by truth, run by run."""

    robot: PlantRobot
    runs: Sequence[Run]
    truths: Sequence[Truth]
    cfg: PlantCfg

    def run(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Logged and true positions [rad], torques [N m], each (T, R, n); stated gains and limits, {field: (R, n)}."""
        stated = self._stated_drive()
        drives = self._drives(stated)
        effects = self._effects()
        for effect in effects:
            effect.prepare(drives)
        loads = [run.load for _ in self.truths for run in self.runs]
        body = RigidBody(self.robot, loads, drives.model)
        logged, seen, torque = self._play(drives, body, effects)
        return logged, seen, torque, stated

    def _play(
        self, drives: Drives, body: RigidBody, effects: list[HiddenEffect]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        cfg, dt = self.cfg, self.cfg.control_dt
        issued = np.concatenate([np.stack([run.command for run in self.runs], axis=1)] * len(self.truths), axis=1)
        steps, rows, n = issued.shape
        substeps = math.ceil(dt / cfg.step - 1e-9)
        h = dt / substeps
        beyond = math.ceil(max(0.0, float(drives.log_skew.max())) * steps) + 2  # the log's clock may run ahead
        noise = self._noise(steps + beyond, n)
        stages = _overriders(effects)
        targets = np.empty((steps + beyond, rows, n))
        seen, speed, applied = np.empty_like(targets), np.empty_like(targets), np.empty_like(targets)
        arriving = LateSignal(drives.command_delay / h) if drives.command_delay.any() else None
        leaving = LateSignal(drives.effort_delay / h) if drives.effort_delay.any() else None

        dynamics = Dynamics(drives, body, effects, self._start(stages["measure"], issued[0] + drives.encoder_bias))
        for k in range(steps + beyond):
            position, rate = dynamics.encoder_side()
            for effect in stages["measure"]:
                position, rate = effect.measure(position, rate)
            seen[k], speed[k] = position, rate
            reading = self._quantised(position - drives.encoder_bias + noise[k])

            target = issued[min(k, steps - 1)]
            for effect in stages["command"]:
                target = effect.command(target, dt)
            targets[k] = target
            error = delayed(targets, k, drives.command_delay / dt) - reading
            for effect in stages["speed_feedback"]:
                rate = effect.speed_feedback(rate, dt)
            torque = drives.stiffness * error - drives.damping * rate
            plain = torque
            for effect in stages["controller"]:
                torque = effect.controller(torque, error, dt)
            rest = torque - plain - drives.stiffness * reading - drives.damping * rate
            for _ in range(substeps):
                if arriving is not None:
                    torque = drives.stiffness * arriving(target) + rest
                dynamics.step(torque if leaving is None else leaving(torque), h)
            applied[k] = dynamics.state.torque
            if k % 100 == 0:
                self._check_finite(dynamics.q, k)
        self._check_finite(dynamics.q, steps)
        return self._log(seen, speed, drives, noise, steps), seen[:steps], applied[:steps]

    def _log(self, seen: np.ndarray, speed: np.ndarray, drives: Drives, noise: np.ndarray, steps: int) -> np.ndarray:
        """What is written: positions at the instants of the log's clock, with the loop's noise, (T, R, n)."""
        dt = self.cfg.control_dt
        if not drives.log_delay.any() and not drives.log_skew.any():
            position = seen[:steps]
        else:
            k = np.arange(steps)[:, None, None]
            at = k * (1 + drives.log_skew) - drives.log_delay / dt
            position = _hermite(seen, speed, np.maximum(at, 0.0), dt)
        return self._quantised(position - drives.encoder_bias + noise[:steps])

    def _stated_drive(self) -> dict[str, np.ndarray]:
        stated = {}
        for field in DRIVE_FIELDS:
            rows = [
                self.robot.drive[field]
                if getattr(run.drive, field) is None
                else np.broadcast_to(np.asarray(getattr(run.drive, field), dtype=float), (self.robot.num_joints,))
                for run in self.runs
            ]
            stated[field] = np.tile(np.stack(rows), (len(self.truths), 1))
        return stated

    def _drives(self, stated: dict[str, np.ndarray]) -> Drives:
        names, count = self.robot.joint_names, len(self.runs)
        rows = count * len(self.truths)
        zeros = np.zeros((rows, len(names)))

        def rows_of(field: str, default: float = 0.0) -> np.ndarray:
            values = [per_joint(getattr(truth.base, field), names, default, field) for truth in self.truths]
            return np.repeat(np.stack(values), count, axis=0)

        delay = np.repeat([truth.base.delay for truth in self.truths], count)[:, None] + zeros
        mode = self.truths[0].delay_mode
        return Drives(
            stiffness=stated["stiffness"],
            damping=stated["damping"],
            saturation_effort=stated["saturation_effort"],
            effort_limit=stated["effort_limit"],
            velocity_limit=stated["velocity_limit"],
            armature=rows_of("armature"),
            viscous_friction=rows_of("viscous_friction"),
            friction=rows_of("friction"),
            encoder_bias=rows_of("encoder_bias"),
            delay_mode=mode,
            command_delay=delay if mode == "command" else zeros,
            effort_delay=delay if mode == "effort" else zeros,
            log_delay=zeros,
            log_skew=zeros,
            session_start=np.tile([run.session_start for run in self.runs], len(self.truths))[:, None],
            rng=np.random.default_rng([self.cfg.seed, 2]),
            model=ModelChange(mass_factor=zeros + 1.0, com_angle=zeros),
        )

    def _effects(self) -> list[HiddenEffect]:
        names, count = self.robot.joint_names, len(self.runs)
        effects = []
        for effect_name in self.truths[0].effects:
            kind = effect_named(effect_name)
            values = {}
            for parameter, draw in kind.draws.items():
                rows = []
                for truth in self.truths:
                    given = truth.effects[effect_name]
                    if set(given) != set(kind.draws):
                        raise ValueError(
                            f"{effect_name} is given {', '.join(given)}; expected {', '.join(kind.draws)}."
                        )
                    rows.append(per_joint(given[parameter], names, draw.null, f"{effect_name}.{parameter}"))
                values[parameter] = np.repeat(np.stack(rows), count, axis=0)
            effects.append(kind(values))
        return effects

    def _start(self, measures: list[HiddenEffect], wanted: np.ndarray) -> np.ndarray:
        """The position whose reading is the first target."""
        position = wanted.copy()
        for _ in range(20):
            shown, _ = position, position
            for effect in measures:
                shown, _ = effect.measure(shown, np.zeros_like(shown))
            position = position + (wanted - shown)
        return position

    def _noise(self, steps: int, n: int) -> np.ndarray:
        """The same for every truth; the runs are independent."""
        streams = [
            np.random.default_rng([self.cfg.seed, 1, r]).normal(0.0, self.cfg.noise, (steps, n))
            if self.cfg.noise
            else np.zeros((steps, n))
            for r in range(len(self.runs))
        ]
        return np.tile(np.stack(streams, axis=1), (1, len(self.truths), 1))

    def _quantised(self, reading: np.ndarray) -> np.ndarray:
        if self.cfg.counts_per_turn is None:
            return reading
        width = 2 * np.pi / self.cfg.counts_per_turn
        return np.round(reading / width) * width

    def _check_finite(self, q: np.ndarray, k: int) -> None:
        if not np.all(np.isfinite(q)) or np.abs(q).max() > 100.0:
            row = int(np.argmax(np.where(np.isfinite(q), np.abs(q), np.inf).max(axis=1)))
            run = self.runs[row % len(self.runs)].name
            raise ValueError(
                f"The plant diverges in {run!r} at {k * self.cfg.control_dt:.2f} s. Give it less delay, more damping "
                "or lower gains."
            )


class LateSignal:
    """A signal that is constant over each integration step, late: its mean over every step, of what began before it."""

    def __init__(self, delay: np.ndarray):
        """Delays in integration steps, (R, n)."""
        whole = np.floor(delay + 1e-9).astype(int)
        self._part = np.maximum(delay - whole, 0.0)
        self._length = int(whole.max()) + 2
        now = np.arange(self._length)[:, None, None]
        self._places = _flat((now - whole) % self._length)
        """Where what arrives is in the ring, by where the newest value is."""
        self._ring: np.ndarray | None = None
        self._now = -1

    def __call__(self, value: np.ndarray) -> np.ndarray:
        """What arrives in the step in which the value is sent; the first value holds before the start."""
        if self._ring is None:
            self._ring = np.repeat(value[None], self._length, axis=0)
        self._now = now = (self._now + 1) % self._length
        self._ring[now] = value
        late = self._ring.take(self._places[now])
        return late + self._part * (self._ring.take(self._places[now - 1]) - late)


def delayed(history: np.ndarray, k: int, delay: np.ndarray) -> np.ndarray:
    """History at instant k - delay [control steps], linear between instants; the first value before the start."""
    if not delay.any():
        return history[k]
    whole = np.floor(delay).astype(int)
    part = delay - whole
    near, far = np.maximum(k - whole, 0), np.maximum(k - whole - 1, 0)
    return (1 - part) * history.take(_flat(near)) + part * history.take(_flat(far))


def _flat(rows: np.ndarray) -> np.ndarray:
    """Places in a history (T, R, n) of its entries at separate rows (..., R, n)."""
    shape = rows.shape[-2:]
    return rows * (shape[0] * shape[1]) + np.arange(shape[0] * shape[1]).reshape(shape)


def _hermite(value: np.ndarray, slope: np.ndarray, at: np.ndarray, dt: float) -> np.ndarray:
    """Values between samples by the cubic that has their values and slopes; ``at`` counts samples, (T, R, n)."""
    left = np.clip(np.floor(at).astype(int), 0, len(value) - 2)
    s = np.clip(at - left, 0.0, 1.0)
    p0, p1 = np.take_along_axis(value, left, axis=0), np.take_along_axis(value, left + 1, axis=0)
    m0, m1 = np.take_along_axis(slope, left, axis=0) * dt, np.take_along_axis(slope, left + 1, axis=0) * dt
    return (1 + 2 * s) * (1 - s) ** 2 * p0 + s * (1 - s) ** 2 * m0 + s**2 * (3 - 2 * s) * p1 + s**2 * (s - 1) * m1
