"""Recordings of one drive on a pendulum, by an integrator of its own: 0.1 ms steps, commands held and late."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

CONTROL_DT, STEP = 0.0025, 1e-4
_GRAVITY = 9.81


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What is true of a drive; the recording states ``stated`` in place of its gains and limits."""

    kp: float = 40.0
    kd: float = 1.0
    armature: float = 0.05
    viscous: float = 0.5
    coulomb: float = 0.3
    bias: float = 0.01
    delay: float = 0.005
    motor_gain: float = 1.0
    current_limit: float = math.inf
    load_mass: float = 1.0
    load_length: float = 0.2
    noise: float = 1e-4
    drive_dt: float = CONTROL_DT
    off_viscous: float | None = None
    """Viscous friction while the drive is switched off; ``None``: the same."""
    stated: dict[str, float] = field(default_factory=dict)


def chirp(seconds: float, amplitude: float = 0.5, top: float = 6.0) -> np.ndarray:
    """A rising sine about 0.3 rad at the control instants."""
    t = np.arange(round(seconds / CONTROL_DT)) * CONTROL_DT
    return 0.3 + amplitude * np.sin(2 * np.pi * (0.2 * t + 0.5 * (top - 0.2) / seconds * t**2))


def record(
    path: Path, bench: Bench, position=None, velocity=None, effort=None, *, enabled=None, sensor=None, seed: int = 0
) -> Path:
    """Write a CSV of the drive that follows commands (T,) [rad], [rad/s], [N m], and the JSON of what is stated.

    ``sensor`` makes what a log has of the motor's torques (T,) [N m].
    """
    given = {"des_dof_pos": position, "des_dof_vel": velocity, "des_dof_effort": effort}
    commands = {name: values for name, values in given.items() if values is not None}
    count, per_step = len(next(iter(commands.values()))), round(CONTROL_DT / STEP)
    rng = np.random.default_rng(seed)
    inertia = bench.load_mass * bench.load_length**2 + bench.armature
    weight = bench.load_mass * _GRAVITY * bench.load_length
    kp = bench.kp if position is not None else 0.0
    late = round(bench.delay / STEP)
    q, v = (0.0 if position is None else float(position[0])) + bench.bias, 0.0
    seen, given_by_motor = np.empty(count), np.empty(count)
    for k in range(count):
        reading = q - bench.bias + bench.noise * rng.normal()
        seen[k], speed = reading, v
        for part in range(per_step):
            if part and part % round(bench.drive_dt / STEP) == 0:
                reading, speed = q - bench.bias, v
            at = max(0, k * per_step + part - late) // per_step
            arrived = {name: float(values[at]) for name, values in commands.items()}
            asked = kp * (arrived.get("des_dof_pos", 0.0) - reading) + bench.kd * (
                arrived.get("des_dof_vel", 0.0) - speed
            )
            asked += arrived.get("des_dof_effort", 0.0)
            limited = min(max(asked, -bench.current_limit), bench.current_limit)
            if part == 0:
                given_by_motor[k] = bench.motor_gain * limited
            viscous = bench.viscous
            if enabled is not None and not enabled[k]:
                limited, viscous = 0.0, viscous if bench.off_viscous is None else bench.off_viscous
            free = bench.motor_gain * limited - weight * math.sin(q) - viscous * v
            moved = v + STEP * free / inertia
            stop = STEP * bench.coulomb / inertia
            v = moved - min(max(moved, -stop), stop)  # friction stops what it can
            q += STEP * v
    columns = {"time": np.arange(count) * CONTROL_DT, "dof_pos/servo": seen}
    columns |= {f"{name}/servo": np.asarray(values, dtype=float) for name, values in commands.items()}
    if sensor is not None:
        columns["dof_effort/servo"] = sensor(given_by_motor)
    if enabled is not None:
        columns["torque_enable"] = np.asarray(enabled, dtype=float)
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.7f")
    facts = {
        "stiffness": kp, "damping": bench.kd, "load_mass": bench.load_mass, "load_length": bench.load_length,
        "arm_mass": 0.0, "saturation_effort": 1000.0, "effort_limit": 900.0, "velocity_limit": 100.0,
    }  # fmt: skip
    path.with_suffix(".json").write_text(json.dumps({**facts, **bench.stated}))
    return path
