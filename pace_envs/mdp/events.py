"""Event terms: functions ``(env, env_ids, **params)``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch

from pace_actuators import IdentifiedDrives
from pace_actuators.base_parameters import BASE_PARAMETERS
from pace_actuators.identified import ALL, delay_in_steps, draw, in_control_steps, labels_with_std
from pace_envs.managers import SceneEntityCfg, state_only
from pace_envs.quaternions import from_euler, multiply

if TYPE_CHECKING:
    from pace_envs.articulation import Articulation
    from pace_envs.manager_based_env import ManagerBasedEnv


_ROBOT = SceneEntityCfg()
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")


@state_only
def reset_joints_by_offset(
    env: ManagerBasedEnv,
    env_ids: torch.Tensor,
    position_range: tuple[float, float],
    velocity_range: tuple[float, float] = (0.0, 0.0),
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Joints start at their defaults plus uniform offsets [rad], [rad/s], inside the soft limits."""
    asset, ids = env.scene[asset_cfg.name], asset_cfg.joint_ids
    position = asset.data.default_joint_pos[env_ids][:, ids]
    velocity = asset.data.default_joint_vel[env_ids][:, ids]
    limits = asset.data.soft_joint_pos_limits[ids]
    position = (position + env.uniform(tuple(position.shape), *position_range)).clamp(limits[:, 0], limits[:, 1])
    velocity = velocity + env.uniform(tuple(velocity.shape), *velocity_range)
    asset.write_joint_state_to_sim(position, velocity, ids, env_ids)


@state_only
def reset_root_state_uniform(
    env: ManagerBasedEnv,
    env_ids: torch.Tensor,
    pose_range: Mapping[str, tuple[float, float]],
    velocity_range: Mapping[str, tuple[float, float]],
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """A floating base starts at its initial state plus uniform offsets: x y z [m], roll pitch yaw [rad]."""
    asset = env.scene[asset_cfg.name]
    init = asset.cfg.init_state
    pose = _draw(env, len(env_ids), pose_range)
    velocity = _draw(env, len(env_ids), velocity_range)
    default = env.constant((*init.pos, *init.rot, *init.lin_vel, *init.ang_vel))
    state = default.repeat(len(env_ids), 1)
    state[:, :3] += pose[:, :3]
    state[:, 3:7] = multiply(state[:, 3:7], from_euler(pose[:, 3:]))
    state[:, 7:] += velocity
    asset.write_root_state_to_sim(state, env_ids)


@state_only
def push_by_setting_velocity(
    env: ManagerBasedEnv,
    env_ids: torch.Tensor,
    velocity_range: Mapping[str, tuple[float, float]],
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Push a floating base: add uniform draws by axis to its velocity [m/s], [rad/s]."""
    data = env.scene[asset_cfg.name].data
    if data.root_lin_vel_w is None or data.root_ang_vel_b is None:
        raise ValueError("This robot's base is fixed: it cannot be pushed. Remove the event or set fix_base=False.")
    change = _draw(env, len(env_ids), velocity_range)
    data.root_lin_vel_w[env_ids] += change[:, :3]
    data.root_ang_vel_b[env_ids] += change[:, 3:]


def _draw(env: ManagerBasedEnv, count: int, ranges: Mapping[str, tuple[float, float]]) -> torch.Tensor:
    unknown = set(ranges) - set(_AXES)
    if unknown:
        raise ValueError(f"Unknown axes {', '.join(sorted(unknown))}. Available: {', '.join(_AXES)}.")
    low, high = zip(*(ranges.get(axis, (0.0, 0.0)) for axis in _AXES), strict=True)
    return env.uniform((count, 6), env.constant(low), env.constant(high))


def randomize_friction(
    env: ManagerBasedEnv, env_ids: torch.Tensor, sensor_name: str, friction_range: tuple[float, float]
) -> None:
    """Draw one sliding friction coefficient per environment for the geoms of a contact sensor."""
    friction = env.sim.expand("geom_friction")
    drawn = env.uniform((len(env_ids), 1), *friction_range)
    geoms = torch.tensor(env.scene.sensors[sensor_name].geom_ids, device=env.device)
    friction[env_ids[:, None], geoms[None, :], 0] = drawn
    env.sim.constants_changed()


def randomize_body_mass(
    env: ManagerBasedEnv, env_ids: torch.Tensor, asset_cfg: SceneEntityCfg, mass_range: tuple[float, float]
) -> None:
    """Add a uniform draw [kg] to the mass of bodies; their inertia grows in proportion."""
    bodies = torch.as_tensor(asset_cfg.body_ids, device=env.device)
    nominal = env.sim.tensor(env.sim.model.body_mass)[bodies]
    if float(nominal.min()) + mass_range[0] <= 0.0:
        raise ValueError(
            f"mass_range starts at {mass_range[0]:g} kg and the lightest of these bodies has {float(nominal.min()):g} "
            "kg, expected a positive sum. Raise the lower end or name other bodies with asset_cfg."
        )
    mass = nominal + env.uniform((len(env_ids), len(bodies)), *mass_range)
    rows, columns = env_ids[:, None], bodies[None, :]
    env.sim.expand("body_mass")[rows, columns] = mass
    inertia = env.sim.tensor(env.sim.model.body_inertia)[bodies]
    env.sim.expand("body_inertia")[rows, columns] = inertia * (mass / nominal)[..., None]
    env.sim.constants_changed()


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
