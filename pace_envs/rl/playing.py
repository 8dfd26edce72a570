"""Playing a trained policy: figures, films, a window, exports."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch

from pace_actuators.files import refuse_taken, replacing
from pace_actuators.memory import check_memory
from pace_envs.rendering import OffscreenRenderer, drawn
from pace_envs.rl.evaluation import Evaluation, Policy, ReachEvaluation, evaluate, evaluate_reach
from pace_envs.rl.export import EXPORTED, export_policy, exported_files
from pace_envs.rl.run_folder import SETTINGS_FILE, RunSettings, find_checkpoint
from pace_envs.rl.runner import PaceOnPolicyRunner
from pace_envs.rl.training import EditCfg, load_cfg, make_env
from pace_envs.rsl_rl_cfg import play_cfg
from pace_envs.rsl_rl_wrapper import RslRlVecEnvWrapper
from pace_envs.tasks.reach import ReachEnvCfg
from pace_envs.tasks.velocity import VelocityEnvCfg, fix_command


@torch.inference_mode()
def watch(env: RslRlVecEnvWrapper, policy: Policy) -> None:
    """Let a policy walk in environment 0 of a window, in real time, until the window is closed."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ValueError("There is no screen to open a window on. Write a film with --video.")
    from mujoco import viewer

    base = env.unwrapped
    model = drawn(base.sim.model_of(0))
    data = mujoco.MjData(model)
    obs, _ = env.reset()
    with viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as window:
        window.cam.type, window.cam.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1
        while window.is_running():
            start = time.perf_counter()
            obs, *_ = env.step(policy(obs))
            with window.lock():
                base.sim.read_data(0, data)
                mujoco.mj_forward(model, data)
            window.sync()
            time.sleep(max(0.0, base.step_dt - (time.perf_counter() - start)))


_ENCODE = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "23", "-movflags", "+faststart")


def write_video(path: str | Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Write a film: ``.mp4`` with ffmpeg, ``.gif`` with Pillow.

    Args:
        frames: Pictures (height, width, 3) uint8.
    """
    path = Path(path)
    check_video_path(path)
    if not frames:
        raise ValueError(f"There are no pictures to write to {path}.")
    path.parent.mkdir(parents=True, exist_ok=True)
    write = _write_gif if path.suffix == ".gif" else _write_mp4
    with replacing(path) as part:
        write(part, frames, fps)


def check_video_path(path: str | Path) -> None:
    """Refuse, before anything is drawn, what :func:`write_video` could not write."""
    suffix = Path(path).suffix
    if suffix not in (".mp4", ".gif"):
        raise ValueError(f"The video {path} ends with {suffix!r}, expected .mp4 or .gif.")
    if suffix == ".mp4" and _ffmpeg() is None:
        raise ValueError(
            f"{path} needs ffmpeg, which was not found. Install it, or `pip install imageio-ffmpeg` "
            "(extra: video), or write a .gif."
        )


def _ffmpeg() -> str | None:
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError:
        return shutil.which("ffmpeg")
    return get_ffmpeg_exe()


def _write_gif(path: Path, frames: Sequence[np.ndarray], fps: float) -> None:
    from PIL import Image

    pictures = [Image.fromarray(frame).quantize(128) for frame in frames]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=round(1000 / fps), loop=0)


def _write_mp4(path: Path, frames: Sequence[np.ndarray], fps: float) -> None:
    height, width = frames[0].shape[:2]
    raw = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-")
    command = [str(_ffmpeg()), "-y", "-loglevel", "error", *raw, *_ENCODE, str(path)]
    done = subprocess.run(command, input=b"".join(f.tobytes() for f in frames), capture_output=True, check=False)
    if done.returncode:
        raise ValueError(f"ffmpeg could not write {path}: {done.stderr.decode(errors='replace').strip()}")


_FRAME_EVERY = 2  # environment steps: 25 pictures per second at 50 Hz
_SIZE = (640, 360)
"""Of a film's pictures [pixels]."""
_LONGEST = 3600.0
"""Of playing [s]."""


@dataclass(kw_only=True)
class PlaySettings:
    """What is played, and how."""

    checkpoint: str
    """A checkpoint ``model_<iteration>.pt``, or a run's folder for its last one."""

    task: str | None = None
    """Registered environment; ``None`` means the one that the checkpoint's run was trained in."""

    num_envs: int = 256
    """Number of robots that are judged."""

    seconds: float = 20.0
    """How long [s]."""

    seed: int = 0
    """Seed of commands and initial states."""

    command: tuple[float, float, float] | None = None
    """One command for all: forward, left [m/s], yaw rate [rad/s]; ``None`` draws them as in training."""

    identified: str | None = None
    """A fit's ``result.json``: let the policy walk on these drives; ``None`` means those that it was trained with."""

    video: str | None = None
    """A film of the first robot, ``.mp4`` or ``.gif``."""

    viewer: bool = False
    """Whether to open a window instead."""

    export: str | None = None
    """Folder for the policy as TorchScript and ONNX."""

    overwrite: bool = False
    """Whether the film and the exported files may replace files that exist."""

    device: str = "cpu"
    """Where it walks: ``cpu``, or a GPU as ``cuda:0``; wherever it was trained."""


def play(settings: PlaySettings, edit: EditCfg | None = None) -> Evaluation | ReachEvaluation | None:
    """Play a policy; returns its figures, or nothing after a window was closed."""
    if not 0.0 < settings.seconds <= _LONGEST:
        raise ValueError(f"--seconds {settings.seconds:g}: expected more than 0, at most {_LONGEST:g}.")
    if settings.video is not None:
        check_video_path(settings.video)
        refuse_taken([settings.video], option="--video", overwrite=settings.overwrite)
    path = find_checkpoint(settings.checkpoint)
    if settings.export is not None:
        files, trained = exported_files(Path(settings.export)), exported_files(path.parent / EXPORTED)
        refuse_taken(files, option="--export", overwrite=settings.overwrite, own=trained)
    run = _run_settings(path, settings)
    try:
        cfg = load_cfg(run, edit)
    except ValueError as error:
        own = path.parent / SETTINGS_FILE
        raise ValueError(f"{own}: {error}" if own.is_file() else str(error)) from None
    play_cfg(cfg)
    if settings.command is not None:
        if not isinstance(cfg, VelocityEnvCfg):
            raise ValueError(f"--command is a velocity, and {run.task} is no velocity task.")
        fix_command(cfg, settings.command)
    env = make_env(cfg)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # rsl-rl prints its networks
            runner = PaceOnPolicyRunner(env, cfg.runner.to_dict())
        runner.load(str(path))
        policy = runner.get_inference_policy()
        if settings.export is not None:
            export_policy(runner, Path(settings.export))
        if settings.viewer:
            watch(env, policy)
            return None
        steps = max(round(settings.seconds / env.unwrapped.step_dt), 1)
        judge = evaluate_reach if isinstance(cfg, ReachEnvCfg) else evaluate
        if settings.video is None:
            return judge(env, policy, steps)
        film = _Film(env, steps)
        result = judge(env, policy, steps, film.step)
        write_video(settings.video, film.frames, 1.0 / (_FRAME_EVERY * env.unwrapped.step_dt))
        film.renderer.close()
        return result
    finally:
        env.close()


class _Film:
    def __init__(self, env: RslRlVecEnvWrapper, steps: int):
        width, height = _SIZE
        check_memory(3.0 * width * height * (steps // _FRAME_EVERY), "--video", "Give fewer --seconds.")
        self.renderer = OffscreenRenderer(env.unwrapped.sim, width, height)
        self.frames: list[np.ndarray] = []
        self._steps = 0

    def step(self) -> None:
        if self._steps % _FRAME_EVERY == 0:
            self.frames.append(self.renderer.render().copy())
        self._steps += 1


def _run_settings(checkpoint: Path, settings: PlaySettings) -> RunSettings:
    if (checkpoint.parent / SETTINGS_FILE).is_file():
        run = RunSettings.read(checkpoint.parent, settings.task)
    elif settings.task is not None:
        run = RunSettings(task=settings.task)
    else:
        raise ValueError(f"There is no {SETTINGS_FILE} beside {checkpoint}: say with --task what it was trained for.")
    run.task = settings.task or run.task
    run.num_envs, run.seed, run.randomize = settings.num_envs, settings.seed, False
    run.device = settings.device
    run.randomize_identified, run.identified = None, settings.identified or run.identified
    return run
