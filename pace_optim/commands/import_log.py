"""Read a log of another program, say what was understood, and write it as a recording."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from pace_actuators.files import refuse_taken
from pace_actuators.text import listed
from pace_optim.recording import SUFFIXES, Recording, save_recording, written_files
from pace_optim.recording.files import unused_facts
from pace_optim.recording.logs import ColumnMap, LogReader, Robot, is_log, read_map, with_rate, write_map
from pace_optim.terminal.cli import make_parser
from pace_optim.terminal.options import (
    add_common_options,
    add_facts_option,
    add_overwrite_option,
    add_rate_option,
    take_common_options,
)


def main() -> None:
    """Parse the command line, read the log, write recordings."""
    parser = make_parser(
        "Read a log (.mcap .db3 .bag .parquet .csv, rosbag2 and LeRobot folders), print what was understood (topics,\n"
        "joints, units, rates, gaps) and write it as a recording. Several files are parts of one log, of one clock.",
        example="scripts/import_log.py rosbag2_2026_11_25 --task my_arm.xml --output arm.csv",
    )
    parser.add_argument("log", nargs="+", metavar="LOG", help="the log's file or folder")
    add_common_options(parser)
    parser.add_argument("--columns", metavar="MAP", help="column map (.toml); without it, it is guessed")
    parser.add_argument("--output", metavar="FILE", help="recording to write (.csv, .npz, .pt); episodes get numbers")
    parser.add_argument("--write_map", metavar="MAP", help="write the map that was used, to correct it")
    add_facts_option(parser)
    add_rate_option(parser)
    add_overwrite_option(parser)
    args = argparse.Namespace(**take_common_options(vars(parser.parse_args())))

    path = Path("+".join(args.log))
    columns = with_rate(read_map(Path(args.columns)) if args.columns else None, args.rate)
    reader = LogReader([str(path)], columns, args.facts)
    parts: Sequence[tuple[Recording, ColumnMap | None]]
    if not is_log(path, columns):
        found = reader.recordings(str(path), Robot())
        print(f"{path}: is a recording already, of {', '.join(found[0].joint_names) or 'joints without names'}.")
        parts = [(recording, columns) for recording in found]
    else:
        robot = _robot(args.task, args.log, args.columns)
        parts = reader.understood(str(path), robot)
        for line in reader.lines():
            print(line)
        if absent := [name for name in robot.joint_names if name not in parts[0][0].joint_names]:
            print(f"  not in the log: {listed(absent)}; a fit holds them")
        if len(parts) > 1:
            print(f"  {len(parts)} episodes")
    if left := unused_facts(args.log, args.facts):
        print(f"note: {left}", file=sys.stderr)
    targets = _targets(Path(args.output), len(parts)) if args.output else []
    files = [file for target in targets for file in written_files(target)]
    refuse_taken(files, option="--output", overwrite=args.overwrite)
    if args.write_map and parts[0][1] is not None:
        refuse_taken([args.write_map], option="--write_map", overwrite=args.overwrite)
        write_map(Path(args.write_map), parts[0][1])
        print(f"map: {args.write_map}", file=sys.stderr)
    if not args.output:
        print("nothing written: --output FILE writes the recording")
        return
    for (recording, _), target in zip(parts, targets, strict=True):
        save_recording(target, recording)
        print(f"recording: {target} ({recording.num_samples} samples, {recording.duration:.4g} s)")


def _robot(task: str | None, files: Sequence[str], columns: str | None) -> Robot:
    """What a task says of the robot's joints."""
    if task is None:
        return Robot()
    from pace_envs import ManagerBasedRLEnv, load_env_cfg
    from pace_optim.problem.recordings import known_robot, motors_of_logs

    cfg = load_env_cfg(task, None, motors_of_logs(task, files, columns))
    cfg.scene.num_envs = 1
    env = ManagerBasedRLEnv(cfg)  # type: ignore[arg-type]
    known = known_robot(env)
    env.close()
    return known


def _targets(path: Path, count: int) -> list[Path]:
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"--output {path}: expected one of {', '.join(SUFFIXES)}. Correct its name.")
    return [path] if count == 1 else [path.with_stem(f"{path.stem}_{i:03d}") for i in range(count)]
