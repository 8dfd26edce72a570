"""Events that change the model, environment by environment: ``(env, env_ids, **params)``, best at startup."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from pace_envs.managers import SceneEntityCfg

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


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
