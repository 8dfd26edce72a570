"""An interactive window, where there is a screen."""

from __future__ import annotations

import os
import sys
import time

import mujoco
import torch

from pace_envs.rendering import drawn
from pace_envs.rl.evaluation import Policy
from pace_envs.rsl_rl_wrapper import RslRlVecEnvWrapper


@torch.inference_mode()
def watch(env: RslRlVecEnvWrapper, policy: Policy) -> None:
    """Let a policy walk in environment 0 of a window, in real time, until the window is closed.

    Raises:
        ValueError: If there is no screen.
    """
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
