"""The scene: a robot and, where it walks, the ground and what feels it."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import ClassVar

import mujoco
import torch

from pace_actuators.config import Config
from pace_envs.articulation import Articulation
from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.contact_sensor import ContactSensor, ContactSensorCfg, add_contact_sensor
from pace_envs.robot_spec import find_geoms, load_robot_spec
from pace_envs.simulation import EnvIds, SimulationCfg, make_simulation


@dataclass(kw_only=True)
class TerrainCfg(Config):
    """Flat ground."""

    height: float = 0.0
    """Of the ground [m]."""

    friction: tuple[float, float, float] = (1.0, 0.005, 0.0001)
    """Sliding, torsional [m] and rolling [m] friction coefficient, where the robot's geoms do not take precedence."""

    collision_geoms: str | tuple[str, ...] | None = None
    """Expressions of the robot's geoms, or bodies, that may touch the ground, and nothing else; ``None`` leaves
    contacts as the model has them."""

    impratio: float | None = None
    """Stiffness of friction over that of normal forces; ``None`` means the model's.

    The higher, the less a stance foot creeps, and the slower the solver: a standing ANYmal is stepped twice as fast
    with 1 as with 100.
    """


@dataclass(kw_only=True)
class InteractiveSceneCfg(Config):
    """What stands in every environment."""

    elsewhere: ClassVar = {
        "env_spacing": "environments have a world each. Leave it out.",
        "ground": "write terrain=TerrainCfg(); a robot in the air has none.",
        "sky_light": "the model file has the lights. Leave it out.",
    }

    num_envs: int = 1
    """Number of environments."""

    robot: ArticulationCfg
    """The robot."""

    terrain: TerrainCfg | None = None
    """The ground, or ``None`` for a robot in the air."""

    contact_sensors: Mapping[str, ContactSensorCfg] = field(default_factory=dict)
    """What feels contacts, by name: ``scene.sensors["feet"]``."""


class InteractiveScene:
    """The robot of all environments, ``scene["robot"]``, and sensors by name: ``scene.sensors["feet"]``."""

    def __init__(self, cfg: InteractiveSceneCfg, sim_cfg: SimulationCfg):
        """Build the model, start its simulations and find the robot in them."""
        self.cfg = cfg
        touches = sim_cfg.contacts or cfg.terrain is not None or bool(cfg.contact_sensors)
        spec = load_robot_spec(cfg.robot, touches=touches)
        if cfg.terrain is not None:
            _add_terrain(spec, cfg.terrain)
        for name, sensor in cfg.contact_sensors.items():
            add_contact_sensor(spec, name, sensor)
        self.sim = make_simulation(sim_cfg, spec, cfg.num_envs)
        self.robot = Articulation(cfg.robot, self.sim)
        self.sensors = {name: ContactSensor(c, name, self.sim) for name, c in cfg.contact_sensors.items()}

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self.cfg.num_envs

    def __getitem__(self, name: str) -> Articulation:
        """The entity of that name."""
        if name != "robot":
            raise KeyError(f"The scene has no {name!r}. Available: robot.")
        return self.robot

    def reset(self, env_ids: EnvIds = None) -> None:
        """Put all or some environments back to their initial state."""
        self.sim.reset(env_ids)
        self.robot.reset(env_ids)
        rows = self.sim.rows(env_ids)
        for sensor in self.sensors.values():
            sensor.reset(rows)

    @contextmanager
    def only_where(self, mask: torch.Tensor) -> Iterator[None]:
        """Let what is done to the state meanwhile count for some environments alone, (num_envs,) bool.

        The others get back their state and targets. So a few can be reset without being counted.
        """
        parts = [*self.sim.state, *self.robot.targets]
        before = [part.clone() for part in parts]
        yield
        for part, old in zip(parts, before, strict=True):
            torch.where(mask.view(-1, *[1] * (part.ndim - 1)), part, old, out=part)
        self.update()

    def reset_where(self, mask: torch.Tensor) -> None:
        """:meth:`reset` of environments that are not counted, (num_envs,) bool; inside of :meth:`only_where`.

        The drives are left to :meth:`reset_drives_where`.
        """
        self.sim.reset(slice(None))
        self.robot.reset_state(slice(None))
        for sensor in self.sensors.values():
            sensor.reset(mask)

    def reset_drives_where(self, mask: torch.Tensor) -> None:
        """Let the drives of environments forget that are not counted, (num_envs,) bool."""
        self.robot.reset_drives(mask)

    def write_data_to_sim(self) -> None:
        """Run the drives and apply their torques."""
        self.robot.write_data_to_sim()

    def update(self) -> None:
        """Read the state after a physics step."""
        self.robot.update()

    def update_sensors(self, dt: float) -> None:
        """Read the contacts after an environment step of ``dt`` seconds."""
        for sensor in self.sensors.values():
            sensor.update(dt)


def _add_terrain(spec: mujoco.MjSpec, cfg: TerrainCfg) -> None:
    if cfg.collision_geoms is not None:
        kept = {geom.name for geom in find_geoms(spec, cfg.collision_geoms)}
        for geom in spec.geoms:
            geom.contype, geom.conaffinity = 0, int(geom.name in kept)  # the ground's contype is 1
    if cfg.impratio is not None:
        spec.option.impratio = cfg.impratio
    ground = spec.worldbody.add_geom(
        name="terrain",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.05],
        pos=[0.0, 0.0, cfg.height],
        friction=cfg.friction,
        rgba=[0.42, 0.45, 0.48, 1.0],
    )
    if any(material.name == "ground" for material in spec.materials):
        ground.material, ground.rgba = "ground", [1.0, 1.0, 1.0, 1.0]
