"""Our least squares beside ``mujoco.sysid``: the error reached against the wall time.

    python benchmarks/peer_sysid.py

One run, one machine, one model, one recording, one set of parameters (36: armature, viscous and Coulomb friction of
ANYmal D's joints), one start (the centre of the bounds). Both simulators must first replay the truth to 1e-9 rad.
Solvers take turns for ``--repetitions``; each one's median run is shown. Needs the extra ``benchmark``.
Writes ``peer_sysid.png`` and ``peer_sysid.json``; exits 1 below the speed-up that ``--at_least`` asks for.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from drive_problem import DriveProblem, drive_problem
from solver_trace import Trace, machine, table, write_json
from sysid_peer import Peer

from pace_optim.estimate.way_down import WHOLE, WayDown
from pace_optim.terminal.cli import run_cli

OURS = "pace least_squares"
LEVELS = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14)


def run_ours(case: DriveProblem) -> Trace:
    """Identify with our least squares from the centre of the bounds."""
    problem = case.problem
    trace = Trace(solver=OURS)
    iterations = 0

    def note(x: torch.Tensor, score: float) -> None:
        error = case.relative_error(problem.space.to_physical(x)[case.fitted])
        trace.add(score, error, way.evaluator.simulated_steps + way.pieces.simulated_steps)

    def after_iteration(descents: list[Any]) -> None:
        nonlocal iterations
        iterations += 1
        if descents[0].stage == WHOLE:
            note(descents[0].x, descents[0].score)

    start = torch.zeros(problem.space.size, dtype=torch.float64)
    way = WayDown(problem, on_iteration=after_iteration)
    way.noise_score = 0.0  # to the last digit
    way.run([start])
    trace.end(iterations, way.evaluator.simulated_steps + way.pieces.simulated_steps)
    return trace


def check_replay(case: DriveProblem, peer: Peer, tolerance: float = 1e-9) -> float:
    """Largest error of either simulator at the truth [rad].

    Raises:
        ValueError: If it is above the tolerance: then the two do not solve the same problem.
    """
    ours = float(case.problem.evaluator().residuals(case.truth[None]).error.abs().max())
    theirs = float(np.abs(peer.error(case.truth[case.fitted].numpy())).max())
    if max(ours, theirs) > tolerance:
        raise ValueError(f"The replays of the truth are off by {ours:.1e} (ours) and {theirs:.1e} rad (mujoco.sysid).")
    return max(ours, theirs)


def median_runs(runners: list[Callable[[], Trace]], repetitions: int) -> list[Trace]:
    """Let the runners take turns; the run of median wall time of each."""
    runs: list[list[Trace]] = [[] for _ in runners]
    for _ in range(repetitions):
        for own, runner in zip(runs, runners, strict=True):
            own.append(runner())
            print(f"  {own[-1].solver}: {own[-1].wall_time_s:.1f} s", file=sys.stderr)
    return [sorted(own, key=lambda run: run.wall_time_s)[(len(own) - 1) // 2] for own in runs]


def speed_ups(traces: list[Trace]) -> list[dict[str, Any]]:
    """Seconds of ours and of the fastest peer to scores that both reach, the last one the lowest of these."""
    ours = next(trace for trace in traces if trace.solver == OURS)
    result = []
    for peer in (trace for trace in traces if trace.solver.startswith("mujoco")):
        lowest = max(ours.score[-1], peer.score[-1])
        for score in [level for level in LEVELS if level > lowest] + [lowest]:
            mine, theirs = ours.seconds_to(score), peer.seconds_to(score)
            result.append(
                {"peer": peer.solver, "score": score, "ours_s": mine, "peer_s": theirs, "ratio": theirs / mine}
            )
    return result


def plot(traces: list[Trace], path: Path) -> None:
    """Score and parameter error against wall time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    panels = [("score", "score [rad²]"), ("parameter_error", "RMS of |parameter − truth| / range")]
    for ax, (name, label) in zip(axes, panels, strict=True):
        for i, trace in enumerate(traces):
            values = getattr(trace, name)
            # held until the next better vector, and to the end of the run
            ax.step([*trace.seconds, trace.wall_time_s], [*values, values[-1]], where="post", color=f"C{i}", lw=1.2)
            ax.plot(trace.seconds, values, "o", ms=4, color=f"C{i}", label=trace.solver)
        ax.set(xlabel="wall time [s]", ylabel=label, yscale="log", xlim=(0, None))
        ax.grid(alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False)
    figure.suptitle(
        "ANYmal D, 36 drive parameters, one noise-free chirp, start at the centre of the bounds", fontsize=11
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def report(traces: list[Trace]) -> str:
    """The tables."""
    rows = [
        [
            t.solver,
            f"{t.wall_time_s:.2f}",
            f"{t.all_steps / 1e6:.2f}",
            f"{t.iterations}",
            f"{t.score[-1]:.1e}",
            f"{t.parameter_error[-1]:.1e}",
            f"{t.largest_error[-1]:.1e}",
        ]
        for t in traces
    ]
    header = ["", "wall time [s]", "M steps", "iterations", "score [rad²]", "RMS error/range", "largest error/range"]
    to_score = [
        [s["peer"], f"{s['score']:.1e}", f"{s['ours_s']:.2f}", f"{s['peer_s']:.2f}", f"{s['ratio']:.1f}x"]
        for s in speed_ups(traces)
    ]
    return "\n\n".join(
        [table(header, rows), table(["to the same score", "score [rad²]", "ours [s]", "peer [s]", "ratio"], to_score)]
    )


def main() -> int:
    """Measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=8000, help="length of the recording [control steps]")
    parser.add_argument("--repetitions", type=int, default=3, help="runs of each solver, in turns")
    parser.add_argument("--optimizers", nargs="+", default=["mujoco"], help="of mujoco.sysid: mujoco, scipy, ...")
    parser.add_argument("--x_scale", default=None, choices=["jac"], help="the peer's scaling of parameters")
    parser.add_argument("--output", type=Path, default=Path("logs/benchmarks"), help="folder of the plot and the JSON")
    parser.add_argument("--at_least", type=float, default=0.0, help="ratio to the lowest common score to be reached")
    args = parser.parse_args()

    measured_on = machine()
    case = drive_problem(args.steps)
    peer = Peer(case)
    off = check_replay(case, peer)
    print(
        f"{len(case.fitted)} parameters, {args.steps} steps, both simulators replay the truth to {off:.1e} rad",
        "",
        sep="\n",
    )
    options = {} if args.x_scale is None else {"x_scale": args.x_scale}
    runners: list[Callable[[], Trace]] = [lambda: run_ours(case)]
    runners += [lambda name=name: peer.run(name, **options) for name in args.optimizers]
    traces = median_runs(runners, args.repetitions)
    ratios = speed_ups(traces)
    print(*report(traces).split("\n"), sep="\n")
    plot(traces, args.output / "peer_sysid.png")
    write_json(
        args.output / "peer_sysid.json",
        {
            "measured_on": measured_on,
            "steps": args.steps,
            "parameters": len(case.fitted),
            "replay_error_rad": off,
            "peer_options": options,
            "traces": [trace.to_dict() for trace in traces],
            "to_the_same_score": ratios,
        },
    )
    print("", args.output / "peer_sysid.png", args.output / "peer_sysid.json", sep="\n")
    fastest = min((r for r in ratios if r["score"] == max_score(traces, r["peer"])), key=lambda r: r["ratio"])
    return int(fastest["ratio"] < args.at_least)


def max_score(traces: list[Trace], peer: str) -> float:
    """The lowest score that ours and a peer both reach."""
    return max(trace.score[-1] for trace in traces if trace.solver in (OURS, peer))


if __name__ == "__main__":
    sys.exit(run_cli(main))
