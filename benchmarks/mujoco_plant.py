"""Does the diagnosis name what MuJoCo's own bodies, tendons and friction hide? A third simulator, on the test bench.

python benchmarks/mujoco_plant.py
python benchmarks/mujoco_plant.py --effects joint_elasticity --seeds 3
python benchmarks/mujoco_plant.py --friction_time_constant 0.02   # MuJoCo's default: friction creeps
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import mujoco
import numpy as np

from pace_optim.diagnosis import candidate_effects, search_effects
from pace_optim.diagnosis.findings.findings import Findings
from pace_optim.problem.problem import load_problem

CONTROL_DT, PLANT_DT, DURATION, NOISE = 0.0025, 1e-4, 10.0, 1e-4
KD, EFFORT_LIMIT, SATURATION_EFFORT, VELOCITY_LIMIT = 0.6, 89.0, 140.0, 8.5
LOAD_MASS, LOAD_LENGTH = 1.0, 0.2
SETTLING = 1.0
"""Time at rest before a recording begins [s]."""

Sizes = Mapping[str, float]
EFFECTS: dict[str, Callable[[np.random.Generator], Sizes]] = {
    "clean": lambda rng: {},
    "joint_elasticity": lambda rng: {"stiffness": rng.uniform(150, 500), "damping": rng.uniform(0.05, 0.5)},
    "backlash": lambda rng: {"stiffness": 4000.0, "damping": 0.2, "gap": rng.uniform(0.005, 0.02)},
    "stribeck_friction": lambda rng: {"stribeck": rng.uniform(0.3, 1.2), "velocity": rng.uniform(0.05, 0.3)},
    "quadratic_friction": lambda rng: {"quadratic": rng.uniform(0.02, 0.1)},
    "soft_friction": lambda rng: {"softness": rng.uniform(0.01, 0.05)},
    "torque_gain": lambda rng: {"gain": rng.choice([-1, 1]) * rng.uniform(0.1, 0.25)},
    "torque_ripple": lambda rng: {
        "ripple": rng.uniform(0.2, 0.6),
        "turns": rng.integers(6, 20),
        "phase": rng.uniform(0, 6),
    },
}
"""What can be hidden, and its size [SI units]."""


def commands(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The commands of each recording [rad]; ``stiff`` has more proportional gain, ``multisine`` validates."""
    t = np.arange(0, DURATION, CONTROL_DT)
    chirp = 0.2 * np.sin(2 * np.pi * (0.1 * t + 4.9 * t**2 / (2 * DURATION)))
    levels = np.r_[0.0, rng.uniform(-0.6, 0.6, int(DURATION / 0.8) + 1)]
    frequencies = np.array([0.2, 0.5, 0.9, 1.7, 2.9, 4.3])
    waves = np.sin(2 * np.pi * frequencies * t[:, None] + rng.uniform(0, 2 * np.pi, 6)) / np.sqrt(frequencies)
    multisine = waves.sum(axis=1)
    return {
        "chirp": chirp,
        "stiff": chirp,
        "triangle": 1.4 / np.pi * np.arcsin(np.sin(2 * np.pi * t / 3)),
        "steps": levels[(t / 0.8).astype(int)],
        "staircase": 0.7 * np.sin(2 * np.pi * (t / 0.5).astype(int) / (DURATION / 0.5)),
        "multisine": 0.7 * multisine / np.abs(multisine).max(),
    }


def model(base: Sizes, sizes: Sizes, friction_time_constant: float) -> mujoco.MjModel:
    """A pendulum; with an elastic shaft its drive is a body of its own."""
    soft = sizes.get("softness", friction_time_constant)
    hard = f'solreffriction="{soft} 1" ' + ('solimpfriction="0.999 0.9999 0.001"' if soft < 0.005 else "")
    drive = f'<joint name="drive" axis="0 1 0" armature="{base["armature"]}" damping="{base["viscous_friction"]}" '
    drive += f'frictionloss="{base["friction"]}" {hard}/>'
    load = f'<inertial pos="0 0 {-LOAD_LENGTH}" mass="{LOAD_MASS}" diaginertia="1e-9 1e-9 1e-9"/>'
    bodies, shaft = f"<body>{drive}{load}</body>", ""
    if "stiffness" in sizes:
        rotor = '<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
        bodies = f'<body>{drive}{rotor}</body><body><joint name="link" axis="0 1 0"/>{load}</body>'
        half = sizes.get("gap", 0.0) / 2
        shaft = f'<tendon><fixed stiffness="{sizes["stiffness"]}" damping="{sizes["damping"]}" '
        shaft += f'springlength="{-half} {half}"><joint joint="drive" coef="1"/><joint joint="link" coef="-1"/></fixed>'
        shaft += "</tendon>"
    option = f'<option timestep="{PLANT_DT}" integrator="implicitfast"/>'
    return mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{bodies}</worldbody>{shaft}</mujoco>")


def simulate(command: np.ndarray, kp: float, base: Sizes, sizes: Sizes, friction_time_constant: float) -> np.ndarray:
    """Encoder positions [rad] of a drive with a PD controller at the control rate."""
    plant = model(base, sizes, friction_time_constant)
    data = mujoco.MjData(plant)
    data.qpos[:] = command[0]
    substeps = round(CONTROL_DT / PLANT_DT)
    seen = np.empty(len(command))
    for step in range(-round(SETTLING / CONTROL_DT), len(command)):
        encoder = data.qpos[0] - base["encoder_bias"]
        if step >= 0:
            seen[step] = encoder
        speed = data.qvel[0]
        for part in range(substeps):
            arrived = math.floor(
                step + (part + 0.5) / substeps - base["delay"]
            )  # the bus holds a target until the next
            asked = kp * (command[max(arrived, 0)] - encoder) - KD * speed
            v = data.qvel[0]
            most = max(SATURATION_EFFORT * (1 - v / VELOCITY_LIMIT), -EFFORT_LIMIT)
            least = min(SATURATION_EFFORT * (-1 - v / VELOCITY_LIMIT), EFFORT_LIMIT)
            effort = min(max(asked, -EFFORT_LIMIT), EFFORT_LIMIT)  # what is asked of the motor
            effort = min(max(effort * (1 + sizes.get("gain", 0.0)), least), most)
            effort -= sizes.get("quadratic", 0.0) * v * abs(v)
            if "ripple" in sizes:
                effort += sizes["ripple"] * np.sin(sizes["turns"] * data.qpos[0] + sizes["phase"])
            if "stribeck" in sizes:
                plant.dof_frictionloss[0] = base["friction"] + sizes["stribeck"] * np.exp(
                    -((v / sizes["velocity"]) ** 2)
                )
            data.qfrc_applied[0] = effort
            mujoco.mj_step(plant, data)
    return seen


def drawn_base(rng: np.random.Generator) -> Sizes:
    """What every drive has; the delay in control steps."""
    return {
        "armature": rng.uniform(0.02, 0.15),
        "viscous_friction": rng.uniform(0.3, 2.0),
        "friction": rng.uniform(0.2, 1.5),
        "encoder_bias": rng.uniform(-0.05, 0.05),
        "delay": rng.uniform(0.0, 6.0),
    }


def record(folder: Path, effect: str, seed: int, friction_time_constant: float) -> None:
    """Write the recordings of a case."""
    rng = np.random.default_rng([seed, list(EFFECTS).index(effect)])
    base = drawn_base(rng)
    sizes = EFFECTS[effect](rng)
    told = ", ".join(f"{name} {value:.4g}" for name, value in {**base, **sizes}.items())
    print(f"{effect}, seed {seed}: {told}", flush=True)
    for name, command in commands(rng).items():
        kp = 130.0 if name == "stiff" else 85.0
        seen = simulate(command, kp, base, sizes, friction_time_constant)
        np.savez(
            folder / f"{name}.npz",
            time=CONTROL_DT * np.arange(len(command)),
            dof_pos=(seen + NOISE * rng.standard_normal(len(seen)))[:, None],
            des_dof_pos=command[:, None],
            stiffness=kp,
            damping=KD,
            load_mass=LOAD_MASS,
            load_length=LOAD_LENGTH,
        )


def diagnosed(folder: Path, max_effects: int) -> Findings:
    """What the diagnosis finds in a folder of recordings."""
    files = sorted(str(path) for path in folder.glob("*.npz"))
    problem = load_problem(
        "Pace-TestBench-v0",
        data=[path for path in files if "multisine" not in path],
        validation=[path for path in files if "multisine" in path],
        physics_dt=CONTROL_DT / 2,
    )
    middle = problem.space.to_physical(problem.space.start)
    return search_effects(problem, middle, candidate_effects(), max_effects)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effects", nargs="+", choices=tuple(EFFECTS), default=list(EFFECTS))
    parser.add_argument("--seeds", type=int, default=1, help="cases of each")
    parser.add_argument("--first_seed", type=int, default=0)
    parser.add_argument(
        "--friction_time_constant",
        type=float,
        default=4e-4,
        help="of MuJoCo's friction constraint [s]; its own is 0.02",
    )
    parser.add_argument("--max_effects", type=int, default=3, help="how many the diagnosis may add")
    args = parser.parse_args()
    for name in ("seeds", "max_effects", "friction_time_constant"):
        if not getattr(args, name) > 0:
            parser.error(f"--{name} is {getattr(args, name)}, expected a value above 0.")
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        for effect in args.effects:
            with tempfile.TemporaryDirectory() as folder:
                record(Path(folder), effect, seed, args.friction_time_constant)
                begin = time.perf_counter()
                found = diagnosed(Path(folder), args.max_effects)
            before, after = (
                1e3 * float(errors.mse.mean().sqrt())
                for errors in (found.outcome.base_errors, found.outcome.final_errors)
            )
            print(
                f"  {found.verdict}: {', '.join(found.paying) or 'no effect'}, {before:.3g} to {after:.3g} mrad "
                f"(noise {1e3 * NOISE:g}), {time.perf_counter() - begin:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
