"""Model files with one wrong link, and correct ones: does a fit with ``--links`` find it, and a diagnosis name it?

    python benchmarks/links.py                     # all cases, then the table
    python benchmarks/links.py --only ur5e         # of some robots
    python benchmarks/links.py --table             # of what is done
    python benchmarks/links.py --labels torque     # with measured torques and without stated gains

Plants are plain MuJoCo robots of public wheels (`wheel_plant.py`, which shares no code with the project): PD loops at
1 kHz, encoder noise of 0.1 mrad. The plant has the file's links; the fit gets a copy of the file with one deliberate
error, or the plant carries a tool that the file does not have. Sensors of torques have scales within 5 % of 1, offsets
of 2 % and noise of 1 % of the torque. Wheels, logs and runs lie in the cache of
`wheel_robots.py`. Each finished case is a line of `CACHE/results_links.jsonl`.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import time
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
from wheel_plant import Drives, Plant, commands, draw, load, log
from wheel_robots import CACHE, GROUPS, ROOT, Robot, _write_log, model_file

from pace_optim.diagnosis.wrong_links import find_wrong_links
from pace_optim.run.open import open_problem
from pace_optim.run.result import FitResult

SECONDS, HELD_OUT_SECONDS = 10.0, 6.0
_ERD = "cmeel.prefix/share/example-robot-data/robots"
_SUITE = "robosuite/models/assets/robots"
ROBOTS = {
    "ur5e": Robot("ur5e", "robosuite==1.5.2", f"{_SUITE}/ur5e/robot.xml"),
    "panda": Robot("panda", "robosuite==1.5.2", f"{_SUITE}/panda/robot.xml"),
    "bolt": Robot("bolt", "example-robot-data==6.0.0", f"{_ERD}/bolt_description/robots/bolt.urdf"),
}


@dataclass(frozen=True)
class Case:
    """A robot and what is wrong with its file."""

    robot: str
    kind: str
    """``clean``, ``mass``, ``com`` or ``tool``."""
    link: str = ""
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How far the file's centre of mass is from the true one [m]."""
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where 0.5 kg sit on the link, in its frame [m]."""
    seed: int = 0

    @property
    def name(self) -> str:
        """Of its files."""
        return "_".join(filter(None, (self.kind, self.link, str(self.seed) if self.seed else "")))


TOO_HEAVY, TOOL = 1.15, 0.5
CASES = (
    *(Case(robot, "clean") for robot in ROBOTS),
    Case("ur5e", "mass", "forearm_link"),
    Case("panda", "mass", "link4"),
    Case("bolt", "mass", "FL_LOWER_LEG"),
    Case("ur5e", "com", "upper_arm_link", com=(0.02, 0.0, 0.0)),
    Case("panda", "com", "link2", com=(0.0, 0.0, 0.02)),
    Case("bolt", "com", "FL_UPPER_LEG", com=(0.02, 0.0, 0.0)),
    Case("ur5e", "tool", "wrist_3_link", tool=(0.0, 0.178, 0.0)),
    Case("panda", "tool", "link7", tool=(0.0, 0.0, 0.187)),
)


def wrong_file(case: Case, cache: Path) -> Path:
    """The model file that the fit gets, beside the robot's own."""
    path = model_file(ROBOTS[case.robot], cache)
    if case.kind in ("clean", "tool"):
        return path
    tree = ElementTree.parse(path)
    if path.suffix == ".urdf":
        inertial = next(e for e in tree.iter("link") if e.get("name") == case.link).find("inertial")
        mass, place, key, inertia = inertial.find("mass"), inertial.find("origin"), "xyz", inertial.find("inertia")
        mass_key = "value"
    else:
        inertial = next(e for e in tree.iter("body") if e.get("name") == case.link).find("inertial")
        mass = place = inertia = inertial
        key, mass_key = "pos", "mass"
    if case.kind == "mass":
        mass.set(mass_key, f"{TOO_HEAVY * float(mass.get(mass_key)):.8g}")
        for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz", "diaginertia", "fullinertia"):
            if (text := inertia.get(name)) is not None:
                inertia.set(name, " ".join(f"{TOO_HEAVY * float(word):.8g}" for word in text.split()))
    else:
        at = [float(word) + by for word, by in zip(place.get(key).split(), case.com, strict=True)]
        place.set(key, " ".join(f"{word:.8g}" for word in at))
    wrong = path.with_name(f"{path.stem}_{case.name}{path.suffix}")
    tree.write(wrong)
    return wrong


def true_plant(case: Case, path: Path) -> Plant:
    """The robot as it is, with its tool."""
    plant = load(path)
    if case.kind == "tool":
        model, b = plant.model, plant.model.body(case.link).id
        before, com = float(model.body_mass[b]), model.body_ipos[b].copy()
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_iquat[b])
        turn = turn.reshape(3, 3)
        inertia = turn @ np.diag(model.body_inertia[b]) @ turn.T
        centre = (before * com + TOOL * np.array(case.tool)) / (before + TOOL)
        for mass, place in ((before, com), (TOOL, np.array(case.tool))):
            arm = place - centre
            inertia = inertia + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        moments, axes = np.linalg.eigh(inertia)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, axes.ravel())
        model.body_mass[b], model.body_ipos[b] = before + TOOL, centre
        model.body_inertia[b], model.body_iquat[b] = moments, quat
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return plant


def make_logs(case: Case, cache: Path, sensed: bool) -> tuple[Path, Path, Drives]:
    """Log and held-out log of a case, made where they are not in the cache; with torques they state no gains."""
    path = model_file(ROBOTS[case.robot], cache)
    folder = cache / "links" / case.robot
    folder.mkdir(parents=True, exist_ok=True)
    seed = zlib.crc32(case.robot.encode()) % 10_000 + case.seed
    drives = draw(load(path), seed)
    drives = replace(drives, rate=400.0)
    kind = f"{case.name if case.kind == 'tool' else f'clean_{case.seed}'}_{SECONDS:g}s{'_torque' if sensed else ''}"
    files = folder / f"{kind}.csv", folder / f"{kind}_held_out.csv"
    for number, (file, seconds) in enumerate(zip(files, (SECONDS, HELD_OUT_SECONDS), strict=True), start=1):
        if not file.is_file():
            target = commands(drives, seconds, seed + number)
            plant = true_plant(case, path)
            torques = np.zeros_like(target) if sensed else None
            _write_log(file, plant, drives, target, log(plant, drives, target, seed + 10 * number, torques))
            if torques is not None:
                _add_torques(file, drives, torques, seed, number)
    return *files, drives


def _add_torques(file: Path, drives: Drives, torques: np.ndarray, seed: int, number: int) -> None:
    """Columns of what sensors show of torques (T, n) [N m]; the log's gains are not stated any more."""
    size, n = torques.std(axis=0), len(drives.joints)
    sensors, noise = np.random.default_rng(seed), np.random.default_rng(seed + 100 * number)
    shown = torques * sensors.uniform(0.95, 1.05, n) + sensors.uniform(-0.02, 0.02, n) * size
    shown += 0.01 * size * noise.normal(size=torques.shape)
    lines = file.read_text().splitlines()
    lines[0] += "".join(f",dof_effort/{joint}" for joint in drives.joints)
    lines[1:] = [
        f"{line},{','.join(f'{value:.8g}' for value in row)}" for line, row in zip(lines[1:], shown, strict=True)
    ]
    file.write_text("\n".join(lines) + "\n")
    facts = {key: value for key, value in drives.facts().items() if key not in ("stiffness", "damping")}
    file.with_suffix(".json").write_text(json.dumps(facts))


def truth_of(case: Case, path: Path) -> tuple[float, np.ndarray]:
    """Mass and centre of mass of the case's link in the plant."""
    model = true_plant(case, path).model
    b = model.body(case.link).id
    return float(model.body_mass[b]), model.body_ipos[b].copy()


def run_case(case: Case, options: list[str], label: str, name: bool, cache: Path) -> dict:
    """Fit one robot as a user would, and perhaps ask which link is wrong; returns its line."""
    data, held_out, drives = make_logs(case, cache, label == "torque")
    runs = cache / "runs" / "links" / label / case.robot / case.name
    runs.mkdir(parents=True, exist_ok=True)
    words = [sys.executable, ROOT / "scripts" / "fit.py", "--task", wrong_file(case, cache), "--data", data]
    words += [
        "--validation",
        held_out,
        "--log_dir",
        runs,
        "--drive_dt",
        "0.001",
        *options,
    ]
    started = time.monotonic()
    with (runs / "output.log").open("w") as output:
        code = subprocess.run(list(map(str, words)), stdout=output, stderr=subprocess.STDOUT, check=False).returncode
    text = (runs / "output.log").read_text(errors="replace")
    row = {"robot": case.robot, "case": case.name, "label": label, "exit": code, "wall_s": time.monotonic() - started}
    folder = next(iter(re.findall(r"^run: (.*)$", text, re.M)[::-1]), None)
    if folder is None:
        return row
    result = json.loads((Path(folder) / "result.json").read_text())
    row["held_out_mrad"] = 1e3 * result["rmse"]["validation"]["all"]
    row["drive_error"] = drive_errors(result, drives.truth())
    if label == "torque":
        row["drive_error"] |= gain_errors(result, drives)
    if case.link and case.link in result.get("links", {}):
        mass, com = truth_of(case, model_file(ROBOTS[case.robot], cache))
        found = result["links"][case.link]
        row["mass_error"] = found["mass"] / mass - 1
        row["com_error_mm"] = 1e3 * float(np.linalg.norm(np.array(found["com"]) - com))
    row["links"] = sorted(result.get("links", {}))
    return row | (named(folder) if name else {})


def named(run: str) -> dict:
    """What the first step of a diagnosis says of the links, from a fit with the file alone."""
    started = time.monotonic()
    result = FitResult.load(run)
    problem = open_problem(run)
    found = find_wrong_links(problem, problem.space.from_dict(result.parameters))
    return {
        "named": [each.label for each in found.wrong],
        "said": [*(each.sentence for each in found.wrong), *found.sentences],
        "named_s": time.monotonic() - started,
    }


def drive_errors(result: dict, truth: dict) -> dict[str, float]:
    """Largest relative error of each kind of parameter over the joints on which it is determined."""
    errors: dict[str, float] = {}
    for group in GROUPS[:3]:
        for joint, value in truth[group].items():
            if f"{group}/{joint}" not in result["undetermined"]:
                error = abs(result["parameters"][group][joint] / value - 1)
                errors[group] = max(errors.get(group, 0.0), error)
    return errors


def gain_errors(result: dict, drives: Drives) -> dict[str, float]:
    """Largest relative error of the gains, which a fit finds as factors of what it read from the torques."""
    errors = {}
    for name, gain in (("stiffness", "proportional_gain.gain"), ("damping", "derivative_gain.gain")):
        factors, laws = result["parameters"].get(gain, {}), result["measured_drive"]
        found = [factors.get(j, 1.0) * next(iter(laws[j].values()))[name] for j in drives.joints]
        errors[name] = float(np.abs(np.array(found) / getattr(drives, name) - 1).max())
    return errors


def table(rows: list[dict]) -> str:
    """What is done, as Markdown."""
    lines = [
        "| robot | file | fit | held out [mrad] | mass error | centre off [mm] | drives off | named |",
        "|" + "---|" * 8,
    ]
    for row in rows:
        drives = ", ".join(f"{name} {100 * value:.1f} %" for name, value in row.get("drive_error", {}).items())
        mass = f"{100 * row['mass_error']:+.1f} %" if "mass_error" in row else ""
        com = f"{row['com_error_mm']:.2g}" if "com_error_mm" in row else ""
        named = ", ".join(row["named"]) or "nothing" if "named" in row else ""
        held_out = f"{row['held_out_mrad']:.3g}" if "held_out_mrad" in row else f"exit {row['exit']}"
        lines.append(
            f"| {row['robot']} | {row['case']} | {row['label']} | {held_out} | {mass} | {com} | {drives} | {named} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run what is asked for, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=list(ROBOTS), metavar="ROBOT")
    parser.add_argument("--kinds", nargs="+", default=["clean", "mass", "com", "tool"], metavar="KIND")
    parser.add_argument(
        "--labels",
        nargs="+",
        default=["file", "links"],
        help="file: with the file alone; links: with --links; torque: that with measured torques, no stated gains",
    )
    parser.add_argument("--table", action="store_true", help="print what is done, run nothing")
    parser.add_argument("--cache", type=Path, default=CACHE)
    args = parser.parse_args()
    done = args.cache / "results_links.jsonl"
    rows = [json.loads(line) for line in done.read_text().splitlines()] if done.is_file() else []
    for case in () if args.table else CASES:
        if case.robot not in args.only or case.kind not in args.kinds:
            continue
        for label in args.labels:
            if label == "links" and not case.link:
                continue
            seeks = label != "file" and case.link
            parts = {"mass": "mass", "com": "com", "tool": "load"}.get(case.kind)
            options = ["--links", f"{case.link}@{parts}"] if seeks else []
            row = run_case(case, options, label, label == "file", args.cache)
            rows = [r for r in rows if (r["robot"], r["case"], r["label"]) != (case.robot, case.name, label)] + [row]
            done.write_text("".join(json.dumps(r) + "\n" for r in rows))
            print(json.dumps(row), flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
