"""Model files with wrong links, and correct ones: does a fit with ``--links`` find it, and a diagnosis name it?

    python benchmarks/links.py                     # all cases, then the table
    python benchmarks/links.py --only ur5e         # of some robots
    python benchmarks/links.py --table             # of what is done
    python benchmarks/links.py --labels torque     # with measured torques and without stated gains
    python benchmarks/links.py --workers 16        # so many cases at once

Plants are plain MuJoCo robots of public wheels (`wheel_plant.py`, which shares no code with the project): PD loops at
1 kHz, encoder noise of 0.1 mrad. The plant has the file's links; the fit gets a copy of the file with one or two
deliberate errors, or the plant carries a tool that the file does not have. Sensors of torques have scales within 5 % of
1, offsets of 2 % and noise of 1 % of the torque. Wheels, logs and runs lie in the cache of `wheel_robots.py`. Each
finished case is a line of `CACHE/results_links.jsonl`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
import zlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
from wheel_plant import Drives, Plant, commands, draw, load, log
from wheel_robots import CACHE, GROUPS, ROOT, Robot, _write_log, model_file
from workers import pinned_pool

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
class Wrong:
    """One thing that the file has wrong, or does not have."""

    kind: str
    """``mass``, ``com`` or ``tool``."""
    link: str
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How far the file's centre of mass is from the true one; where a tool sits, in the link's frame [m]."""
    kg: float = 0.5
    """Mass of a tool."""

    @property
    def label(self) -> str:
        """As ``--links`` takes it."""
        return f"{self.link}@{'load' if self.kind == 'tool' else self.kind}"


@dataclass(frozen=True)
class Case:
    """A robot and what is wrong with its file."""

    robot: str
    wrong: tuple[Wrong, ...] = ()
    seed: int = 0

    @property
    def name(self) -> str:
        """Of its files."""
        words = [word for each in self.wrong for word in (each.kind, each.link)] or ["clean"]
        return "_".join([*words, *([str(self.seed)] if self.seed else [])])

    @property
    def kind(self) -> str:
        """``clean``, ``mass``, ``com``, ``tool`` or ``two``."""
        return "two" if len(self.wrong) > 1 else self.wrong[0].kind if self.wrong else "clean"

    @property
    def tools(self) -> tuple[Wrong, ...]:
        """What the plant carries."""
        return tuple(each for each in self.wrong if each.kind == "tool")


TOO_HEAVY = 1.15
UR5E_TOOL, PANDA_TOOL = (0.0, 0.178, 0.0), (0.0, 0.0, 0.187)
CASES = (
    Case("ur5e", (Wrong("mass", "forearm_link"),)),
    Case("panda", (Wrong("mass", "link4"),)),
    Case("bolt", (Wrong("mass", "FL_LOWER_LEG"),)),
    Case("ur5e", (Wrong("com", "upper_arm_link", (0.02, 0.0, 0.0)),)),
    Case("panda", (Wrong("com", "link2", (0.02, 0.0, 0.0)),)),
    Case("bolt", (Wrong("com", "FL_UPPER_LEG", (0.02, 0.0, 0.0)),)),
    Case("ur5e", (Wrong("tool", "wrist_3_link", UR5E_TOOL),)),
    Case("panda", (Wrong("tool", "link7", PANDA_TOOL),)),
    Case("bolt", (Wrong("tool", "FL_LOWER_LEG", (0.0, 0.008, -0.2), 0.03),)),  # at the foot of a robot of 1.3 kg
    Case("ur5e", (Wrong("com", "upper_arm_link", (0.02, 0.0, 0.0)), Wrong("mass", "forearm_link"))),
    Case("panda", (Wrong("mass", "link4"), Wrong("tool", "link7", PANDA_TOOL))),
    Case("bolt", (Wrong("mass", "FL_LOWER_LEG"), Wrong("com", "FR_UPPER_LEG", (0.02, 0.0, 0.0)))),
    *[Case(robot, seed=seed) for seed in range(4) for robot in ROBOTS][:10],
)


def wrong_file(case: Case, cache: Path) -> Path:
    """The model file that the fit gets, beside the robot's own."""
    path = model_file(ROBOTS[case.robot], cache)
    errors = [each for each in case.wrong if each.kind != "tool"]
    if not errors:
        return path
    tree = ElementTree.parse(path)
    for each in errors:
        _make_wrong(tree, each, path.suffix == ".urdf")
    wrong = path.with_name(f"{path.stem}_{case.name}{path.suffix}")
    partial = wrong.with_name(f"{wrong.name}.{os.getpid()}")  # another process may make it too
    tree.write(partial)
    return partial.rename(wrong)


def _make_wrong(tree: ElementTree.ElementTree, error: Wrong, urdf: bool) -> None:
    if urdf:
        inertial = next(e for e in tree.iter("link") if e.get("name") == error.link).find("inertial")
        mass, place, key, inertia = inertial.find("mass"), inertial.find("origin"), "xyz", inertial.find("inertia")
        mass_key = "value"
    else:
        inertial = next(e for e in tree.iter("body") if e.get("name") == error.link).find("inertial")
        mass = place = inertia = inertial
        key, mass_key = "pos", "mass"
    if error.kind == "mass":
        mass.set(mass_key, f"{TOO_HEAVY * float(mass.get(mass_key)):.8g}")
        for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz", "diaginertia", "fullinertia"):
            if (text := inertia.get(name)) is not None:
                inertia.set(name, " ".join(f"{TOO_HEAVY * float(word):.8g}" for word in text.split()))
    else:
        at = [float(word) + by for word, by in zip(place.get(key).split(), error.at, strict=True)]
        place.set(key, " ".join(f"{word:.8g}" for word in at))


def true_plant(case: Case, path: Path) -> Plant:
    """The robot as it is, with its tools."""
    plant = load(path)
    for tool in case.tools:
        model, b = plant.model, plant.model.body(tool.link).id
        before, com = float(model.body_mass[b]), model.body_ipos[b].copy()
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_iquat[b])
        turn = turn.reshape(3, 3)
        inertia = turn @ np.diag(model.body_inertia[b]) @ turn.T
        centre = (before * com + tool.kg * np.array(tool.at)) / (before + tool.kg)
        for mass, place in ((before, com), (tool.kg, np.array(tool.at))):
            arm = place - centre
            inertia = inertia + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        moments, axes = np.linalg.eigh(inertia)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, axes.ravel())
        model.body_mass[b], model.body_ipos[b] = before + tool.kg, centre
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
    carried = "_".join(word for tool in case.tools for word in ("tool", tool.link)) or f"clean_{case.seed}"
    kind = f"{carried}_{SECONDS:g}s{'_torque' if sensed else ''}"
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


def truth_of(case: Case, link: str, path: Path) -> tuple[float, np.ndarray]:
    """Mass and centre of mass of a link in the plant."""
    model = true_plant(case, path).model
    b = model.body(link).id
    return float(model.body_mass[b]), model.body_ipos[b].copy()


def run_case(case: Case, options: list[str], label: str, name: bool, cache: Path) -> dict:
    """Fit one robot as a user would, and perhaps ask which link is wrong; returns its line. A fit is made once."""
    data, held_out, drives = make_logs(case, cache, label == "torque")
    runs = cache / "runs" / "links" / label / case.robot / case.name
    runs.mkdir(parents=True, exist_ok=True)
    row = {"robot": case.robot, "case": case.name, "label": label}
    if (folder := _finished(runs)) is None:
        words = [sys.executable, ROOT / "scripts" / "fit.py", "--task", wrong_file(case, cache), "--data", data]
        words += ["--validation", held_out, "--log_dir", runs, "--drive_dt", "0.001", *options]
        started = time.monotonic()
        with (runs / "output.log").open("w") as output:
            code = subprocess.run(
                list(map(str, words)), stdout=output, stderr=subprocess.STDOUT, check=False
            ).returncode
        row |= {"exit": code, "wall_s": time.monotonic() - started}
        if (folder := _finished(runs)) is None:
            return row
    result = json.loads((folder / "result.json").read_text())
    row["held_out_mrad"] = 1e3 * result["rmse"]["validation"]["all"]
    row["drive_error"] = drive_errors(result, drives.truth())
    if label == "torque":
        row["drive_error"] |= gain_errors(result, drives)
    row["links"] = link_errors(result.get("links", {}), case, cache)
    return row | (named(str(folder), case, drives, cache) if name else {})


def _finished(runs: Path) -> Path | None:
    """The folder of a run that has ended."""
    log_file = runs / "output.log"
    text = log_file.read_text(errors="replace") if log_file.is_file() else ""
    found = re.findall(r"^run: (.*)$", text, re.M)
    return Path(found[-1]) if found and (Path(found[-1]) / "result.json").is_file() else None


def link_errors(links: dict, case: Case, cache: Path) -> dict[str, dict[str, float]]:
    """Of each link that was sought or found: how far its mass and its centre of mass are off."""
    errors = {}
    for link, found in links.items():
        mass, com = truth_of(case, link, model_file(ROBOTS[case.robot], cache))
        off = 1e3 * float(np.linalg.norm(np.array(found["com"]) - com))
        errors[link] = {"mass": found["mass"] / mass - 1, "com_mm": off}
    return errors


def named(run: str, case: Case, drives: Drives, cache: Path) -> dict:
    """What the first step of a diagnosis says of the links, and what the fit beside them finds."""
    started = time.monotonic()
    result = FitResult.load(run)
    problem = open_problem(run)
    found = find_wrong_links(
        problem, problem.space.from_dict(result.parameters), say=lambda text: print(text, flush=True)
    )
    row = {
        "wrong": [each.label for each in case.wrong],
        "named": [each.label for each in found.wrong],
        "said": [*(each.sentence for each in found.wrong), *found.sentences],
        "named_s": time.monotonic() - started,
    }
    if found.wrong:
        row["links"] = link_errors({name: asdict(link) for name, link in found.links.items()}, case, cache)
        beside = {"parameters": found.values, "undetermined": result.undetermined}
        row |= {"refit_mrad": 1e3 * found.after, "refit_error": drive_errors(beside, drives.truth())}
    return row


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
        "| robot | file | fit | held out [mrad] | drives off | links off | named | with these: held out, drives off |",
        "|" + "---|" * 8,
    ]
    for row in rows:
        links = [
            f"`{link}` {100 * off['mass']:+.1f} %, {off['com_mm']:.2g} mm" for link, off in row.get("links", {}).items()
        ]
        named = ", ".join(f"`{each}`" for each in row["named"]) or "nothing" if "named" in row else ""
        held_out = f"{row['held_out_mrad']:.3g}" if "held_out_mrad" in row else f"exit {row['exit']}"
        refit = f"{row['refit_mrad']:.3g}, {_words(row['refit_error'])}" if "refit_error" in row else ""
        cells = row["robot"], row["case"], row["label"], held_out, _words(row.get("drive_error", {}))
        lines.append(f"| {' | '.join([*cells, '; '.join(links), named, refit])} |")
    return "\n".join(lines) + "\n"


def _words(errors: dict[str, float]) -> str:
    return ", ".join(f"{name} {100 * value:.2g} %" for name, value in errors.items())


def main() -> None:
    """Run what is asked for, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=list(ROBOTS), metavar="ROBOT")
    parser.add_argument("--kinds", nargs="+", default=["clean", "mass", "com", "tool", "two"], metavar="KIND")
    parser.add_argument(
        "--labels",
        nargs="+",
        default=["file", "links"],
        help="file: with the file alone; links: with --links; torque: that with measured torques, no stated gains",
    )
    parser.add_argument("--table", action="store_true", help="print what is done, run nothing")
    parser.add_argument("--fits", action="store_true", help="fit only, name no links yet")
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--workers", type=int, default=1, help="processes")
    args = parser.parse_args()
    done = args.cache / "results_links.jsonl"
    jobs = [
        (case, label, label == "file" and not args.fits, args.cache)
        for case in (() if args.table else CASES)
        if case.robot in args.only and case.kind in args.kinds
        for label in args.labels
        if label != "links" or case.wrong
    ]
    logs = {(case.robot, case.tools, case.seed, label == "torque"): (case, label) for case, label, *_ in jobs}
    jobs.sort(key=lambda job: job[0].kind == "clean")  # the shortest last
    for robot in {case.robot for case, *_ in jobs}:
        model_file(ROBOTS[robot], args.cache)
    with pinned_pool(args.workers) as pool, done.open("a", encoding="utf-8") as file:
        pool.starmap(make_logs, [(case, args.cache, label == "torque") for case, label in logs.values()], 1)
        for row in pool.imap_unordered(_run, jobs):
            file.write(json.dumps(row) + "\n")
            file.flush()
            print(json.dumps(row), flush=True)
    lines = (json.loads(line) for line in done.read_text(encoding="utf-8").splitlines())
    print(table(list({(row["robot"], row["case"], row["label"]): row for row in lines}.values())))


def _run(job: tuple[Case, str, bool, Path]) -> dict:
    """One case with one label."""
    case, label, name, cache = job
    options = ["--optimizer", "least_squares"]  # a search by CMA-ES cannot mend a wrong file
    if label != "file" and case.wrong:
        options += ["--links", *(each.label for each in case.wrong)]
    try:
        return run_case(case, options, label, name, cache)
    except Exception as error:  # one case must not end the others
        return {"robot": case.robot, "case": case.name, "label": label, "exit": f"{type(error).__name__}: {error}"}


if __name__ == "__main__":
    main()
