"""Events that vary identified drives: ``(env, env_ids, **params)``, at startup."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from pace_actuators import IdentifiedDrives
from pace_actuators.base_parameters import BASE_PARAMETERS
from pace_actuators.identified import ALL, delay_in_steps
from pace_actuators.identified_draws import draw, in_control_steps, labels_with_std
from pace_envs.managers import SceneEntityCfg

if TYPE_CHECKING:
    from pace_envs.articulation import Articulation
    from pace_envs.manager_based_env import ManagerBasedEnv

_ROBOT = SceneEntityCfg()


def randomize_identified_drives(
    env: ManagerBasedEnv,
    env_ids: torch.Tensor,
    drives: IdentifiedDrives,
    scale: float = 1.0,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Draw each environment's drives around the identified ones, by their error bars and correlations.

    Args:
        env: The environment; its robot has the identified drives.
        scale: Multiplies the standard deviations.
    """
    if len(env_ids) != env.num_envs:
        raise ValueError("randomize_identified_drives draws all environments at once: use mode 'startup'.")
    robot = env.scene[asset_cfg.name]
    column = {name: i for i, name in enumerate(robot.joint_names)}
    drawn = draw(drives, env.uniform((env.num_envs, len(labels_with_std(drives)))), scale)
    for name, entries in drawn.items():
        joints = _joints_of(drives, name) if ALL in entries else list(entries)
        ids = [column[joint] for joint in joints]
        values = torch.stack([entries[ALL if ALL in entries else joint] for joint in joints], dim=1)
        if name == "delay":
            _write_delay(env, robot, values[:, :1], ids, drives)
        elif name in BASE_PARAMETERS:
            robot.write_base_parameter_to_sim(name, values, ids)
        else:
            effect, _, parameter = name.partition(".")
            if effect not in robot.effects:  # left out: it is of the rig
                continue
            robot.write_effect_parameter_to_sim(effect, parameter, values, ids)


def _joints_of(drives: IdentifiedDrives, name: str) -> list[str]:
    """The joints that share a parameter."""
    for cfg in drives.effects:
        if cfg.effect_class.name == name.partition(".")[0]:
            return cfg.joints(drives.joint_names)
    return list(drives.joint_names)


def _write_delay(
    env: ManagerBasedEnv, robot: Articulation, values: torch.Tensor, ids: list[int], drives: IdentifiedDrives
) -> None:
    """Write delays of (num_envs, 1) control steps of the identification, as those of each drive."""
    for actuator in robot.actuators.values():
        own = [i for i in robot.joints_of(actuator) if i in ids]
        if own:
            dt = env.cfg.sim.dt
            steps = in_control_steps(drives, values, dt * actuator.cfg.control_decimation)
            robot.write_base_parameter_to_sim("delay", steps.clamp(max=delay_in_steps(actuator.cfg, dt)[1]), own)
