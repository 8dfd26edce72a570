"""A folder with everything that the command lines read, of a robot of one's own: what bad input is made from."""

from __future__ import annotations

import contextlib
import json
import math
import os
import runpy
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import places

ROOT = Path(os.environ.get("PACE_ROOT", places.ROOT))
"""The checkout under test; another one can be held against this one's."""

TASK = "arm:Arm-v0"
WALK = "Pace-Go2-Velocity-v0"
RUN, OTHER, GO2 = "runs/arm/base", "runs/arm/other", "runs/go2/base"
TRAINING = "trainings/base"

_MODEL = """<mujoco model="arm">
 <compiler angle="radian"/>
 <worldbody>
  <body name="upper" pos="0 0 1">
   <joint name="shoulder" type="hinge" axis="0 1 0" range="-2 2"/>
   <inertial pos="0 0 -0.1" mass="0.4" diaginertia="2e-3 2e-3 4e-4"/>
   <body name="lower" pos="0 0 -0.2">
    <joint name="elbow" type="hinge" axis="0 1 0" range="-2 2"/>
    <inertial pos="0 0 -0.1" mass="0.2" diaginertia="1e-3 1e-3 2e-4"/>
   </body>
  </body>
 </worldbody>
</mujoco>
"""

_MODULE = """from pathlib import Path

import torch

from pace_actuators import PaceDCMotorCfg
from pace_actuators.effects import Effect, EffectParameter
from pace_envs import ArticulationCfg, InitialStateCfg, register_task
from pace_envs.tasks.pace import ExcitationCfg, PaceCfg, PaceSim2realEnvCfg, PaceSim2realSceneCfg

JOINTS = ("shoulder", "elbow")


def cfg():
    drive = PaceDCMotorCfg(
        joint_names_expr=".*", stiffness=8.0, damping=0.4, saturation_effort=9.0, effort_limit=6.0,
        velocity_limit=9.0, max_delay=10.0,
    )
    robot = ArticulationCfg(
        mjcf_path=Path(__file__).parent / "arm.xml", init_state=InitialStateCfg(joint_pos={".*": 0.2}),
        actuators={"all": drive}, joint_order=JOINTS,
    )
    bounds = dict(
        armature=(1e-5, 0.1), viscous_friction=(0.0, 1.0), friction=(0.0, 0.5), encoder_bias=(-0.1, 0.1),
        delay=(0.0, 10.0),
    )
    sim2real = PaceCfg(
        robot_name="arm", data_dir="a.npz", joint_order=JOINTS, bounds=bounds,
        excitation=ExcitationCfg(bias=(0.2, 0.2), direction=(1.0, 1.0), scale=(0.3, 0.3)),
        sample_params={
            "armature": 0.01, "viscous_friction": 0.05, "friction": 0.08, "encoder_bias": 0.02, "delay": 1.5
        },
    )
    return PaceSim2realEnvCfg(scene=PaceSim2realSceneCfg(robot=robot), sim2real=sim2real)


register_task("Arm-v0", cfg)
"""

_MAP = """[joints.shoulder]
dof_pos = {from = "m1 pos", unit = "deg", sign = -1, gear_ratio = 9.0, offset = 0.1}
des_dof_pos = {from = "m1 cmd", unit = "deg", sign = -1, gear_ratio = 9.0, offset = 0.1}
[joints.elbow]
dof_pos = {from = "m2 pos", unit = "rad"}
des_dof_pos = {from = "m2 cmd", unit = "rad"}
[facts]
stiffness = 8.0
[time]
column = "t_ms"
unit = "ms"
"""

_URDF = """<robot name="swing"><link name="base"><inertial><mass value="2"/>
<inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
<link name="arm"><inertial><origin xyz="0 0 -0.1"/><mass value="0.4"/>
<inertia ixx="2e-3" iyy="2e-3" izz="4e-4" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 -0.2"/><geometry><mesh filename="package://world/foot.obj"/></geometry></collision></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="6" velocity="9"/><dynamics damping="0.1" friction="0.05"/></joint></robot>
"""

_FOOT = """v 0 0 0
v 0.1 0 0
v 0 0.1 0
v 0 0 0.1
f 1 3 2
f 1 2 4
f 2 3 4
f 1 4 3
"""

_HOPPER = """from pathlib import Path

from pace_envs import register_task
from pace_envs.from_model import robot_cfg_from_model
from pace_envs.tasks.velocity import velocity_env_cfg, velocity_rewards


def cfg():
    robot = robot_cfg_from_model(Path(__file__).parent / "arm.urdf")
    cfg = velocity_env_cfg(robot, feet="arm", base="base", knees="base", action_scale=0.25)
    cfg.rewards = velocity_rewards()
    return cfg


register_task("Hopper-v0", cfg)
"""

TRAP = 'open({path!r}, "a").write("executed")\n'
"""A module that says that it was imported: nothing may import it that nobody named."""


def run(name: str, *words: str) -> int:
    """Run ``scripts/<name>.py`` in this process, in the present folder; its exit status."""
    before = sys.argv
    sys.argv = [f"scripts/{name}.py", *words]
    try:
        runpy.run_path(str(ROOT / "scripts" / f"{name}.py"), run_name="__main__")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    finally:
        sys.argv = before
    return 0


SLOW = ("diagnose", "train", "play", "replay")
"""Scripts, and commands, that are left out where time is short."""


STATE = "state"
"""Folder beside the files for what is kept of the user: the code that the world's own commands named."""


def build(folder: Path, *, quick: bool = False) -> Path:
    """Make the files in a folder, through the command lines; a fit, a diagnosis and a training are as small as can be.

    Args:
        folder: Where.
        quick: Leave out what the commands in ``SLOW`` need.

    Returns:
        The folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.py").write_text(_MODULE)
    (folder / "arm.xml").write_text(_MODEL)
    (folder / "trap.py").write_text(TRAP.format(path=str(folder.parent / "executed")))
    (folder / "arm.urdf").write_text(_URDF)
    (folder / "foot.obj").write_text(_FOOT)
    (folder / "hopper.py").write_text(_HOPPER)
    (folder / "map.toml").write_text(_MAP)
    (folder / "log.csv").write_text(_log())
    _write_parquet(folder)
    with contextlib.chdir(folder):
        for output in ("a.npz", "b.csv", "c.pt"):
            _must(
                "data_collection",
                "--task",
                TASK,
                "--duration",
                "4",
                "--max_frequency",
                "2",
                "--output",
                output,
                "--no_plot",
            )
        if not quick:
            _must("data_collection", "--task", "Pace-Go2-v0", "--duration", "0.3", "--output", "go2.npz", "--no_plot")
        small = ("--num_envs", "8", "--max_iteration", "2", "--optimizer", "cmaes", "--log_dir", "made")
        for target, words in (
            (RUN, ("--task", TASK, "--data", "a.npz")),
            (OTHER, ("--task", TASK, "--data", "a.npz", "--effects", "payload@shared")),
            (GO2, ("--task", "Pace-Go2-v0", "--data", "go2.npz")),
        ):
            if quick and target == GO2:
                continue
            _must("fit", *words, *small)
            _move("made", target)
        _must("compare", RUN)
        if not quick:
            _diagnose_and_train()
        for report in Path().rglob("report.html"):
            report.unlink()  # they are large, and nothing reads them
        for events in [*Path().rglob("events.out.*"), *Path(TRAINING).rglob("policy*")]:
            events.unlink()
    return folder


def _log(samples: int = 600) -> str:
    """A log of another program, in milliseconds and degrees of the motor."""
    rows = ["t_ms,m1 pos,m1 cmd,m2 pos,m2 cmd"]
    for k in range(samples):
        target = 0.3 * math.sin(0.02 * k)
        motor = -9.0 * math.degrees(target - 0.1)
        rows.append(f"{2.5 * k:.1f},{0.97 * motor:.4f},{motor:.4f},{0.97 * target:.6f},{target:.6f}")
    return "\n".join(rows) + "\n"


def _write_parquet(folder: Path) -> None:
    """The same log as a table, and one of a constant with 3e8 rows, which packs them into a few megabytes."""
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet as pq

    pq.write_table(pyarrow.csv.read_csv(folder / "log.csv"), folder / "log.parquet")
    part = pa.table({"t_ms": pa.array([0.0]).take(pa.array([0] * 10**6)), "m1 pos": pa.nulls(10**6, pa.float64())})
    with pq.ParquetWriter(folder / "rows.bin", part.schema, compression="zstd") as writer:
        for _ in range(300):
            writer.write_table(part)


def _diagnose_and_train() -> None:
    words = ("--effects", "stribeck_friction", "--only", "--max_effects", "1", "--no_refit")
    _must("diagnose", RUN, *words)
    _must("train", "--task", WALK, "--num_envs", "2", "--max_iterations", "1", "--log_dir", "made",
          "--identified", f"{GO2}/result.json")  # fmt: skip
    _move("made", TRAINING)


def _must(name: str, *words: str) -> None:
    with open(os.devnull, "w") as null, contextlib.redirect_stdout(null):
        status = run(name, *words)
    if status:
        raise RuntimeError(f"{name} {' '.join(words)} ended with {status}")


def _move(log_dir: str, target: str) -> None:
    made = next(path for path in Path(log_dir).glob("*/*") if path.is_dir())
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    shutil.move(made, target)
    shutil.rmtree(log_dir)


def restore(world: Path, copy: Path) -> None:
    """Make a fresh copy of the world."""
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(world, copy, symlinks=True)


def snapshot(folder: Path) -> dict[str, tuple[int, int]]:
    """What lies in a folder: size and time of each file."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if "__pycache__" not in path.parts:
            info = path.lstat()
            found[str(path.relative_to(folder))] = (0, 0) if path.is_dir() else (info.st_size, info.st_mtime_ns)
    return found


COMMANDS: dict[str, tuple[str, Sequence[str], Sequence[str]]] = {
    # what: (script, words, the files that it reads)
    "fit npz": ("fit", ("--task", TASK, "--data", "a.npz", "--optimizer", "cmaes", "--num_envs", "4",
                        "--max_iteration", "1", "--log_dir", "new"), ("a.npz", "arm.xml")),
    "fit csv": ("fit", ("--task", TASK, "--data", "b.csv", "--optimizer", "cmaes", "--num_envs", "4",
                        "--max_iteration", "1", "--log_dir", "new"), ("b.csv", "b.json")),
    "fit pt": ("fit", ("--task", TASK, "--data", "c.pt", "--optimizer", "cmaes", "--num_envs", "4",
                       "--max_iteration", "1", "--log_dir", "new"), ("c.pt",)),
    "resume": ("fit", ("--resume", RUN), (f"{RUN}/settings.json", f"{RUN}/checkpoint.npz", f"{RUN}/history.json",
                                         f"{RUN}/config.pt", "a.npz")),
    "compare": ("compare", (RUN,), tuple(f"{RUN}/{name}" for name in (
        "result.json", "settings.json", "best_trajectory.pt", "config.pt", "history.json", "diagnosis.json",
        "comparison.json"))),
    "compare two": ("compare", (RUN, OTHER), (f"{OTHER}/result.json", f"{OTHER}/best_trajectory.pt",
                                             f"{OTHER}/history.json", f"{RUN}/history.json")),
    "compare data": ("compare", (RUN, "--data", "c.pt"), (f"{RUN}/result.json", f"{RUN}/best_trajectory.pt", "c.pt")),
    "diagnose": ("diagnose", (RUN, "--effects", "stribeck_friction", "--only", "--max_effects", "1", "--no_refit"),
                 tuple(f"{RUN}/{name}" for name in ("result.json", "settings.json", "history.json", "config.pt",
                                                    "best_trajectory.pt", "comparison.json"))),
    "plot": ("plot_trajectory", ("--robot_name", "arm", "--log_dir", "runs", "--folder_name", "base", "--output",
                                 "plots"), (f"{RUN}/best_trajectory.pt", f"{RUN}/history.json")),
    "plot mean": ("plot_trajectory", ("--robot_name", "arm", "--log_dir", "runs", "--folder_name", "base",
                                      "--mean_name", "mean_002", "--output", "plots"), (
        f"{RUN}/mean_002.pt", f"{RUN}/settings.json")),
    "export": ("export", (f"{RUN}/result.json", "--format", "mjcf", "--output", "out.xml"), (f"{RUN}/result.json",)),
    "export json": ("export", (f"{RUN}/result.json", "--format", "json"), (f"{RUN}/result.json",)),
    "train": ("train", ("--task", WALK, "--num_envs", "2", "--max_iterations", "1", "--log_dir", "new",
                        "--identified", f"{GO2}/result.json"), (f"{GO2}/result.json",)),
    "train on": ("train", ("--resume", TRAINING, "--max_iterations", "2"), tuple(
        f"{TRAINING}/{name}" for name in ("settings.json", "identified.json", "model_0.pt"))),
    "train from": ("train", ("--task", WALK, "--num_envs", "2", "--max_iterations", "2", "--log_dir", "new",
                             "--start_from", f"{TRAINING}/model_0.pt"), (f"{TRAINING}/model_0.pt",)),
    "train own": ("train", ("--task", "hopper.py:Hopper-v0", "--num_envs", "2", "--max_iterations", "1", "--log_dir",
                            "new"), ("arm.urdf", "foot.obj")),
    "play": ("play", ("--checkpoint", f"{TRAINING}/model_0.pt", "--num_envs", "2", "--seconds", "0.1"), tuple(
        f"{TRAINING}/{name}" for name in ("settings.json", "identified.json", "model_0.pt"))),
    "replay": ("play", ("--task", WALK, "--replay", GO2), (f"{GO2}/result.json", f"{GO2}/settings.json")),
    "collect": ("data_collection", ("--task", TASK, "--duration", "0.5", "--output", "new/d.npz", "--no_plot"),
                ("arm.xml",)),
    "list": ("list_envs", (), ()),
    "fit log": ("fit", ("--task", TASK, "--data", "log.csv", "--columns", "map.toml", "--optimizer", "cmaes",
                        "--num_envs", "4", "--max_iteration", "1", "--log_dir", "new"), ("log.csv", "map.toml")),
    "fit code": ("fit", ("--task", TASK, "--data", "a.npz", "--optimizer", "cmaes", "--num_envs", "4",
                         "--max_iteration", "1", "--log_dir", "new"), ("arm.py",)),
    "import": ("import_log", ("log.csv", "--columns", "map.toml", "--output", "new.csv"), ("log.csv", "map.toml")),
    "import guessed": ("import_log", ("log.csv", "--write_map", "guessed.toml"), ("log.csv",)),
    "import parquet": ("import_log", ("log.parquet", "--columns", "map.toml", "--output", "new.csv"), ("log.parquet",)),
    **{f"export {fmt}": ("export", (f"{RUN}/result.json", "--format", fmt, "--output", "out.py"),
                         (f"{RUN}/result.json",)) for fmt in ("cfg", "mjlab", "isaaclab", "newton", "mjlab_native")},
    "new robot": ("new_robot", ("arm.xml", "--output", "mine.py"), ("arm.xml",)),
    "new robot urdf": ("new_robot", ("arm.urdf", "--output", "mine.py"), ("arm.urdf",)),
    "page": ("replay", (RUN, "--viewer", "none"), tuple(f"{RUN}/{name}" for name in (
        "model.mjb", "best_trajectory.pt", "result.json"))),
}  # fmt: skip


def describe(result: dict) -> str:
    """A trial in a line."""
    return json.dumps(result, ensure_ascii=True)
