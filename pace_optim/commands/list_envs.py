"""List the registered environments."""

from pathlib import Path

from pace_envs import load_env_cfg, registered_tasks
from pace_optim.terminal.cli import make_parser
from pace_optim.terminal.options import add_common_options, add_control_option, take_common_options

HEADER = ("task", "robot", "joints", "physics/control", "sample recording")


def rows(tasks: list[str], control_dt: float | None = None) -> list[tuple[str, ...]]:
    """One per environment; ``control_dt`` is that of a model file [s]."""
    result: list[tuple[str, ...]] = []
    for task in dict.fromkeys(tasks):
        cfg = load_env_cfg(task, control_dt)
        sim2real = getattr(cfg, "sim2real", None)
        robot = sim2real.robot_name if sim2real else Path(cfg.scene.robot.mjcf_path).stem
        joints = cfg.scene.robot.joint_order
        rates = f"{1 / cfg.sim.dt:g}/{1 / (cfg.sim.dt * cfg.decimation):g} Hz"
        recording = sample_recording(sim2real.recording) if sim2real else "-"
        result.append((task, robot, str(len(joints)) if joints else "all", rates, recording))
    return result


def sample_recording(path: Path) -> str:
    """Where the sample lies, as seen from here."""
    if not path.is_file():
        return f"missing: {path}"
    here = Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


def main() -> None:
    """Print the table."""
    parser = make_parser(
        "List the registered environments: robot, number of joints, rates of physics and control, sample recording.",
        example="scripts/list_envs.py",
    )
    add_common_options(parser)
    add_control_option(parser)
    args = take_common_options(vars(parser.parse_args()))
    task, control_dt = args["task"], args["control_dt"]
    own = [task] if task and ":" not in task else []
    own = rows([each for each in own if each not in registered_tasks()], control_dt)
    table = [HEADER, *rows(registered_tasks()), *own]
    widths = [max(len(row[i]) for row in table) for i in range(len(HEADER))]
    for row in table:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
