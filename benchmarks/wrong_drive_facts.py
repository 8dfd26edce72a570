"""Recordings of a drive that is not what was stated, by an integrator that shares no code with the simulation.

    python benchmarks/wrong_drive_facts.py FOLDER

One pendulum, integrated at 0.05 ms: a PD controller at the control step, commands that arrive late, a current limit of
what is asked, a torque constant, Coulomb and viscous friction with exact sticking. Each case is two recordings of two
motions (CSV, with what the user believes beside it), at two gain sets where a gain is wrong:

| case | what is wrong | numbers |
|---|---|---|
| weak_60, weak_35, weak_60_8 | the motor gives a part of what it says | 0.60; 0.35, limit 9 N m; 0.60, limit 8 N m |
| kp_x1_6, kp_x0_4, kp_x2_5 | the proportional gain is a multiple of what was stated | 1.6, 0.4, 2.5 |
| kd_x0_15, kd_x4, kd_x0_3 | the derivative gain is | 0.15, 4, 0.3 |
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

CONTROL_DT, STEPS = 0.0025, 50
MASS, LENGTH, GRAVITY = 1.0, 0.2, 9.81
ARMATURE, VISCOUS, COULOMB, BIAS, LATE = 0.04, 0.4, 0.25, 0.015, 3
"""Delay of the command [control steps]."""
NOISE = 1e-4


@dataclass(frozen=True, kw_only=True)
class Case:
    """What the drive is, and what the user believes."""

    kp: tuple[float, float]
    kd: tuple[float, float]
    kp_factor: float = 1.0
    """True over stated proportional gain."""
    kd_factor: float = 1.0
    torque_factor: float = 1.0
    limit: float = math.inf
    """Of the torque that is asked [N m]."""


CASES = {
    "weak_60": Case(kp=(45.0, 45.0), kd=(1.2, 1.2), torque_factor=0.6),
    "weak_35": Case(kp=(60.0, 60.0), kd=(1.5, 1.5), torque_factor=0.35, limit=9.0),
    "kp_x1_6": Case(kp=(25.0, 50.0), kd=(1.0, 1.0), kp_factor=1.6),
    "kp_x0_4": Case(kp=(90.0, 150.0), kd=(1.2, 1.2), kp_factor=0.4),
    "kd_x0_15": Case(kp=(40.0, 40.0), kd=(6.0, 3.0), kd_factor=0.15),
    "kd_x4": Case(kp=(40.0, 60.0), kd=(0.3, 0.5), kd_factor=4.0),
    "kp_x2_5": Case(kp=(20.0, 35.0), kd=(0.9, 0.9), kp_factor=2.5),
    "kd_x0_3": Case(kp=(50.0, 50.0), kd=(3.0, 2.0), kd_factor=0.3),
    "weak_60_8": Case(kp=(45.0, 70.0), kd=(1.2, 1.2), torque_factor=0.6, limit=8.0),
}


def target(seconds: float, which: int) -> np.ndarray:
    """A chirp about one position, then steps (0), or slower and about another (1), (K,) [rad]."""
    time = np.arange(round(seconds / CONTROL_DT)) * CONTROL_DT
    first, last = ((0.2, 4.0), (0.1, 2.5))[which]
    phase = 2 * math.pi * (first * time + (last - first) * time**2 / (2 * seconds))
    steps = 0.25 * np.sign(np.sin(2 * math.pi * 0.35 * time))
    return (0.25, 0.5)[which] + 0.45 * np.sin(phase) + steps * (time > 0.6 * seconds)


def simulate(case: Case, which: int, command: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Encoder positions at the control steps, (K,) [rad]."""
    inertia, weight = ARMATURE + MASS * LENGTH**2, MASS * GRAVITY * LENGTH
    kp, kd = case.kp_factor * case.kp[which], case.kd_factor * case.kd[which]
    dt = CONTROL_DT / STEPS
    q, v, result = command[0] + BIAS, 0.0, np.empty(len(command))
    for k in range(len(command)):
        result[k] = q - BIAS
        asked = kp * (command[max(0, k - LATE)] - (q - BIAS)) - kd * v
        torque = case.torque_factor * min(max(asked, -case.limit), case.limit)
        for _ in range(STEPS):
            drive = torque - weight * math.sin(q)
            if v == 0.0 and abs(drive) <= COULOMB:
                continue
            sign = math.copysign(1.0, v if v != 0.0 else drive)
            new = (v + dt / inertia * (drive - sign * COULOMB)) / (1.0 + dt * VISCOUS / inertia)
            v = 0.0 if new * sign < 0.0 else new  # it sticks before it turns back
            q += dt * v
    return result + NOISE * generator.normal(size=len(result))


def write(folder: Path, name: str, seconds: float = 12.0, seed: int = 0) -> list[Path]:
    """The two recordings of a case, with what the user believes."""
    case, paths, generator = CASES[name], [], np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    for which, suffix in enumerate("ab"):
        command = target(seconds, which)
        position = simulate(case, which, command, generator)
        path = folder / f"{name}_{suffix}.csv"
        rows = np.stack([np.arange(len(command)) * CONTROL_DT, position, command], axis=1)
        np.savetxt(path, rows, "%.7f", ",", header="time,dof_pos/servo,des_dof_pos/servo", comments="")
        believed = {"stiffness": case.kp[which], "damping": case.kd[which], "load_mass": MASS, "load_length": LENGTH}
        wide = {"arm_mass": 0.0, "saturation_effort": 1000.0, "effort_limit": 900.0, "velocity_limit": 100.0}
        path.with_suffix(".json").write_text(json.dumps(believed | wide))
        paths.append(path)
    return paths


def main() -> None:
    """Write all cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=12.0, help="length of each (default %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    args = parser.parse_args()
    for name in CASES:
        print(*write(args.folder, name, args.seconds, args.seed))


if __name__ == "__main__":
    main()
