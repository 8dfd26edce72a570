"""Does a diagnosis name the laws that drives have, and nothing where it does not know the law?

A plant of its own (drive_laws_plant.py) hides one law at a time on the test bench. Those in LAWS are in the library;
OUTSIDE holds laws that are not, with the variable that carries each.

python benchmarks/drive_laws.py
python benchmarks/drive_laws.py --cases gravity_part sag --seeds 3
python benchmarks/drive_laws.py --table
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from drive_laws_plant import CONTROL_DT, NOISE, PLANT_DT, Law, Plan, State, drawn_base, plans, simulate, with_loads

from pace_optim.diagnosis import candidate_effects, search_effects
from pace_optim.diagnosis.findings.findings import Findings, evidence_of, verdict_of
from pace_optim.diagnosis.selection.decisions import Decision, as_lines
from pace_optim.diagnosis.verdict.free_curves import error_map
from pace_optim.diagnosis.verdict.sizes import sizes
from pace_optim.joints.fits.fits import Fits, fits_on
from pace_optim.problem.problem import Problem, load_problem

DURATION = 4.0


@dataclass(frozen=True, kw_only=True)
class Case:
    """A hidden law, and what a diagnosis should say of it."""

    law: Callable[[np.random.Generator], Law]
    """The law, of a size drawn at random."""
    right: tuple[str, ...] = ()
    """Effects that are it; none: it is in no library, and ``unknown`` is right."""
    variable: tuple[str, ...] = ()
    """Variables that carry it, as curves call them."""
    plan: Callable[[np.random.Generator, float], list[Plan]] = plans
    """Makes its recordings."""


def _loads(rng: np.random.Generator, duration: float) -> list[Plan]:
    return with_loads(plans(rng, duration), (0.5, 1.0, 2.0))


def _large(rng: np.random.Generator, duration: float) -> list[Plan]:
    return [replace(plan, load_mass=4.0) for plan in plans(rng, duration, 1.3)]


def _soft(rng: np.random.Generator, duration: float) -> list[Plan]:
    return [replace(plan, stiffness=plan.stiffness / 8) for plan in plans(rng, duration)]


def _part_of_gravity(rng: np.random.Generator) -> Law:
    share = rng.uniform(0.5, 0.9)
    return Law(asked=lambda tau, s: tau - share * s.gravity)


def _heat(rng: np.random.Generator) -> Law:
    per_heat = rng.uniform(1e-4, 2.5e-4)
    return Law(torque=lambda tau, s: tau * (1 - min(0.5, per_heat * s.heat)), heat_s=20.0)


def _sag(rng: np.random.Generator) -> Law:
    slope = rng.uniform(0.004, 0.007)
    return Law(torque=lambda tau, s: tau * (1 - slope * abs(tau)))


def _ripple(rng: np.random.Generator) -> Law:
    periods, size = float(rng.integers(50, 70)), rng.uniform(0.4, 0.7)
    return Law(joint=lambda s: size * math.sin(periods * s.q + 0.7))


def _gain(low: float, high: float) -> Callable[[np.random.Generator], Law]:
    def law(rng: np.random.Generator) -> Law:
        gain = rng.uniform(low, high)
        return Law(torque=lambda tau, s: gain * tau)

    return law


def _far_spring(rng: np.random.Generator) -> Law:
    stiffness, rest = rng.uniform(2, 5), rng.uniform(2.0, 2.6)
    return Law(joint=lambda s: -stiffness * (s.q - rest))


def _lag(rng: np.random.Generator) -> Law:
    time_constant = rng.uniform(0.003, 0.008)
    weight = -math.expm1(-PLANT_DT / time_constant)
    mean_weight = 1 - weight * time_constant / PLANT_DT

    def lagging(tau: float, s: State) -> float:
        before = s.memory.get("tau", tau)
        s.memory["tau"] = before + (tau - before) * weight
        return before + (tau - before) * mean_weight

    return Law(torque=lagging)


def _command_filter(rng: np.random.Generator) -> Law:
    weight = -math.expm1(-CONTROL_DT / rng.uniform(0.01, 0.04))

    def filtered(target: float, s: State) -> float:
        before = s.memory.get("target", target)
        s.memory["target"] = before + (target - before) * weight
        return s.memory["target"]

    return Law(target=filtered)


def _stribeck(rng: np.random.Generator) -> Law:
    size, width = rng.uniform(0.3, 1.0), rng.uniform(0.08, 0.3)
    return Law(friction=lambda f, s: f + size * math.exp(-((s.v / width) ** 2)))


def _load_friction(rng: np.random.Generator) -> Law:
    coefficient = rng.uniform(0.03, 0.1)
    return Law(friction=lambda f, s: f + coefficient * abs(s.motor - s.gravity))


def _cold_friction(rng: np.random.Generator) -> Law:
    per_kelvin, warms_s = rng.uniform(0.01, 0.02), rng.uniform(6.0, 12.0)

    def temperature(t: float) -> float:
        return 55.0 - 30.0 * math.exp(-max(t, 0.0) / warms_s)

    def factor(s: State) -> float:
        return 1 - per_kelvin * (temperature(s.t) - 40.0)

    return Law(friction=lambda f, s: factor(s) * f, drag=lambda d, s: factor(s) * d, temperature=temperature)


def _battery(rng: np.random.Generator) -> Law:
    falls, rate = rng.uniform(3.0, 5.0), rng.uniform(0.3, 0.6)

    def voltage(t: float) -> float:
        return 24.0 - falls * (t / (6 * DURATION)) - 0.5 * math.sin(rate * t)

    return Law(torque=lambda tau, s: tau * voltage(s.t) / 24.0, voltage=voltage)


LAWS: dict[str, Case] = {
    "clean": Case(law=lambda rng: Law(), right=("nothing_missing",)),
    "gravity_part": Case(law=_part_of_gravity, right=("gravity_compensation",), plan=_large),
    "gravity_all": Case(
        law=lambda rng: Law(asked=lambda tau, s: tau - s.gravity), right=("gravity_compensation",), plan=_large
    ),
    "heat": Case(law=_heat, right=("torque_fade",), variable=("time",), plan=_large),
    "sag": Case(law=_sag, right=("supply_sag",), variable=("torque",), plan=_large),
    "ripple_60": Case(law=_ripple, right=("torque_ripple",), variable=("position",)),
    "stall_torque": Case(law=_gain(0.5, 0.65), right=("torque_gain",), plan=_loads),
    "far_spring": Case(law=_far_spring, right=("parallel_spring",), variable=("position",)),
    "speed_loop": Case(
        law=lambda rng: Law(speed_loop=(6.0, rng.uniform(20, 60))), right=("unknown", "integral_gain"), plan=_soft
    ),
    "bandwidth": Case(law=_lag, right=("drive_bandwidth",)),
    "command_filter": Case(law=_command_filter, right=("command_filter",)),
    "stribeck": Case(law=_stribeck, right=("stribeck_friction",)),
    "gain": Case(law=_gain(0.75, 0.9), right=("torque_gain", "payload")),
    "cold_friction": Case(law=_cold_friction, right=("thermal_friction",), variable=("temperature",)),
    "battery": Case(law=_battery, right=("supply_voltage",), variable=("voltage",), plan=_large),
    "load_friction": Case(law=_load_friction, right=("load_dependent_friction",), plan=_loads),
}
"""What drives have, and the library too; ``gain`` is the same as a payload with one load."""


def _inertia_map(rng: np.random.Generator) -> Law:
    size = rng.uniform(0.5, 0.8)
    return Law(inertia=lambda own, s: own * (1 + size * math.cos(3 * s.q)))


def _friction_map(rng: np.random.Generator) -> Law:
    size = rng.uniform(0.6, 0.9)
    return Law(friction=lambda f, s: f * (1 + size * math.sin(5 * s.q)))


def _cubic_spring(rng: np.random.Generator) -> Law:
    size = rng.uniform(10, 20)
    return Law(joint=lambda s: -size * s.q**3)


def _detent(rng: np.random.Generator) -> Law:
    size, at, width = rng.uniform(1.5, 3.0), rng.uniform(-0.2, 0.2), 0.06
    return Law(joint=lambda s: -size * (s.q - at) / width * math.exp(-0.5 * ((s.q - at) / width) ** 2))


def _lever(rng: np.random.Generator) -> Law:
    size = rng.uniform(0.3, 0.5)
    return Law(torque=lambda tau, s: tau * (1 + size * math.sin(2 * s.q)))


def _one_way_gain(rng: np.random.Generator) -> Law:
    gain = rng.uniform(0.6, 0.8)
    return Law(torque=lambda tau, s: tau if tau > 0 else gain * tau)


def _steep_drag(rng: np.random.Generator) -> Law:
    size = rng.uniform(0.05, 0.1)
    return Law(drag=lambda d, s: d + size * s.v**4)


def _dead_torque(rng: np.random.Generator) -> Law:
    width = rng.uniform(1.0, 2.0)
    return Law(torque=lambda tau, s: math.copysign(max(0.0, abs(tau) - width), tau))


def _late_friction(rng: np.random.Generator) -> Law:
    at = rng.uniform(0.45, 0.75) * 6 * DURATION
    return Law(friction=lambda f, s: f if s.t < at else 2.5 * f)


def _swinging_gain(rng: np.random.Generator) -> Law:
    rate = rng.uniform(0.15, 0.3)
    return Law(torque=lambda tau, s: tau * (1 + 0.25 * math.sin(rate * s.t)))


def _drifting_torque(rng: np.random.Generator) -> Law:
    rate = rng.uniform(0.1, 0.2)
    return Law(joint=lambda s: 2.0 * math.sin(rate * s.t))


def _weak_when_fast(rng: np.random.Generator) -> Law:
    speed = rng.uniform(4, 8)
    return Law(torque=lambda tau, s: tau / (1 + (s.v / speed) ** 2))


OUTSIDE: dict[str, Case] = {
    "inertia_map": Case(law=_inertia_map, variable=("position",)),
    "friction_map": Case(law=_friction_map, variable=("position",)),
    "cubic_spring": Case(law=_cubic_spring, variable=("position",)),
    "detent": Case(law=_detent, variable=("position",)),
    "lever": Case(law=_lever, variable=("position",)),
    "one_way_gain": Case(law=_one_way_gain, variable=("torque",), plan=_large),
    "steep_drag": Case(law=_steep_drag, variable=("speed",)),
    "dead_torque": Case(law=_dead_torque, variable=("torque",)),
    "late_friction": Case(law=_late_friction, variable=("time",)),
    "swinging_gain": Case(law=_swinging_gain, variable=("time",), plan=_large),
    "drifting_torque": Case(law=_drifting_torque, variable=("time",)),
    "weak_when_fast": Case(law=_weak_when_fast, variable=("speed",)),
}
"""Laws that no library has."""
CASES = LAWS | OUTSIDE


def record(folder: Path, case: Case, rng: np.random.Generator) -> None:
    """Write the recordings of a case; the last file, 5_multisine, validates, and was recorded in the middle."""
    base, law = drawn_base(rng), case.law(rng)
    begin, heat = 0.0, 0.0
    own = case.plan(rng, DURATION)
    for i in (0, 1, 5, 2, 3, 4):
        plan = own[i]
        seen, heat = simulate(plan, base, law, begin, heat)
        clock = begin + CONTROL_DT * np.arange(len(plan.command))
        logged = {name: how for name in ("temperature", "voltage") if (how := getattr(law, name)) is not None}
        np.savez(
            folder / f"{i}_{plan.name}.npz",
            time=clock,
            dof_pos=(seen + NOISE * rng.standard_normal(len(seen)))[:, None],
            des_dof_pos=plan.command[:, None],
            stiffness=plan.stiffness,
            damping=plan.damping,
            effort_limit=89.0,
            saturation_effort=np.inf,
            velocity_limit=1e3,
            load_mass=plan.load_mass,
            load_length=plan.load_length,
            **{name: np.array([[how(t)] for t in clock]) for name, how in logged.items()},
        )
        begin += DURATION


def load(folder: Path) -> Problem:
    """The problem of a folder's recordings."""
    files = sorted(str(path) for path in folder.glob("*.npz"))
    data, validation = files[:-1], files[-1:]
    return load_problem("Pace-TestBench-v0", data=data, validation=validation, physics_dt=CONTROL_DT / 2)


def run_case(name: str, seed: int, folder: Path) -> dict[str, Any]:
    """Record, diagnose; what came of it."""
    case = CASES[name]
    with tempfile.TemporaryDirectory() as recordings:
        record(Path(recordings), case, np.random.default_rng([seed, sorted(CASES).index(name)]))
        problem = load(Path(recordings))
    begin, log, fits = time.perf_counter(), list[Decision](), fits_on("cpu", Fits().cfg)
    middle = problem.space.to_physical(problem.space.start)
    found = search_effects(problem, middle, candidate_effects(), 3, log=log.append, fits=fits)
    (folder / f"{name}_{seed}.jsonl").write_bytes(as_lines(log))
    return {"case": name, "seed": seed, "seconds": time.perf_counter() - begin} | _told(found, problem, fits, case)


def _told(found: Findings, problem: Problem, fits: Fits, case: Case) -> dict[str, Any]:
    outcome = found.outcome
    curves = error_map(found.curves, problem.joint_names, outcome.base_errors)
    best = next(iter(curves.values()), {}).get("best")
    said = [*found.added] if found.verdict == "effect" else [found.verdict]
    return {
        "verdict": found.verdict,
        "said": said,
        "right": said in ([each] for each in case.right) or (not case.right and found.verdict == "unknown"),
        "wrong_name": found.verdict == "effect" and not set(said) <= set(case.right),
        "best_curve": best,
        "formula": next(iter(curves.values()), {}).get("formula", ""),
        "right_variable": best is not None and any(best.endswith(f"over_{v}") for v in case.variable),
        "before": 1e3 * float(outcome.base_errors.mse.mean().sqrt()),
        "after": 1e3 * float(outcome.final_errors.mse.mean().sqrt()),
        "floor": 1e3 * float(found.data.floor.square().mean().sqrt()),
        "summary": " ".join([verdict_of(found, problem), *evidence_of(found, problem)]),
        "sizes": sizes(fits, outcome, found.data.floor, problem.joint_names),
    }


def table(results: Sequence[dict[str, Any]]) -> str:
    """All results, a line each, and what they add up to."""
    rows = ["| hidden | seed | said | best curve | error [mrad] | time |", "|---|---|---|---|---|---|"]
    for r in results:
        mark = " **wrong**" if r["wrong_name"] else ""
        rows.append(
            f"| {r['case']} | {r['seed']} | {', '.join(r['said'])}{mark} | {r['best_curve'] or ''} | "
            f"{r['before']:.3g} → {r['after']:.3g} | {r['seconds']:.0f} s |"
        )
    for title, group in (("in the library", LAWS), ("outside", OUTSIDE)):
        own = [r for r in results if r["case"] in group]
        right, wrong, variable = (sum(r[key] for r in own) for key in ("right", "wrong_name", "right_variable"))
        rows.append(f"\n{title}: {right} of {len(own)} right, {wrong} wrong names, {variable} with the right variable")
    return "\n".join(rows)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=tuple(CASES), default=list(CASES))
    parser.add_argument("--seeds", type=int, default=1, help="of each case")
    parser.add_argument("--first_seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("logs/drive_laws"), help="results and decisions")
    parser.add_argument("--table", action="store_true", help="only print what the results say")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    path = args.folder / "results.jsonl"
    if not args.table:
        for seed in range(args.first_seed, args.first_seed + args.seeds):
            for name in args.cases:
                result = run_case(name, seed, args.folder)
                with path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(result) + "\n")
                print(f"{name} {seed}: {result['seconds']:.0f} s {result['summary']}", flush=True)
    lines = (json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
    print(table(list({(each["case"], each["seed"]): each for each in lines}.values())))


if __name__ == "__main__":
    main()
