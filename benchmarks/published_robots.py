"""Fit robots that others have published, straight from their model files, on recordings by plain MuJoCo.

    python benchmarks/published_robots.py run FILE --output data/published [--seconds 20] [--hide quadratic]
    python benchmarks/published_robots.py table data/published

The file's own actuators move the robot (a file without actuators: a PD loop at the control rate, stated in the
recording) at a fine step that is not the fit's; armature, friction, bias and noise are ours, and the command is late.
Then the command lines run as a user's would, with nothing written by hand: ``fit``, and on a recording with a hidden
effect on the two joints that move most ``fit`` and ``diagnose``, with a second recording held out, of another motion:
the last third of a chirp is its fast end, which hardly shows friction. Each step is kept, so that a run that was broken
off goes on.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from published_plant import HIDDEN, Truth, record

from pace_optim.recording import Recording, save_recording

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
SECONDS = 20.0
GROUPS = ("armature", "viscous_friction", "friction", "encoder_bias")


def call(script: str, *arguments: object, log: Path) -> tuple[str, float, float]:
    """Run a command line; returns its output, its wall time and its processor time [s]."""
    started, before = time.monotonic(), os.times()
    done = subprocess.run(
        [sys.executable, str(SCRIPTS / f"{script}.py"), *map(str, arguments)], capture_output=True, text=True
    )
    after, wall = os.times(), time.monotonic() - started
    used = after.children_user + after.children_system - before.children_user - before.children_system
    log.write_text(done.stdout + done.stderr)
    if done.returncode:
        raise ValueError(f"{script} ended with {done.returncode}: {(done.stderr or done.stdout).strip()[-600:]}")
    return done.stdout, wall, used


def last_run(output: str) -> Path:
    """The folder that a command printed."""
    return Path(re.findall(r"^run: (.*)$", output, re.M)[-1])


def errors(result: dict, truth: Truth) -> dict[str, dict]:
    """Of each group the worst relative error of what is determined (biases: absolute), where, and what is not.

    With its error bar, and the largest error in error bars.
    """
    rows = {}
    for group in GROUPS:
        found, std, right = result["parameters"][group], result["std"][group], getattr(truth, group)
        undetermined = [n for n in truth.joints if f"{group}/{n}" in result["undetermined"]]
        off = {
            name: abs(found[name] - value) / (1.0 if group == "encoder_bias" else abs(value))
            for name, value in zip(truth.joints, right, strict=True)
            if name not in undetermined
        }
        worst = max(off, key=lambda name: off[name]) if off else None
        value = {} if worst is None else {"error": off[worst], "joint": worst, "std": std[worst]}
        if worst is not None and group != "encoder_bias" and std[worst] is not None:
            value["std"] /= abs(right[truth.joints.index(worst)])
        above = [name for name, error in off.items() if error > 0.02]
        bars = [
            abs(found[name] - value) / bar
            for name, value in zip(truth.joints, right, strict=True)
            if name in off and (bar := std[name])
        ]
        rows[group] = {**value, "undetermined": undetermined, "above_2_percent": above, "bars": max(bars, default=None)}
    return rows


def run(args: argparse.Namespace) -> None:
    """Record, fit and diagnose one robot."""
    path = args.file.resolve()
    name = args.name or path.stem
    folder = args.output / name
    folder.mkdir(parents=True, exist_ok=True)
    row_file = folder / "row.json"
    row = json.loads(row_file.read_text()) if row_file.is_file() else {"robot": name, "seconds": args.seconds}
    command, other = folder / "command.csv", folder / "held_out.csv"
    for file, motion in ((command, "chirp"), *([(other, "multisine")] if args.hide else [])):
        if not file.is_file():
            call(
                *("data_collection", "--task", path, "--command_only", "--export_command", file, "--no_plot"),
                *("--duration", args.seconds, "--max_frequency", args.max_frequency, "--excitation", motion),
                log=folder / "command.log",
            )
    step, moves = None if args.own_step else args.step, ()
    for hidden in (None, args.hide) if args.hide else (None,):
        kind = hidden or "plain"
        data, held_out = folder / f"{kind}.npz", folder / f"{kind}_held_out.npz"
        recording, truth = record(path, command, step, args.seed, hidden, moves)
        moves = moving_most(recording)
        if not data.is_file():
            save_recording(data, recording)
        if hidden and not held_out.is_file():
            save_recording(held_out, record(path, other, step, args.seed, truth=truth)[0])
        if f"fit_{kind}" not in row:
            out, wall, used = call(
                *("fit", "--task", path, "--data", data, "--log_dir", folder / "logs", *args.fit_options),
                *(("--validation", held_out) if hidden else ()),
                log=folder / f"fit_{kind}.log",
            )
            result = json.loads((last_run(out) / "result.json").read_text())
            row["joints"] = len(truth.joints)
            row[f"fit_{kind}"] = {
                "run": str(last_run(out)),
                "wall_s": wall,
                "processor_s": used,
                "delay_ms": 1e3 * result["delay_s"],
                "delay_truth_ms": 1e3 * truth.delay,
                "rmse_mrad": 1e3 * result["rmse"]["train"]["all"],
                "validation_mrad": 1e3 * result["rmse"]["validation"]["all"],
                "errors": errors(result, truth),
                "warnings": result.get("warnings", []),
            }
            row_file.write_text(json.dumps(row, indent=1))
        if hidden and f"diagnose_{kind}" not in row and not args.no_diagnosis:
            out, wall, used = call(
                "diagnose", row[f"fit_{kind}"]["run"], "--no_refit", "--max_effects", 1, log=folder / "diagnose.log"
            )
            diagnosis = json.loads((Path(row[f"fit_{kind}"]["run"]) / "diagnosis.json").read_text())
            row[f"diagnose_{kind}"] = {
                "wall_s": wall,
                "processor_s": used,
                "verdict": diagnosis["verdict"],
                "added": diagnosis["added"],
                "truth": truth.hidden_on,
            }
            row_file.write_text(json.dumps(row, indent=1))
    print(table([row]))


def moving_most(recording: Recording) -> tuple[str, ...]:
    """The two joints that move furthest: friction shows on them."""
    order = np.argsort(-np.ptp(recording.dof_pos, axis=0))
    return tuple(recording.joint_names[i] for i in order[:2])


def bar(factor: float, std: float | None) -> str:
    """An error bar; a parameter at its bound has none."""
    return "?" if std is None else f"{factor * std:.1g}"


def table(rows: list[dict]) -> str:
    """Rows as a table of Markdown."""
    lines = [
        "| robot | joints | fit [s] (processor) | error [mrad] | delay [ms] | armature | viscous | Coulomb | "
        "bias [mrad] | undetermined | diagnosed | [s] |",
        "|" + "---|" * 12,
    ]
    for row in rows:
        fit = row.get("fit_plain")
        if fit is None:
            continue
        groups = fit["errors"]
        cells = [
            "none" if "error" not in groups[g] else f"{100 * groups[g]['error']:.2g} % ± {bar(100, groups[g]['std'])}"
            for g in GROUPS[:3]
        ]
        bias = groups["encoder_bias"]
        cells.append("none" if "error" not in bias else f"{1e3 * bias['error']:.2g} ± {bar(1e3, bias['std'])}")
        left = sum(len(groups[g]["undetermined"]) for g in GROUPS)
        found = next((row[key] for key in row if key.startswith("diagnose_")), None)
        kind = next((key.removeprefix("diagnose_") for key in row if key.startswith("diagnose_")), "")
        said = "" if found is None else f"{kind} on {' '.join(found['truth'])}: {found['verdict']} {found['added']}"
        lines.append(
            f"| {row['robot']} | {row['joints']} | {fit['wall_s']:.0f} ({fit['processor_s']:.0f}) | "
            f"{fit['rmse_mrad']:.3g} / {fit['validation_mrad']:.3g} | "
            f"{fit['delay_ms']:.3f} of {fit['delay_truth_ms']:.3g} | {' | '.join(cells)} | "
            f"{left} | {said} | {'' if found is None else format(found['wall_s'], '.0f')} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run a subcommand."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("run", help="record, fit and diagnose one robot")
    one.add_argument("file", type=Path, help="MJCF or URDF")
    one.add_argument("--output", type=Path, default=Path("data/published"))
    one.add_argument("--name", help="of its folder (default: the file's)")
    one.add_argument("--seconds", type=float, default=SECONDS)
    one.add_argument("--max_frequency", type=float, default=10.0)
    one.add_argument("--seed", type=int, default=0)
    one.add_argument("--step", type=float, default=0.0001, help="physics step of the recording [s]")
    one.add_argument("--own_step", action="store_true", help="step and integrator of the file")
    one.add_argument("--hide", choices=HIDDEN, help="record and diagnose a hidden effect too")
    one.add_argument("--no_diagnosis", action="store_true")
    one.add_argument("--fit_options", nargs="*", default=[], help="more options of fit, without their dashes")
    show = commands.add_parser("table", help="print the table of what has been run")
    show.add_argument("folder", type=Path)
    args = parser.parse_args()
    if args.command == "table":
        print(table([json.loads(path.read_text()) for path in sorted(args.folder.glob("*/row.json"))]))
        return
    args.fit_options = [f"--{word}" if word.isidentifier() else word for word in args.fit_options]
    run(args)


if __name__ == "__main__":
    main()
