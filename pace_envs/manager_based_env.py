"""The batched environment: scene, actions, events, observations."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from pace_actuators.config import Config
from pace_actuators.effects import DriveState
from pace_envs.compiler.fusion import Fusion, fusion_for
from pace_envs.managers import (
    ActionManager,
    ActionTermCfg,
    EventManager,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationManager,
)
from pace_envs.scene import InteractiveScene, InteractiveSceneCfg
from pace_envs.simulation import EnvIds, SimulationCfg
from pace_envs.step_graph import Homes, StepGraph


@dataclass(kw_only=True)
class ManagerBasedEnvCfg(Config):
    """Configuration of an environment."""

    scene: InteractiveSceneCfg
    """What stands in it."""

    sim: SimulationCfg = field(default_factory=SimulationCfg)
    """How the physics is stepped."""

    decimation: int = 1
    """Physics steps per environment step."""

    seed: int | None = None
    """Seed of all random draws; ``None`` draws one."""

    actions: Mapping[str, ActionTermCfg] = field(default_factory=dict)
    """Action terms by name."""

    observations: Mapping[str, ObservationGroupCfg] = field(default_factory=dict)
    """Observation groups by name; policies read ``"policy"``."""

    events: Mapping[str, EventTermCfg] = field(default_factory=dict)
    """Events by name."""

    def prepare(self) -> None:
        """Check and complete the configuration; everything that uses one calls this first.

        A subclass may set its fields in ``__post_init__``, with or without ``super()``, so that none is checked there.

        Raises:
            ValueError: If it is unusable.
        """


class ManagerBasedEnv(gym.Env):
    """``num_envs`` environments in one object; every tensor has the environments as its first dimension.

    A step: (1) the action manager takes the action; (2) for every physics step, targets are set, the drives
    turn them into torques and the simulation advances; (3) interval events happen; (4) observations.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as gym.Env declares it
        "render_modes": ["rgb_array"],
        "autoreset_mode": gym.vector.AutoresetMode.SAME_STEP,
    }

    @torch.inference_mode(False)  # it can then be stepped in and out of inference mode
    def __init__(self, cfg: ManagerBasedEnvCfg, render_mode: str | None = None):
        """Build the scene and the managers.

        Args:
            render_mode: ``None`` or ``"rgb_array"``.

        Raises:
            ValueError: If the configuration is unusable.
        """
        cfg.prepare()
        if not (isinstance(cfg.decimation, int) and cfg.decimation >= 1):
            raise ValueError(f"decimation is {cfg.decimation!r}, expected an integer >= 1.")
        self.cfg = cfg
        self.render_mode = render_mode
        self._closed = False
        self.scene = InteractiveScene(cfg.scene, cfg.sim)
        self.sim = self.scene.sim
        self._generator = torch.Generator(self.device)
        self.seed(cfg.seed)
        for name, actuator in self.scene["robot"].actuators.items():
            if cfg.decimation % actuator.cfg.control_decimation:
                raise ValueError(
                    f"decimation is {cfg.decimation}, expected a multiple of the actuator group {name!r}'s "
                    f"control_decimation = {actuator.cfg.control_decimation}."
                )
        self._constants: dict[tuple[float, ...], torch.Tensor] = {}
        self.extras: dict[str, Any] = {}
        self.masks_resets = False
        """Whether environments are reset where a mask says so, without waiting for the GPU to count them."""
        self.common_step_counter = 0
        self._renderer: Any = None
        self._graphs: dict[str, StepGraph] = {}
        self.load_managers()
        self._configure_spaces()
        self.event_manager.apply("startup")

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self.scene.num_envs

    @property
    def device(self) -> torch.device:
        """Device of all tensors."""
        return self.sim.device

    @property
    def dtype(self) -> torch.dtype:
        """Type of all tensors: float64 on the processor, float32 on a GPU."""
        return self.sim.dtype

    @property
    def physics_dt(self) -> float:
        """Physics time step [s]."""
        return self.cfg.sim.dt

    @property
    def step_dt(self) -> float:
        """Time of an environment step [s]."""
        return self.cfg.sim.dt * self.cfg.decimation

    def load_managers(self) -> None:
        """Build the managers."""
        self.event_manager = EventManager(self.cfg.events, self)
        self.action_manager = ActionManager(self.cfg.actions, self)
        self.observation_manager = ObservationManager(self.cfg.observations, self)

    def seed(self, seed: int | None) -> int:
        """Seed all random draws of the environment; returns the seed."""
        seed = self._generator.seed() % 2**31 if seed is None else int(seed)
        self._generator.manual_seed(seed)
        return seed

    def constant(self, values: tuple[float, ...]) -> torch.Tensor:
        """Numbers as a tensor, copied to the device once."""
        if values not in self._constants:
            self._constants[values] = self.sim.tensor(values)
        return self._constants[values]

    def uniform(self, shape: tuple[int, ...], low: Any = 0.0, high: Any = 1.0) -> torch.Tensor:
        """Uniform draws from the environment's own generator, on its device and of its type."""
        draws = torch.rand(shape, generator=self._generator, dtype=self.dtype, device=self.device)
        return low + (high - low) * draws

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
        env_ids: EnvIds = None,
    ) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Reset all or some environments.

        Args:
            seed: Seed of all random draws from here on.
            options: Not used; part of Gymnasium's signature.
            env_ids: The environments, or ``None`` for all.

        Returns:
            Observations of all environments by group, and extras.
        """
        self._check_open()
        super().reset(seed=seed)
        if seed is not None:
            self.seed(seed)
        ids = torch.arange(self.num_envs, device=self.device)[self.sim.rows(env_ids)]
        self.extras = {}
        self._reset_idx(ids)
        self.sim.forward(ids)
        self.scene.update()
        return self.observation_manager.compute(), self.extras

    def step(self, action: torch.Tensor) -> Any:
        """Advance all environments by ``step_dt``.

        Args:
            action: (num_envs, action_dim).

        Returns:
            Observations by group, and extras.

        Raises:
            ValueError: If the action is no tensor of that shape or not finite, or the environment is closed.
        """
        self._check_action(action)
        self.simulate(action)
        self.event_manager.apply("interval", dt=self.step_dt)
        return self.observation_manager.compute(), self.extras

    def simulate(self, action: torch.Tensor) -> None:
        """Only the physics of a step: take the action and advance all environments by ``step_dt``."""
        self._check_open()
        self.action_manager.take_action(action)
        self._replayed("simulate", self._advance, lambda: Homes(self._moving_parts()))
        self.common_step_counter += 1

    def _advance(self) -> dict[str, torch.Tensor]:
        """Actions, drives and physics of a step."""
        self.action_manager.process_taken()
        for _ in range(self.cfg.decimation):
            self.action_manager.apply_action()
            self.scene.write_data_to_sim()
            self.sim.step()
            self.scene.update()
        return {}

    def _replayed(
        self, name: str, function: Callable[[], dict[str, torch.Tensor]], homes: Callable[[], Homes]
    ) -> dict[str, torch.Tensor]:
        """Do what a function of the environment does; on a GPU from a CUDA graph.

        Args:
            homes: Makes the places of what it may replace.
        """
        if self.device.type != "cuda" or not self.cfg.sim.graphs:
            with torch.no_grad():  # small operations then take a quarter less time
                return function()
        self.sim.update_constants()
        if name not in self._graphs:
            self._graphs[name] = StepGraph(function, homes(), self._generator, self._fusion())
        return self._graphs[name](self._graph_key())

    def _moving_parts(self) -> list[object]:
        """The objects that keep something from physics step to physics step beside the simulation."""
        robot = self.scene.robot
        every = [part for drive in robot.actuators.values() for part in drive.parts().values()]
        parts = [part for part in every if not isinstance(part, DriveState)]
        return [*parts, robot.data, self.action_manager, *self.action_manager.terms]

    def _graph_key(self) -> Hashable:
        """All that steps read of Python beside what is on the parts."""
        return self.sim.version

    def _fusion(self) -> Fusion | None:
        """What makes few kernels of many operations, where that is wanted and can be had."""
        return fusion_for(self.num_envs, self.device) if self.cfg.sim.fused else None

    def render(self) -> np.ndarray | None:
        """A picture of environment 0, (height, width, 3) uint8; ``None`` without a render mode."""
        self._check_open()
        if self.render_mode != "rgb_array":
            return None
        if self._renderer is None:
            from pace_envs.rendering import OffscreenRenderer

            self._renderer = OffscreenRenderer(self.sim)
        return self._renderer.render()

    def _check_open(self) -> None:
        if self._closed:
            raise ValueError("The environment is closed. Make another one.")

    def _check_action(self, action: Any) -> None:
        """Refuse what no robot can follow, before anything has moved."""
        self._check_open()
        if isinstance(action, torch.Tensor) and action.device.type == "cpu" and not bool(action.isfinite().all()):
            place = (~action.isfinite()).nonzero()[0].tolist()
            raise ValueError(f"The action is not finite, first at {place} (environment, entry). Nothing has moved.")

    def close(self) -> None:
        """Release the simulations and the renderer; nothing can be done with the environment then."""
        self._closed = True
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.sim.close()

    def _reset_idx(self, env_ids: torch.Tensor) -> None:
        self.scene.reset(None if len(env_ids) == self.num_envs else env_ids)
        self.event_manager.apply("reset", env_ids)
        self.action_manager.reset(env_ids)
        self.event_manager.reset(env_ids)
        self.observation_manager.reset(env_ids)

    def _configure_spaces(self) -> None:
        self.single_observation_space = gym.spaces.Dict(
            {name: _unbounded(shape) for name, shape in self.observation_manager.group_obs_dim.items()}
        )
        self.single_action_space = _unbounded((self.action_manager.total_action_dim,))
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)


def _unbounded(shape: tuple[int, ...]) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, shape, np.float32)
