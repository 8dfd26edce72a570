"""One call of the drives of all effects tried side by side, as a diagnosis makes it, on a processor and on a GPU.

    python benchmarks/drive_calls.py [--device cuda:0] [--rows 20 100 1000]

Every effect acts on rows of its own, of twelve joints each, in float64; one core of the processor.
"""

from __future__ import annotations

import argparse
import time

import torch

from pace_actuators import ActuatorActions, PaceDCMotor, PaceDCMotorCfg
from pace_actuators.effects import EffectCfg, available_effects, get_effect

JOINTS = tuple(f"joint_{i}" for i in range(12))
CALLS = 40


def drives(rows_each: int, device: str) -> tuple[PaceDCMotor, int]:
    """Drives whose effects act on so many rows each, and all rows."""
    every = [get_effect(name) for name in available_effects()]
    tried = [effect for effect in every if not effect.free_form]
    effects = [
        EffectCfg(effect=effect.name, env_rows=slice(rows_each * (i + 1), rows_each * (i + 2)))
        for i, effect in enumerate(tried)
    ]
    cfg = PaceDCMotorCfg(
        joint_names_expr=".*",
        stiffness=85.0,
        damping=0.6,
        armature=0.1,
        friction=0.5,
        viscous_friction=2.0,
        delay=2.4,
        max_delay=8.0,
        saturation_effort=120.0,
        effort_limit=80.0,
        velocity_limit=7.5,
        effects=effects,
        physics_dt=0.0025,
    )
    rows = rows_each * (len(tried) + 1)
    motor = PaceDCMotor(cfg, JOINTS, slice(None), rows, device=device, dtype=torch.float64)
    stack = motor.effects
    for effect in stack.effects if stack is not None else ():
        for parameter in effect.parameters:
            start = torch.full((rows_each, len(JOINTS)), parameter.start, dtype=torch.float64, device=device)
            effect.set_parameter(parameter.name, start)
    motor.update_effects()
    return motor, rows


def milliseconds(motor: PaceDCMotor, rows: int, device: str) -> float:
    """Time of one call [ms]."""
    target, q, v, load = (0.1 * torch.randn(rows, len(JOINTS), dtype=torch.float64, device=device) for _ in range(4))
    inertia = torch.full_like(q, 0.4)

    def call() -> None:
        motor.set_load_effort(load)
        motor.set_link(inertia, inertia, inertia)
        motor.observe(q, v)
        motor.compute(ActuatorActions(target, None, None), q, v)

    def many() -> None:
        for _ in range(CALLS):
            call()
        if device != "cpu":
            torch.cuda.synchronize()

    many()
    start = time.perf_counter()
    many()
    return 1e3 * (time.perf_counter() - start) / CALLS


def main() -> None:
    """Print a line for each number of rows and device."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--rows", type=int, nargs="+", default=[20, 100, 1000], help="rows of each effect")
    args = parser.parse_args()
    torch.set_num_threads(1)
    for rows_each in args.rows:
        for device in dict.fromkeys(("cpu", args.device)):
            motor, rows = drives(rows_each, device)
            print(f"{rows} rows, {device}: {milliseconds(motor, rows, device):.3g} ms a call", flush=True)


if __name__ == "__main__":
    with torch.no_grad():
        main()
