"""What the checks of a log name: faults that are put into clean recordings, and alarms on clean ones.

    python benchmarks/log_checks.py                                    # ten inputs of each kind, and the table
    python benchmarks/log_checks.py --kinds swapped gravity --seeds 3
    python benchmarks/log_checks.py --clean ../shared/cases data/real   # alarms on recordings at hand

A robot of two to four joints is drawn by a seed and simulated by plain MuJoCo at 0.25 ms; its drives hold their torque
over 2.5 ms. Faults of a log are made by changing the recording. Faults of the model or the drive are made by simulating
another robot than the one that is stated.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np
from cases import CASES

from pace_envs.task_source import use_task
from pace_optim.identification.log_checks import Finding, check_log
from pace_optim.problem.problem import Problem, load_problem
from pace_optim.recording import Drive, Recording, save_recording

CONTROL_DT, PLANT_DT, DURATION, NOISE = 0.0025, 0.00025, 6.0, 1e-4


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A robot that was drawn: its model, and what the model does not say."""

    axes: tuple[tuple[float, ...], ...]
    lengths: tuple[float, ...]
    masses: tuple[float, ...]
    branches: bool
    """Whether the last joint hangs on the base, beside the others."""
    centre: np.ndarray
    """Of the motion, (n,) [rad]."""
    amplitude: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    armature: np.ndarray
    viscous: np.ndarray
    friction: np.ndarray
    bias: np.ndarray
    delay: float
    """[s]."""
    limit: np.ndarray | float = np.inf
    """(n,) [N m]."""
    cut: np.ndarray | None = None
    """Range in which the drives take targets, (n, 2) [rad]."""
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Euler angles of its base [rad]."""
    ranges: np.ndarray | None = None
    """That the model states, (n, 2) [rad]."""

    @classmethod
    def drawn(cls, seed: int) -> Robot:
        """The robot of a seed."""
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 5))
        lengths, masses = rng.uniform(0.15, 0.35, n), rng.uniform(0.4, 1.5, n)
        inertia = np.array([sum(masses[i:] * np.cumsum(lengths[i:]) ** 2) for i in range(n)])
        frequency = rng.uniform(2.0, 4.0, n)
        stiffness = (2 * np.pi * frequency) ** 2 * inertia
        return cls(
            axes=tuple(((0.0, 1.0, 0.0), (1.0, 0.0, 0.0))[int(rng.random() < 0.4)] for _ in range(n)),
            lengths=tuple(lengths),
            masses=tuple(masses),
            branches=bool(n > 2 and rng.random() < 0.5),
            centre=rng.uniform(-0.8, 0.8, n),
            amplitude=rng.uniform(0.25, 0.6, n),
            stiffness=stiffness,
            damping=rng.uniform(0.3, 0.8, n) * np.sqrt(stiffness * inertia),
            armature=rng.uniform(0.1, 0.4, n) * inertia,
            viscous=rng.uniform(0.02, 0.1, n) * np.sqrt(stiffness * inertia),
            friction=rng.uniform(0.01, 0.05, n) * stiffness * 0.4,
            bias=rng.uniform(-0.02, 0.02, n),
            delay=float(rng.uniform(0.0, 0.01)),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Of its joints."""
        return tuple(f"j{i}" for i in range(len(self.axes)))

    def model(self) -> str:
        """Its MJCF: links that hang down, the mass in their middle."""
        text, opened = "", 0
        for i, (axis, length, mass) in enumerate(zip(self.axes, self.lengths, self.masses, strict=True)):
            last = i == len(self.axes) - 1
            if last and self.branches:
                text, opened = text + "</body>" * opened, 0
            place = f"0 {0.3 * (last and self.branches)} 0" if not opened else f"0 0 {-self.lengths[i - 1]}"
            low_high = "" if self.ranges is None else f'range="{self.ranges[i, 0]} {self.ranges[i, 1]}" limited="true"'
            thin, wide = 0.1 * mass * length**2, mass * length**2 / 12
            text += (
                f'<body name="b{i}" pos="{place}"><joint name="j{i}" axis="{axis[0]} {axis[1]} {axis[2]}" {low_high}/>'
                f'<inertial pos="0.02 0.01 {-length / 2}" mass="{mass}" diaginertia="{wide} {wide} {thin}"/>'
            )
            opened += 1
        motors = "".join(f'<motor joint="{name}"/>' for name in self.names)
        euler = " ".join(str(angle) for angle in self.tilt)
        return (
            f'<mujoco><compiler angle="radian"/><worldbody><body euler="{euler}">{text}{"</body>" * opened}</body>'
            f"</worldbody><actuator>{motors}</actuator></mujoco>"
        )

    def targets(self, seed: int) -> np.ndarray:
        """A chirp of every joint, (T, n) [rad]."""
        t = np.arange(0, DURATION, CONTROL_DT)[:, None]
        rng = np.random.default_rng(1000 + seed)
        first, last = rng.uniform(0.1, 0.4, len(self.axes)), rng.uniform(2.5, 4.5, len(self.axes))
        phase = 2 * np.pi * (first * t + (last - first) * t**2 / (2 * DURATION))
        return self.centre + self.amplitude * np.sin(phase)

    def record(self, seed: int) -> Recording:
        """Simulate it, from rest at its first target."""
        model = mujoco.MjModel.from_xml_string(replace(self, ranges=None).model())
        model.opt.timestep, model.opt.integrator = PLANT_DT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.dof_armature[:], model.dof_damping[:], model.dof_frictionloss[:] = (
            self.armature, self.viscous, self.friction,
        )  # fmt: skip
        model.dof_solref[:], model.dof_solimp[:] = (2 * PLANT_DT, 1.0), (0.999, 0.999, 0.001, 0.5, 2.0)
        data, target = mujoco.MjData(model), self.targets(seed)
        heard = target if self.cut is None else np.clip(target, self.cut[:, 0], self.cut[:, 1])
        data.qpos[:] = heard[0]
        shown = np.zeros_like(target)
        for k in range(-round(1 / CONTROL_DT), len(target)):
            position = data.qpos - self.bias
            if k >= 0:
                shown[k] = position
            late = min(max(0, int(np.floor((k * CONTROL_DT - self.delay) / CONTROL_DT))), len(target) - 1)
            torque = self.stiffness * (heard[late] - position) - self.damping * data.qvel
            data.ctrl[:] = np.clip(torque, -self.limit, self.limit)
            mujoco.mj_step(model, data, round(CONTROL_DT / PLANT_DT))
        noise = np.random.default_rng(2000 + seed).normal(0, NOISE, shown.shape)
        return Recording(
            name="log",
            joint_names=self.names,
            time=CONTROL_DT * np.arange(len(target)),
            dof_pos=shown + noise,
            des_dof_pos=target,
            drive=Drive(stiffness=self.stiffness, damping=self.damping),
        )


@dataclass(frozen=True, kw_only=True)
class Input:
    """What is handed to a fit, and what is right to say of it."""

    robot: Robot
    """As the model states it."""
    recording: Recording
    check: str
    """Name of the check that must speak; empty: none may."""
    joints: tuple[str, ...] = field(default=())
    """That it must name."""


def _columns(recording: Recording, j: int, **changed: np.ndarray) -> Recording:
    series = {}
    for name, values in changed.items():
        series[name] = getattr(recording, name).copy()
        series[name][:, j] = values
    return replace(recording, **series)


def make(kind: str, seed: int) -> Input:
    """The input of a kind and a seed."""
    rng, robot = np.random.default_rng(3000 + seed), Robot.drawn(seed)
    j = int(rng.integers(len(robot.axes)))
    name = (robot.names[j],)
    if kind == "wrapped":
        robot = replace(robot, centre=np.where(np.arange(len(robot.centre)) == j, np.pi - 0.1, robot.centre))
    if kind == "limit":
        free = robot.record(seed)
        asked = np.abs(robot.stiffness[j] * (free.des_dof_pos - free.dof_pos)[:, j]).max()
        limit = np.where(np.arange(len(robot.axes)) == j, rng.uniform(0.4, 0.6) * asked, np.inf)
        robot = replace(robot, limit=limit)
    if kind == "gravity":
        robot = replace(robot, tilt=((np.pi / 2, 0, 0), (0, np.pi / 2, 0), (0.6, 0, 0), (np.pi, 0, 0))[seed % 4])
    if kind == "range":
        robot = replace(robot, stiffness=6 * robot.stiffness, damping=4 * robot.damping)  # little overshoot
        width = robot.amplitude * rng.uniform(0.5, 0.7)
        robot = replace(robot, cut=np.column_stack([robot.centre - width, robot.centre + width]))
    log = robot.record(seed)
    q, target = log.dof_pos[:, j], log.des_dof_pos[:, j]
    if kind == "clean":
        return Input(robot=robot, recording=log, check="")
    if kind == "sign_positions":
        return Input(robot=robot, recording=_columns(log, j, dof_pos=-q), check="reversed sign", joints=name)
    if kind == "sign_targets":
        return Input(robot=robot, recording=_columns(log, j, des_dof_pos=-target), check="reversed sign", joints=name)
    if kind == "negative_axis":
        return Input(
            robot=robot, recording=_columns(log, j, dof_pos=-q, des_dof_pos=-target), check="reversed sign", joints=name
        )
    if kind in ("swapped", "swapped_targets"):
        other = (j + 1) % len(robot.axes)
        order = list(range(len(robot.axes)))
        order[j], order[other] = other, j
        series = {"des_dof_pos": log.des_dof_pos[:, order]}
        series |= {"dof_pos": log.dof_pos[:, order]} if kind == "swapped" else {}
        pair = tuple(robot.names[i] for i in sorted((j, other)))
        return Input(robot=robot, recording=replace(log, **series), check="swapped joints", joints=pair)
    if kind == "wrapped":
        wrapped = (target + np.pi) % (2 * np.pi) - np.pi
        return Input(robot=robot, recording=_columns(log, j, des_dof_pos=wrapped), check="wrapped targets", joints=name)
    if kind == "frozen":
        first, width = int(rng.uniform(0.3, 0.6) * len(q)), int(rng.uniform(0.2, 1.0) / CONTROL_DT)
        held = q.copy()
        held[first : first + width] = q[first]
        return Input(robot=robot, recording=_columns(log, j, dof_pos=held), check="frozen encoder", joints=name)
    if kind == "dead":
        return Input(robot=robot, recording=_columns(log, j, dof_pos=0 * q + q[0]), check="standstill", joints=name)
    if kind == "still":
        held = log.dof_pos[:1] + rng.normal(0, NOISE, log.dof_pos.shape)
        return Input(robot=robot, recording=replace(log, dof_pos=held), check="standstill", joints=robot.names)
    if kind == "cut_log":
        low, high = np.quantile(target, [rng.uniform(0.05, 0.25), rng.uniform(0.75, 0.95)])
        cut = np.clip(target, low, high)
        return Input(robot=robot, recording=_columns(log, j, des_dof_pos=cut), check="clipped targets", joints=name)
    if kind == "range":
        robot = replace(robot, ranges=robot.cut)
        return Input(robot=robot, recording=log, check="clipped targets", joints=name)
    if kind == "motor_side":
        ratio = (3.0, 5.0, 6.33, 9.0, 10.0, 16.0, 24.0, 36.0, 50.0, 100.0)[seed % 10]
        series = {"dof_pos": ratio * log.dof_pos, "des_dof_pos": ratio * log.des_dof_pos}
        return Input(robot=robot, recording=replace(log, **series), check="scale", joints=robot.names)
    if kind == "limit":
        stated = replace(robot, limit=np.inf)
        return Input(robot=stated, recording=log, check="torque limit", joints=name)
    if kind == "gravity":
        return Input(robot=replace(robot, tilt=(0.0, 0.0, 0.0)), recording=log, check="gravity")
    if kind == "spikes":
        q = q.copy()
        q[rng.choice(np.arange(100, len(q) - 100), 4)] += rng.choice([-1, 1], 4) * rng.uniform(0.5, 2.0, 4)
        return Input(robot=robot, recording=_columns(log, j, dof_pos=q), check="spikes", joints=name)
    raise ValueError(f"There is no kind {kind!r}. Available: {', '.join(KINDS)}.")


KINDS = (
    "clean", "sign_positions", "sign_targets", "negative_axis", "swapped", "swapped_targets", "wrapped", "frozen",
    "dead", "still", "cut_log", "range", "motor_side", "limit", "gravity", "spikes",
)  # fmt: skip


def problem_of(made: Input, folder: Path) -> Problem:
    """What a fit would load."""
    (folder / "robot.xml").write_text(made.robot.model())
    save_recording(folder / "log.npz", made.recording)
    return load_problem(use_task(str(folder / "robot.xml")), data=[folder / "log.npz"], tell=lambda _: None)


def judged(made: Input, found: list[Finding]) -> str:
    """Whether the findings are right: a hit names the check and every joint, and nothing else is named."""
    right = [each for each in found if each.check == made.check]
    named = {joint for each in right for joint in each.joints}
    if len(right) < len(found):
        return "wrong"
    if not made.check:
        return "silent"
    return "hit" if right and set(made.joints) <= named else "miss" if not right else "part"


def run(kinds: list[str], seeds: range) -> None:
    """Make the inputs, check them, print the table."""
    print("| kind | named right | named in part | missed | named wrong | time [s] |\n|---|---|---|---|---|---|")
    for kind in kinds:
        counts: dict[str, int] = {}
        spent, said = 0.0, []
        for seed in seeds:
            made = make(kind, seed)
            with tempfile.TemporaryDirectory() as folder:
                try:
                    problem = problem_of(made, Path(folder))
                except ValueError as error:  # refused before
                    counts["refused"] = counts.get("refused", 0) + 1
                    said.append(f"{seed} refused: {str(error)[-120:]}")
                    continue
                started = time.process_time()
                found = check_log(problem)
                spent += time.process_time() - started
            verdict = judged(made, found)
            counts[verdict] = counts.get(verdict, 0) + 1
            if verdict in ("wrong", "part", "miss"):
                said.append(f"{seed} {verdict} ({', '.join(made.joints)}): {[(f.check, f.joints) for f in found]}")
        right = counts.get("hit", 0) + counts.get("silent", 0)
        cells = [right, counts.get("part", 0), counts.get("miss", 0) + counts.get("refused", 0), counts.get("wrong", 0)]
        print(f"| {kind} | {' | '.join(map(str, cells))} | {spent / len(seeds):.1f} |", flush=True)
        for line in said:
            print(f"    {line}", flush=True)


def clean(folders: list[Path]) -> Iterator[tuple[str, Callable[[], Problem]]]:
    """Recordings without faults: each robot's own sample, and those of folders of the shared kinds."""
    for task in ("Pace-AnymalD-v0", "Pace-Go2-v0", "Pace-SO101-v0", "Pace-TestBench-v0"):
        yield task, lambda task=task: load_problem(task, tell=lambda _: None)
    tasks = {
        "xl330": "Pace-TestBench-v0",
        "sts3250": "Pace-TestBench-v0",
        "so101": "Pace-SO101-v0",
        "go2": "Pace-Go2-v0",
    }
    for folder in folders:
        for name, case in CASES.items():
            if case.logs and (folder / case.logs[0]).exists():
                task = case.task if case.task.startswith("Pace-") else use_task(str(folder / case.task))
                data = [folder / each for each in case.logs]
                yield name, lambda task=task, data=data: load_problem(task, data=data, tell=lambda _: None)
        for kind, task in tasks.items():
            for path in sorted(folder.glob(f"{kind}/*.[cn][sp][vz]")):
                yield f"{kind} {path.stem}", lambda t=task, p=path: load_problem(t, data=[p], tell=lambda _: None)
        for path in sorted(folder.glob("*/plain.npz")):  # of published_robots.py
            row = path.with_name("model.txt")
            if row.exists():
                task = use_task(row.read_text().strip())
                yield path.parent.name, lambda t=task, p=path: load_problem(t, data=[p], tell=lambda _: None)


def run_clean(folders: list[Path]) -> None:
    """Print what is named of clean recordings."""
    alarms = count = 0
    for name, load in clean(folders):
        try:
            found = check_log(load())
        except ValueError as error:
            print(f"{name}: not loaded: {str(error)[:150]}", flush=True)
            continue
        count, alarms = count + 1, alarms + len(found)
        print(f"{name}: {'; '.join(each.sentence for each in found) or 'nothing'}", flush=True)
    print(f"{alarms} alarms on {count} recordings")


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seeds", type=int, default=10, help="inputs of each kind")
    parser.add_argument("--first_seed", type=int, default=0, help="seed of the first input")
    parser.add_argument("--clean", nargs="+", type=Path, metavar="FOLDER", help="count alarms on clean recordings")
    args = parser.parse_args()
    if args.clean is None:
        run(args.kinds, range(args.first_seed, args.first_seed + args.seeds))
    else:
        run_clean(args.clean)


if __name__ == "__main__":
    main()
