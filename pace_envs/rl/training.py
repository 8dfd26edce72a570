"""Training a policy with rsl-rl."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

import torch
import torch.distributed as dist

from pace_actuators import IdentifiedDrives
from pace_actuators.drive_result import result_path
from pace_actuators.text import listed
from pace_envs.devices import find_device
from pace_envs.identified import assumed_gains, doubts, set_identified_step, set_step, step_note, use_identified
from pace_envs.lost_process import told_of_lost_processes
from pace_envs.manager_based_rl_env import ManagerBasedRLEnv
from pace_envs.registration import load_env_cfg, set_physics_dt
from pace_envs.rl.export import EXPORTED, export_policy
from pace_envs.rl.run_folder import (
    IDENTIFIED_FILE,
    SETTINGS_FILE,
    RunSettings,
    find_checkpoint,
    latest_checkpoint,
    new_run_folder,
)
from pace_envs.rl.runner import PaceOnPolicyRunner
from pace_envs.rsl_rl_cfg import TrainingEnvCfg, use_rewards
from pace_envs.rsl_rl_wrapper import RslRlVecEnvWrapper
from pace_envs.task_source import EnvironmentRecord
from pace_envs.tasks.velocity import VelocityEnvCfg, add_randomization


def process_number() -> int:
    """Of several processes that torchrun started, this one's number."""
    return int(os.environ.get("RANK", "0"))


EditCfg = Callable[[Any], None]


def load_cfg(settings: RunSettings, edit: EditCfg | None = None) -> TrainingEnvCfg:
    """The configuration of a training's environment.

    Args:
        edit: Changes it further, such as by :func:`pace_envs.tasks.velocity.set_drives`.
    """
    cfg = load_env_cfg(settings.task)
    if not isinstance(cfg, TrainingEnvCfg):
        raise ValueError(
            f"{settings.task} is no training task: there is nothing to learn in it. Available: "
            "Pace-AnymalD-Velocity-v0, Pace-Go2-Velocity-v0, Pace-SO101-Reach-v0, and your own with a VelocityEnvCfg "
            "or a ReachEnvCfg."
        )
    use_rewards(cfg, settings.reward)
    if settings.randomize:
        if not isinstance(cfg, VelocityEnvCfg):
            raise ValueError(f"--randomize is for walking robots, and {settings.task} is no velocity task.")
        add_randomization(cfg)
    cfg.sim.device = settings.device
    _use_drives(cfg, settings)
    if settings.num_envs is not None:
        cfg.scene.num_envs = settings.num_envs
    cfg.seed = cfg.runner.seed = settings.seed + process_number()  # each process has separate environments
    if settings.max_iterations is not None:
        if settings.max_iterations < 1:
            raise ValueError(f"max_iterations is {settings.max_iterations}, expected at least 1.")
        cfg.runner.max_iterations = settings.max_iterations
    if edit is not None:
        edit(cfg)
    return cfg


def _use_drives(cfg: TrainingEnvCfg, settings: RunSettings) -> None:
    """Physics step and drives as the settings say; prints what a reader should know of it."""
    scale = settings.randomize_identified
    if scale is not None and not 0 <= scale < math.inf:
        raise ValueError(f"randomize_identified is {scale:g}, expected a finite number >= 0 of standard deviations.")
    if settings.identified is None:
        if settings.randomize_identified is not None:
            raise ValueError("randomize_identified needs identified drives: name a result.json with --identified.")
        if settings.physics_dt is not None:
            set_step(cfg, settings.physics_dt)
        if joints := assumed_gains(cfg.scene.robot)["stiffness"]:
            print(
                f"warning: the model file states no gains of {listed(joints, 3)}; they are assumed from the effort "
                "limits. Set stiffness and damping in the task, or use --identified. [W5]",
                file=sys.stderr,
            )
        return
    drives = IdentifiedDrives.load(settings.identified)
    for doubt in doubts(cfg, drives):
        print(f"warning: identified drives: {doubt}", file=sys.stderr)
    before = cfg.sim.dt
    set_identified_step(cfg, drives)
    notes = use_identified(
        cfg,
        drives,
        randomize_std=settings.randomize_identified,
        own_step=settings.physics_dt is not None,
    )
    if settings.physics_dt is None:
        notes = [step_note(cfg, drives, before), *notes]
    else:
        # a finer step leaves the drives' controllers at their rate; how it is taken depends on their effects
        (set_physics_dt if settings.physics_dt < cfg.sim.dt else set_step)(cfg, settings.physics_dt)
    for note in filter(None, notes):
        print(f"identified drives: {note}")


def make_env(cfg: TrainingEnvCfg, render_mode: str | None = None) -> RslRlVecEnvWrapper:
    """The environment as rsl-rl sees it; one thread for torch's small tensors, the physics takes the cores."""
    torch.set_num_threads(1)
    return RslRlVecEnvWrapper(ManagerBasedRLEnv(cfg, render_mode), clip_actions=cfg.runner.clip_actions)


def train(settings: RunSettings, edit: EditCfg | None = None) -> Path | None:
    """Train a policy; returns the run's folder, with checkpoints and the exported policy.

    Of several processes that torchrun started, the first writes it; the others return ``None``.
    """
    cfg = load_cfg(settings, edit)
    start = None if settings.start_from is None else find_checkpoint(settings.start_from)

    def begin() -> Path:
        folder = new_run_folder(settings.log_dir, cfg.runner.experiment_name or settings.task)
        settings.write(folder, EnvironmentRecord.of(settings.task, cfg).to_dict())
        if settings.identified is not None:
            shutil.copyfile(result_path(settings.identified), folder / IDENTIFIED_FILE)
        return folder

    return _learn(cfg, begin, start)


def resume(
    run: str | Path,
    max_iterations: int | None = None,
    edit: EditCfg | None = None,
    task: str | None = None,
    device: str | None = None,
) -> Path | None:
    """Go on with a training in its folder, up to ``max_iterations`` in all.

    Raises:
        ValueError: If there is nothing left to do.
    """
    folder = Path(run)
    settings = RunSettings.read(folder, task)
    if max_iterations is not None:
        settings = replace(settings, max_iterations=max_iterations)
    if device is not None:
        settings = replace(settings, device=device)
    checkpoint = latest_checkpoint(folder)
    try:
        if device is None:
            find_device(settings.device)
        cfg = load_cfg(settings, edit)
    except ValueError as error:  # from what the folder says
        raise ValueError(f"{folder / SETTINGS_FILE}: {error}") from None

    def begin() -> Path:
        settings.write(folder, EnvironmentRecord.of(settings.task, cfg).to_dict())
        return folder

    return _learn(cfg, begin, checkpoint)


def _learn(cfg: TrainingEnvCfg, begin: Callable[[], Path], checkpoint: Path | None) -> Path | None:
    """Learn; ``begin`` makes the folder, once a checkpoint is known to be sound."""
    torch.manual_seed(cfg.runner.seed)
    env = make_env(cfg)
    with _by_lines():
        runner = PaceOnPolicyRunner(env, cfg.runner.to_dict())
    if checkpoint is not None:
        runner.load(str(checkpoint))
        torch.manual_seed(cfg.runner.seed + runner.current_learning_iteration)
    left = cfg.runner.max_iterations - runner.current_learning_iteration
    if left < 1:
        env.close()
        raise ValueError(
            f"{checkpoint} is of iteration {runner.current_learning_iteration - 1}, and the training ends after "
            f"{cfg.runner.max_iterations} iterations. Raise --max_iterations."
        )
    folder = None if process_number() else begin()
    runner.logger.log_dir = None if folder is None else str(folder)
    with told_of_lost_processes(), _by_lines():
        runner.learn(left, init_at_random_ep_len=True)
    if folder is not None:
        export_policy(runner, folder / EXPORTED)
    if runner.is_distributed:
        dist.destroy_process_group()
    env.close()
    return folder


def _by_lines() -> contextlib.redirect_stdout:
    """Let rsl-rl print its tables a line at a time: what is written at once is one line on our terminal."""
    return contextlib.redirect_stdout(_Lines(sys.stdout))  # type: ignore[type-var]


class _Lines:
    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        return sum(self._stream.write(line) for line in text.splitlines(keepends=True))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
