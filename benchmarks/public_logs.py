"""Logs of strangers in public repositories, from import to verdict: what is said of each, in one table.

    python benchmarks/public_logs.py FOLDER --out /tmp/public_logs            # all rows, then the table
    python benchmarks/public_logs.py FOLDER --out /tmp/public_logs --rows go1_tracking tiago
    python benchmarks/public_logs.py FOLDER --out /tmp/public_logs --table    # of what was run

FOLDER holds a clone of each repository as OWNER/NAME. The logs are not part of this project. Models of robots that no
repository beside the log has come from the wheels of `wheel_robots.py`. Each row is `pace import`, then `pace fit` if
the log was read and a model is at hand, as a new user types them. What both said is kept in the folder.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from wheel_robots import CACHE, Robot, model_file

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
_DATA = "cmeel.prefix/share/example-robot-data/robots"
_WHEEL = "example-robot-data==6.0.0"
GO1 = Robot("go1", _WHEEL, f"{_DATA}/go1_description/urdf/go1.urdf")
G1 = Robot("g1", _WHEEL, f"{_DATA}/g1_description/urdf/g1_29dof_rev_1_0.urdf")
PANDA = Robot("panda", _WHEEL, f"{_DATA}/panda_description/urdf/panda.urdf")
_TIAGO = "examples/tiago/data/identification/dynamic/tiago_"
_UR10E_TORQUE = (14.87, 13.26, 11.13, 10.62, 11.03, 11.47)
"""N m/A, from the repository's paper."""


def _ur10e_map() -> str:
    joints = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    lines = ['[time]\ncolumn = "column 1"\nunit = "s"']
    for i, (joint, factor) in enumerate(zip(joints, _UR10E_TORQUE, strict=True)):
        torque = f'{{from = "column {14 + i}", unit = "A", factor = {factor}}}'
        lines.append(f'[joints.{joint}_joint]\ndof_pos = {{from = "column {2 + i}", unit = "rad"}}')
        lines.append(f'dof_vel = {{from = "column {8 + i}", unit = "rad/s"}}')
        lines.append(f"dof_effort = {torque}\ndes_dof_effort = {torque}")
    return "\n".join(lines)


def _go1_map() -> str:
    lines = ['[time]\ncolumn = "real_time"\nunit = "s"\n[facts]\nstiffness = 15.0\ndamping = 4.0']
    for leg in ("FR", "FL", "RR", "RL"):
        for i, part in enumerate(("hip", "thigh", "calf")):
            lines.append(f'[joints.{leg}_{part}_joint]\ndof_pos = {{from = "{leg}_{i}_actual", unit = "deg"}}')
            lines.append(f'des_dof_pos = {{from = "{leg}_{i}_target", unit = "deg"}}')
    return "\n".join(lines)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One log."""

    repository: str
    """OWNER/NAME."""
    log: tuple[str, ...]
    """Its files in the repository; several are parts of one log."""
    what: str
    """Robot and form."""
    task: str | Robot = ""
    """Model file in the repository, or of a wheel; "": none is public."""
    options: tuple[str, ...] = ()
    """Of both commands."""
    fit: tuple[str, ...] = ()
    """Of the fit alone."""
    map: str = ""
    """Column map that a user writes after the first refusal."""


ROWS = {
    "ur10e": Row(
        repository="shamilmamedov/dynamic_calibration",
        log=("dataset_ur10e/identification_data/ur-20_02_05-20sec_8harm.csv",),
        what="UR10e, excitation; CSV without names",
        task="URe/urdf/ur10e.urdf",
    ),
    "ur10e map": Row(
        repository="shamilmamedov/dynamic_calibration",
        log=("dataset_ur10e/identification_data/ur-20_02_05-20sec_8harm.csv",),
        what="the same with a map: motor current as torque",
        task="URe/urdf/ur10e.urdf",
        map=_ur10e_map(),
    ),
    "tiago": Row(
        repository="thanhndv212/figaroh-examples",
        log=(f"{_TIAGO}position.csv", f"{_TIAGO}velocity.csv", f"{_TIAGO}effort.csv"),
        what="TIAGo arm; a CSV for each quantity",
        task="examples/tiago/urdf/tiago_hey5.urdf",
        fit=("--max_duration", "6"),
    ),
    "tx40": Row(
        repository="thanhndv212/figaroh-examples",
        log=("examples/staubli_TX40/data/pos_read_data.csv", "examples/staubli_TX40/data/curr_data.csv"),
        what="Stäubli TX40; positions and currents, no time",
        options=("--rate", "5000"),
    ),
    "mit_arm": Row(
        repository="saloutos/system_identification",
        log=("data/example_arm_logs/arm_log_1.csv",),
        what="MIT arm; short names, one of them twice",
        task="vis/SingleArm_URDF_clean/urdf/SingleArm_SensorizedGripper_URDF.urdf",
    ),
    "six_axis": Row(
        repository="Naruton94/robot_identification",
        log=("python_identification/csv_data/dataInput1.csv",),
        what="six-axis arm; each series is a row",
    ),
    "rm65": Row(
        repository="boreep/dynamic_calibration",
        log=("dataset_rm65fb/identification_data/N3_0122.csv",),
        what="RM65 arm; CSV without names",
    ),
    "kuka": Row(
        repository="JonasWeigand/Robot_Identification",
        log=("data/recorded_trajectories/2020-10-21 10s FF A 08ms/data.txt",),
        what="KUKA arm; arrays of a PLC's program",
    ),
    "panda_bag": Row(
        repository="priban42/ObjectTrackingDataset",
        log=("joint_states.bag",),
        what="Panda at rest; ROS 1 bag",
        task=PANDA,
    ),
    "panda_10hz": Row(
        repository="priban42/ObjectTrackingDataset",
        log=("joint_states.csv",),
        what="Panda; positions at 10 Hz",
        task=PANDA,
    ),
    "panda_skill": Row(
        repository="platonics-delft/platonics_dataset",
        log=("execution_data/data_trial1.csv",),
        what="Panda; poses, forces, joints, no time",
        task=PANDA,
    ),
    "g1": Row(
        repository="YifanTian07/G1-policy-train",
        log=("data/chunk-000/episode_000061.parquet",),
        what="Unitree G1, arms and hands; LeRobot v2",
        task=G1,
    ),
    "g1 joints": Row(
        repository="YifanTian07/G1-policy-train",
        log=("data/chunk-000/episode_000061.parquet",),
        what="the same, arms alone",
        task=G1,
        fit=("--joints", ".*(shoulder|elbow|wrist).*", "--max_duration", "4"),
    ),
    "z1": Row(
        repository="bk-poudel/Unitree_Z1",
        log=("examples_py/joint_states.csv",),
        what="Unitree Z1; CSV without names and time",
        task="z1.urdf",
    ),
    "finger": Row(
        repository="NU-RDS/2n-codebase",
        log=("joint_states.csv",),
        what="two-joint finger; columns called as joints",
    ),
    "mapping_arm": Row(
        repository="abdealip/mapping-3d-robot-arm",
        log=("data/joint_states.csv",),
        what="six-axis arm; columns called as joints",
    ),
    "hydraulic": Row(
        repository="Guj2023/actuator_net",
        log=("app/resources/policy1_sin1Hz.csv",),
        what="hydraulic actuator; force commands, positions in two units",
    ),
    "moteus": Row(
        repository="karthikurs/actuator-dynamometer",
        log=("futek_data/futek_test_23_04_2021_19-36-34.csv",),
        what="two moteus drives on a stand; comments above the names",
    ),
    "brake": Row(
        repository="karthikurs/actuator-dynamometer",
        log=("brake-dynamometer/data/Fri Jan 15 19-40-52 2021.csv",),
        what="motor against a brake; speeds alone",
    ),
    "spot": Row(
        repository="ShahramKhorshidi/system_identification",
        log=("data/spot_robot_tau.dat",),
        what="Spot's torques; each series is a row, white space",
    ),
    "go1_net": Row(
        repository="sunzhon/actuator_net", log=("app/motor_data.pkl",), what="Unitree leg; pickle of arrays"
    ),
    "servo": Row(
        repository="mauicv/servo-sysid",
        log=("src/sysid/dataset/real-action-state-dataset.json",),
        what="hobby servo; JSON of its own",
    ),
    "odrive": Row(
        repository="eliasoa/TTK4900_CDPR",
        log=("Lifting_tests/5kg/ODrive0/Up05.csv",),
        what="four ODrives of a cable robot; empty cells",
    ),
    "irb140": Row(
        repository="MGCheminet/IRB140_Dynamic_Identification",
        log=("Pruebas_Iniciales/datos_irb140_2025-04-09_LIMITED_2.csv",),
        what="IRB 140; random poses, no motion",
    ),
    "go1_tracking": Row(
        repository="maido-39/free-dog-sdk-dev",
        log=("joint_tracking_data.csv",),
        what="Unitree Go1; targets in degrees, two clocks",
        task=GO1,
    ),
    "go1_tracking map": Row(
        repository="maido-39/free-dog-sdk-dev",
        log=("joint_tracking_data.csv",),
        what="the same with a map; gains from the repository",
        task=GO1,
        map=_go1_map(),
    ),
    "rtde": Row(
        repository="moelyaakoubi/GUI-RTDE",
        log=("robot_data.csv",),
        what="UR arm by RTDE; 11 rows, names twice",
    ),
    "ur_curve": Row(
        repository="qblc7/bachelorproject",
        log=("Testdaten/kurve_c1/robot_c1.csv",),
        what="UR arm by RTDE; white space, no time",
        options=("--rate", "125"),
    ),
    "antagonist": Row(
        repository="hop9999/antagonist_setup", log=("data/chirp.csv",), what="two-motor joint; each series is a row"
    ),
    "dc_motor": Row(
        repository="Tamaras-hub/ESP32-DC-Motor-PID-Control",
        log=("data/step_response.csv",),
        what="DC motor; names in Spanish",
    ),
    "gears": Row(
        repository="illusoryTwin/GearsAndTransmissions",
        log=("data/motor_data.csv",),
        what="geared motor; time in 'millisec'",
    ),
    "corgi": Row(
        repository="BioRoLa/corgi_ros2_ws",
        log=("input_csv/demo_walk_real.csv",),
        what="leg-wheel robot; commands alone, no names",
        options=("--rate", "1000"),
    ),
}  # fmt: skip


def run(name: str, row: Row, folder: Path, out: Path, limit: float) -> None:
    """Import a row's log and fit it; keep what was said."""
    done = out / f"{name.replace(' ', '_')}.said.json"
    root = folder / row.repository
    if done.exists() or not (root / row.log[0]).exists():
        return
    task = str(model_file(row.task, CACHE) if isinstance(row.task, Robot) else root / row.task) if row.task else ""
    files, options = [str(root / each) for each in row.log], list(row.options)
    if row.map:
        path = out / f"{name.replace(' ', '_')}.toml"
        path.write_text(row.map)
        options += ["--columns", str(path)]
    recording = out / f"{name.replace(' ', '_')}.csv"
    of_task = ["--task", task] if task else []
    content = {
        "import": _call("import_log", [*files, *of_task, *options, "--output", recording, "--overwrite"], limit, out)
    }
    if task and (content["import"]["code"] == 0 or row.fit):
        data = [recording] if len(files) > 1 else files
        given = [] if len(files) > 1 else options
        fit = ["--data", *data, *of_task, *given, *row.fit, "--optimizer", "least_squares", "--no_consistency"]
        content["fit"] = _call("fit", [*fit, "--log_dir", out / "runs"], limit, out)
    done.write_text(json.dumps(content, indent=1))


def _call(script: str, arguments: list[str | Path], limit: float, out: Path) -> dict:
    """Exit code, what was said, and wall time [s] of a command."""
    started = time.monotonic()
    command = [sys.executable, str(SCRIPTS / f"{script}.py"), *map(str, arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=limit, cwd=out, env=environment)
        code, said = ended.returncode, ended.stderr + ended.stdout
    except subprocess.TimeoutExpired as error:
        code, said = -1, (error.stderr or b"").decode(errors="replace")
    return {"code": code, "said": said, "wall_time_s": time.monotonic() - started}


def _end(called: dict | None, root: Path) -> str:
    """How a command ended, in one cell."""
    if called is None:
        return "–"
    lines = [line for line in re.split(r"[\r\n]+", called["said"]) if line.strip()]
    if called["code"] == -1:
        return "met the limit of time"
    if "Traceback" in called["said"] or called["code"] not in (0, 2):
        return f"crash: {lines[-1]}"
    if called["code"] == 2:
        return "refused: " + lines[-1].removeprefix("error: ").replace(f"{root}/", "")[:260]
    told = [line for line in lines if line.startswith(("error, all", "recording:"))]
    warned = [line.removeprefix("warning: ")[:160] for line in lines if line.startswith("warning:")]
    return "; ".join([*(each.partition("; score")[0].partition(" (")[0] for each in told), *warned[:1]])


def table(folder: Path, out: Path) -> str:
    """The table of what was run, in Markdown."""
    lines = ["| log | what it is | import | fit | s |", "|---|---|---|---|---|"]
    for name, row in ROWS.items():
        done = out / f"{name.replace(' ', '_')}.said.json"
        if done.exists():
            content = json.loads(done.read_text())
            cells = [_end(content.get(key), folder / row.repository).replace("|", "/") for key in ("import", "fit")]
            seconds = sum(called["wall_time_s"] for called in content.values())
            lines.append(f"| {name} | {row.what} | {' | '.join(cells)} | {seconds:.0f} |")
    return "\n".join(lines)


def main() -> None:
    """Run rows, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="clones of the repositories, as OWNER/NAME")
    parser.add_argument("--out", type=Path, required=True, help="where what was said is kept")
    parser.add_argument("--rows", nargs="+", metavar="ROW", default=[], help=f"of {', '.join(ROWS)} (default: all)")
    parser.add_argument("--limit", type=float, default=280.0, help="wall time of a command [s]")
    parser.add_argument("--table", action="store_true", help="run nothing")
    args = parser.parse_args()
    if unknown := [name for name in args.rows if name not in ROWS]:
        parser.error(f"There is no row {unknown[0]!r}. Available: {', '.join(ROWS)}.")
    args.out.mkdir(parents=True, exist_ok=True)
    for name, row in ROWS.items():
        if not args.table and (not args.rows or name in args.rows):
            run(name, row, args.folder.resolve(), args.out.resolve(), args.limit)
    print(table(args.folder.resolve(), args.out))


if __name__ == "__main__":
    main()
