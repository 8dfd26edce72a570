"""From a request to files."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pace_actuators.files import refuse_place, refuse_taken
from pace_actuators.joint_units import radians
from pace_actuators.text import listed
from pace_envs import ManagerBasedRLEnv, load_env_cfg, registered_tasks
from pace_envs.registration import make_env
from pace_envs.tasks.pace import PaceCfg
from pace_optim.data_collection.plant import write_truth
from pace_optim.motion.design import Design
from pace_optim.motion.design.motion_check import (
    MotionFinding,
    MotionLimits,
    check_command,
    check_simulated,
    refuse_errors,
    summarise,
)
from pace_optim.motion.signals import Trajectory, make_excitation, write_command_csv
from pace_optim.problem.drive_facts import of_joints
from pace_optim.problem.drive_steps import set_control_step, set_drive_step
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.recording import SUFFIXES, save_recording, written_files

from .cfg import CollectionCfg
from .design import design_motion
from .hidden import Hidden, simulate_hidden
from .plot import plot_motion
from .simulate import Encoder, Simulated, simulate, true_parameters


@dataclass(frozen=True, kw_only=True)
class Collection:
    """What was written, and what to know about it."""

    recordings: tuple[Path, ...]
    """Recordings, one per trajectory; none with ``command_only``."""
    commands: tuple[Path, ...]
    """CSV files of the commands."""
    plots: tuple[Path, ...]
    """PNG files."""
    warnings: tuple[str, ...]
    """What the check of the motion found, in plain sentences."""
    hidden: tuple[str, ...] = ()
    """What is hidden in the recordings, a line per effect."""
    truth: Path | None = None
    """JSON file that says so."""
    design: Design | None = None
    """The error bars expected of the chosen motion; None if none was asked for."""


def collect(cfg: CollectionCfg, report: Callable[[str], None] = lambda text: None) -> Collection:
    """Make the motion, check it, simulate it and write everything; nothing is written if something is wrong.

    Args:
        cfg: What is asked for.
        report: Gets lines of progress.

    Raises:
        ValueError: If the request cannot be met, or the motion must not be sent to the robot.
    """
    env_cfg = load_env_cfg(cfg.task, cfg.control_dt)
    sim2real = _sim2real(env_cfg, cfg.task)
    control_dt = env_cfg.sim.dt * env_cfg.decimation
    trajectories = make_excitation(
        cfg.excitation,
        sim2real,
        control_dt=control_dt,
        duration=cfg.duration,
        min_frequency=cfg.min_frequency,
        max_frequency=cfg.max_frequency,
        seed=cfg.seed,
    )
    files = plan_files(cfg, sim2real, [trajectory.name for trajectory in trajectories])
    if cfg.optimize and len(trajectories) > 1:
        raise ValueError(
            f"--optimize chooses one trajectory, and {cfg.excitation} makes {len(trajectories)}. Choose another "
            "--excitation, such as chirp or multisine."
        )
    space = ParameterSpace.of(sim2real)
    truth = None if cfg.command_only else true_parameters(sim2real, space, cfg.parameters)

    set_control_step(env_cfg)  # as a fit simulates them
    physics_dt = set_drive_step(env_cfg) if cfg.physics_dt is None else cfg.physics_dt
    count = len(trajectories)
    env: Any = make_env(cfg.task, cfg=env_cfg, num_envs=count, physics_dt=physics_dt, delay_mode=cfg.delay_mode)
    try:
        limits = _limits_of(env)
        by_speed = driven_by_speed(env, cfg)
        trajectories = [told_speeds(trajectory, by_speed, cfg) for trajectory in trajectories]
        design = design_motion(cfg, env, trajectories[0], limits, report) if cfg.optimize else None
        trajectories = trajectories if design is None else [design.trajectory]
        findings = [check_command(trajectory, limits) for trajectory in trajectories]
        for trajectory, found in zip(trajectories, findings, strict=True):
            refuse_errors(found, trajectory.name, cfg.task)
        simulated: list[Simulated] = []
        hidden: Hidden | None = None
        if truth is not None and cfg.effects:
            mode = next(iter(env.scene["robot"].actuators.values())).cfg.delay_mode
            hidden = simulate_hidden(cfg, trajectories, space=space, truth=truth, delay_mode=mode)
            simulated = hidden.simulated
        elif truth is not None:
            simulated = simulate(
                env,
                trajectories,
                space=space,
                truth=truth,
                encoder=Encoder(
                    noise=cfg.noise,
                    bits=cfg.encoder_bits,
                    rng=np.random.default_rng([cfg.seed, 1]),
                    radians=radians(env.scene["robot"].joint_types),
                ),
                drive=cfg.drive(env.scene["robot"].num_joints),
                load=cfg.load,
            )
        if simulated:
            for trajectory, result, found in zip(trajectories, simulated, findings, strict=True):
                found += check_simulated(trajectory.time, result.position, result.torque, limits)
                refuse_errors(found, trajectory.name, cfg.task)
    finally:
        env.close()
    written = _write(cfg, sim2real, trajectories, simulated, files, findings, limits)
    if hidden is not None:
        path = write_truth(truth_file(cfg, sim2real), hidden.truth.to_dict())
        written = replace(written, hidden=hidden.lines, truth=path)
    return replace(written, design=design)


def _write(
    cfg: CollectionCfg,
    sim2real: PaceCfg,
    trajectories: Sequence[Trajectory],
    simulated: Sequence[Simulated],
    files: Sequence[Files],
    findings: Sequence[Sequence[MotionFinding]],
    limits: MotionLimits,
) -> Collection:
    recordings, commands, plots, warnings = [], [], [], []
    for i, (trajectory, file) in enumerate(zip(trajectories, files, strict=True)):
        prefix = f"{trajectory.name}: " if len(trajectories) > 1 else ""
        warnings += [prefix + line for line in summarise(findings[i])]
        recording = simulated[i].recording if simulated else None
        if recording is not None and file.recording is not None:
            recording = replace(recording, name=file.recording.stem)
            if cfg.positions_only:
                recording = replace(recording, dof_vel=None)
            recordings.append(save_recording(file.recording, recording))
        if file.command is not None:
            commands.append(write_command_csv(file.command, trajectory))
        if file.plot is not None:
            how = "commands" if recording is None else "simulated recording"
            plots.append(
                plot_motion(
                    file.plot,
                    trajectory,
                    None if recording is None else recording.dof_pos,
                    title=f"{sim2real.robot_name}, {trajectory.name}: {how}",
                    position_limits=limits.position,
                    joint_types=limits.joint_types,
                )
            )
    return Collection(
        recordings=tuple(recordings), commands=tuple(commands), plots=tuple(plots), warnings=tuple(warnings)
    )


def _sim2real(env_cfg: Any, task: str) -> PaceCfg:
    sim2real = getattr(env_cfg, "sim2real", None)
    if sim2real is None:
        suited = [name for name in registered_tasks() if hasattr(load_env_cfg(name), "sim2real")]
        close = difflib.get_close_matches(task, suited, n=1, cutoff=0.0)
        raise ValueError(
            f"{task} is not an identification task: it has no PaceCfg. Did you mean {close[0]!r}? Available: "
            f"{', '.join(suited)}."
        )
    return sim2real


def _limits_of(env: Any) -> MotionLimits:
    robot = env.scene["robot"]
    velocity, effort = np.full(robot.num_joints, np.inf), np.full(robot.num_joints, np.inf)
    for actuator in robot.actuators.values():
        where = actuator.joint_indices
        columns = where if isinstance(where, slice) else np.asarray(where)
        velocity[columns] = actuator.velocity_limit[0].numpy()
        effort[columns] = actuator.effort_limit[0].numpy()
    return MotionLimits(
        joint_names=tuple(robot.joint_names),
        position=robot.data.joint_pos_limits.numpy(),
        velocity=velocity,
        effort=effort,
        joint_types=robot.joint_types,
    )


def driven_by_speed(env: ManagerBasedRLEnv, cfg: CollectionCfg) -> tuple[str, ...]:
    """Joints whose drives follow speeds: those that the request names, and those without a proportional gain."""
    names = np.array(env.scene["robot"].joint_names)
    own = {"stiffness": cfg.stiffness, "damping": cfg.damping}
    kp, kd = (of_joints(env, name) if value is None else np.full(len(names), value) for name, value in own.items())
    by_speed = kp == 0.0
    if cfg.velocity_joints is not None:
        try:
            named = np.array([re.fullmatch(cfg.velocity_joints, name) is not None for name in names])
        except re.error as error:
            raise ValueError(
                f"--velocity_joints {cfg.velocity_joints!r} is no regular expression: {error}. Expected one such as "
                "'.*wheel.*'."
            ) from error
        if not named.any():
            raise ValueError(f"--velocity_joints {cfg.velocity_joints!r} fits no joint. Available: {', '.join(names)}.")
        by_speed |= named
    if loose := names[by_speed & (kd == 0.0)].tolist():
        raise ValueError(
            f"Nothing would move {listed(loose, 3)}: stiffness and damping are 0, so the drive follows torques, and "
            "motions are made of positions and speeds. State the gains (--stiffness, --damping), or record with a "
            "torque controller and log its commands (des_dof_effort)."
        )
    return tuple(names[by_speed].tolist())


def told_speeds(trajectory: Trajectory, by_speed: tuple[str, ...], cfg: CollectionCfg) -> Trajectory:
    """The trajectory, with speeds for these joints."""
    if not by_speed:
        return trajectory
    if trajectory.has_jumps:
        raise ValueError(
            f"{cfg.excitation} jumps from target to target, and {listed(by_speed, 3)} follow speeds. Choose another "
            "--excitation, such as chirp, multisine or ramp."
        )
    if cfg.effects:
        raise ValueError(
            f"The plant that hides effects follows positions, and {listed(by_speed, 3)} follow speeds. Omit --effect."
        )
    return replace(trajectory, by_speed=by_speed)


@dataclass(frozen=True, kw_only=True)
class Files:
    """Where one trajectory's files go; None for a file that is not written."""

    recording: Path | None
    """The recording."""
    command: Path | None
    """The commands alone."""
    plot: Path | None
    """The picture."""


def plan_files(cfg: CollectionCfg, sim2real: PaceCfg, names: Sequence[str]) -> list[Files]:
    """Name the files of every trajectory, and refuse what could not be written before the work is done.

    Args:
        sim2real: Says where files go that the request does not place.
        names: Names of the trajectories; with several, each adds its own to the stem of its files.
    """
    _check("--output", cfg.output, SUFFIXES)
    _check("--export_command", cfg.export_command, (".csv",))
    _check("--plot", cfg.plot, (".png",))
    folder, stem = Path("data") / sim2real.robot_name, _stem(cfg)
    recording = None if cfg.command_only else _recording(cfg, sim2real)
    command = cfg.export_command
    if command is None and cfg.command_only:
        command = folder / f"{stem}_command.csv"
    plot = cfg.plot or (recording or command or folder).with_suffix(".png")
    files = [
        Files(
            recording=_part(recording, name, len(names)),
            command=_part(command, name, len(names)),
            plot=None if cfg.no_plot else _part(plot, name, len(names)),
        )
        for name in names
    ]
    paths = [path for file in files for path in (file.recording, file.command, file.plot) if path]
    if repeated := sorted({str(path) for path in paths if paths.count(path) > 1}):
        raise ValueError(f"Two files would be written to {', '.join(repeated)}. Give each another name.")
    recordings = [path for file in files if file.recording for path in written_files(file.recording)]
    truth = [truth_file(cfg, sim2real)] if cfg.effects else []
    refuse_taken(dict.fromkeys((*paths, *recordings, *truth)), option="--output", overwrite=cfg.overwrite)
    return files


def truth_file(cfg: CollectionCfg, sim2real: PaceCfg) -> Path:
    """Where the truth is written: by the recording's stem (of several, their common part)."""
    recording = _recording(cfg, sim2real)
    return recording.with_name(f"{recording.stem}.truth.json")


def _stem(cfg: CollectionCfg) -> str:
    return f"{cfg.excitation}_optimized" if cfg.optimize else cfg.excitation


def _recording(cfg: CollectionCfg, sim2real: PaceCfg) -> Path:
    """Where a recording goes: as asked; where a fit looks for one of this motion; else under ``data/``."""
    if cfg.output is not None:
        return cfg.output
    own = Path(sim2real.data_dir)
    is_for_motion = own.stem.startswith(_stem(cfg)) and own.suffix.lower() in SUFFIXES
    if is_for_motion and not own.is_absolute():
        return sim2real.recording
    return Path("data") / sim2real.robot_name / f"{_stem(cfg)}.npz"


def _part(path: Path | None, name: str, count: int) -> Path | None:
    return path.with_name(f"{path.stem}_{name}{path.suffix}") if path and count > 1 else path


def _check(option: str, path: Path | None, suffixes: Sequence[str]) -> None:
    if path is None:
        return
    refuse_place(path, option=option)
    if path.suffix.lower() not in suffixes:
        raise ValueError(
            f"{option} {path}: found the suffix '{path.suffix}'; expected {' or '.join(suffixes)}. Rename the file."
        )
