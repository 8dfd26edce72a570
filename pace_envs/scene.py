"""The scene: a robot and, where it walks, the ground."""

from dataclasses import dataclass

import mujoco

from pace_envs.articulation import Articulation, load_robot_spec
from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.simulation import EnvIds, Simulation, SimulationCfg


@dataclass(kw_only=True)
class TerrainCfg:
    """Flat ground."""

    friction: tuple[float, float, float] = (1.0, 0.005, 0.0001)
    """Sliding, torsional [m] and rolling [m] friction coefficient."""


@dataclass(kw_only=True)
class InteractiveSceneCfg:
    """What stands in every environment."""

    num_envs: int = 1
    """Number of environments."""

    robot: ArticulationCfg
    """The robot."""

    terrain: TerrainCfg | None = None
    """The ground, or ``None`` for a robot in the air."""


class InteractiveScene:
    """The entities of all environments, by name: ``scene["robot"]``."""

    def __init__(self, cfg: InteractiveSceneCfg, sim_cfg: SimulationCfg):
        """Build the model, start its simulations and find the robot in them."""
        self.cfg = cfg
        spec = load_robot_spec(cfg.robot)
        if cfg.terrain is not None:
            spec.worldbody.add_geom(
                name="terrain",
                type=mujoco.mjtGeom.mjGEOM_PLANE,
                size=[0, 0, 0.05],
                friction=cfg.terrain.friction,
                rgba=[0.42, 0.45, 0.48, 1.0],
            )
        self.sim = Simulation(sim_cfg, spec, cfg.num_envs)
        self.articulations = {"robot": Articulation(cfg.robot, self.sim)}

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self.cfg.num_envs

    def __getitem__(self, name: str) -> Articulation:
        """The entity of that name."""
        if name not in self.articulations:
            raise KeyError(f"The scene has no {name!r}. Available: {', '.join(self.articulations)}.")
        return self.articulations[name]

    def reset(self, env_ids: EnvIds = None) -> None:
        """Put all or some environments back to their initial state."""
        self.sim.reset(env_ids)
        for articulation in self.articulations.values():
            articulation.reset(env_ids)

    def write_data_to_sim(self) -> None:
        """Run the drives and apply their torques."""
        for articulation in self.articulations.values():
            articulation.write_data_to_sim()

    def update(self) -> None:
        """Read the state after a physics step."""
        for articulation in self.articulations.values():
            articulation.update()
