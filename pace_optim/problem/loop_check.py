"""Whether a robot's closed chains can be closed where its recordings begin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import torch

from pace_envs import ManagerBasedRLEnv
from pace_envs.tasks.pace import PaceSim2realEnvCfg
from pace_optim.recording import Recording

_CLOSED = 1e-4
"""A loop that is open by less starts closed enough [m or rad]: its constraints are as soft as that."""


def refuse_open_loops(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> None:
    """Refuse recordings in whose first posture a loop cannot be closed by any encoder bias within its bounds.

    Args:
        env: The environment; its first simulation takes each posture.
        recordings: On the robot's joints, in its order.

    Raises:
        ValueError: If one cannot; the message says how far its loop is open.
    """
    robot = env.scene["robot"]
    loops = robot.closed_loops
    if loops is None:
        return
    cfg = cast(PaceSim2realEnvCfg, env.cfg).sim2real
    n = robot.num_joints
    slack = np.full(env.sim.model.nv, np.inf)
    slack[robot.dof_columns.numpy()] = cfg.bounds["encoder_bias"].abs().max(dim=1).values.numpy()
    for recording in recordings:
        robot.write_joint_state_to_sim(torch.as_tensor(recording.dof_pos[0])[None], torch.zeros(1, n))
        posture = env.sim.qpos[0].numpy()
        gap, name = loops.gap(posture)
        if gap > _CLOSED and not loops.closable(posture, slack):
            raise ValueError(
                f"{recording.name}: where it begins, the closed chain ({name}) is open by {gap:.3g} (m or rad), "
                "and no encoder bias within its bounds closes it. Check the joints' zeros, signs and units, or give "
                "the assembly as init_state.joint_pos of the passive joints (a keyframe of the model file does, too)."
            )
    env.scene.reset()
