"""The identification environment."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from pace_actuators import JointValue, resolve_joint_values
from pace_actuators.effects import EffectCfg, effect_cfgs
from pace_actuators.effects.friction import DynamicFriction
from pace_envs import mdp
from pace_envs.manager_based_rl_env import ManagerBasedRLEnvCfg
from pace_envs.managers import ActionTermCfg, ObservationGroupCfg, ObservationTermCfg, TerminationTermCfg
from pace_envs.scene import InteractiveSceneCfg
from pace_envs.tasks.pace.pace_cfg import PaceCfg


@dataclass(kw_only=True)
class PaceSim2realSceneCfg(InteractiveSceneCfg):
    """A robot held in the air."""

    def __post_init__(self) -> None:
        """Fix the base."""
        self.robot = dataclasses.replace(self.robot, fix_base=True)


def _actions() -> dict[str, ActionTermCfg]:
    return {"joint_pos": mdp.JointPositionActionCfg(use_default_offset=False)}


def _observations() -> dict[str, ObservationGroupCfg]:
    terms = {
        "joint_pos": ObservationTermCfg(func=mdp.joint_pos),
        "joint_vel": ObservationTermCfg(func=mdp.joint_vel),
    }
    return {"policy": ObservationGroupCfg(terms=terms)}


def _terminations() -> dict[str, TerminationTermCfg]:
    return {"time_out": TerminationTermCfg(func=mdp.time_out, time_out=True)}


@dataclass(kw_only=True)
class PaceSim2realEnvCfg(ManagerBasedRLEnvCfg):
    """400 Hz physics and control, actions are joint position targets [rad], episodes end only after days."""

    scene: PaceSim2realSceneCfg
    """The robot, its base fixed."""

    sim2real: PaceCfg
    """What identification needs to know of the robot."""

    episode_length_s: float = 1e6
    """Longest episode [s]."""

    actions: Mapping[str, ActionTermCfg] = field(default_factory=_actions)
    """Joint position targets, scale 1, no offset."""

    observations: Mapping[str, ObservationGroupCfg] = field(default_factory=_observations)
    """Joint positions [rad] and velocities [rad/s]."""

    terminations: Mapping[str, TerminationTermCfg] = field(default_factory=_terminations)
    """Only the time."""

    def __post_init__(self) -> None:
        """Nothing; a subclass may set its fields here, with or without ``super()``."""

    def prepare(self) -> None:
        """Check the identification's settings; use its joint order, delay and effects everywhere."""
        super().prepare()
        pace = self.sim2real
        pace.prepare()
        robot = self.scene.robot
        if robot.joint_order != pace.joint_order or not robot.fix_base:
            robot = dataclasses.replace(robot, joint_order=pace.joint_order, fix_base=True)
            self.scene = dataclasses.replace(self.scene, robot=robot)
        for drive in robot.actuators.values():
            if drive.max_delay is None:  # in the drive's own control steps
                longest = float(pace.bounds["delay"][0, 1]) * self.decimation / drive.control_decimation
                drive.max_delay = max(longest, drive.largest_delay)
            drive.delay = drive.delay or 0.0  # identification sets the delay; max_delay alone would be one
        has_effects = all(drive.effects for drive in robot.actuators.values())
        if (pace.effects or pace.separate_dynamic_friction) and not has_effects:
            self.set_effects(pace.effects)

    def set_effects(self, effects: Sequence[EffectCfg | str]) -> None:
        """Give the drives effects whose parameters are identified; before a finer physics step is set.

        Args:
            effects: ``"name"``, ``"name@joints"`` or ``"name@shared"``, or configurations.

        Raises:
            ValueError: If an effect or a joint is unknown.
        """
        cfgs = effect_cfgs(effects)
        if self.sim2real.separate_dynamic_friction and all(cfg.effect_class is not DynamicFriction for cfg in cfgs):
            cfgs = [EffectCfg(effect=DynamicFriction.name), *cfgs]
        for cfg in cfgs:
            cfg.joints(self.sim2real.joint_order)  # complains about patterns that match nothing
        self.sim2real.effects = tuple(cfgs)
        for drive in self.scene.robot.actuators.values():
            drive.effects = tuple(cfgs)

    def of_driven_joints(self) -> PaceSim2realEnvCfg:
        """The same, with nothing said of where joints without drives begin."""
        robot, names = self.scene.robot, self.sim2real.joint_order
        if not isinstance(robot.init_state.joint_pos, Mapping):
            return self
        own = {
            pattern: value
            for pattern, value in robot.init_state.joint_pos.items()
            if any(re.fullmatch(pattern, name) for name in names)
        }
        robot = dataclasses.replace(robot, init_state=dataclasses.replace(robot.init_state, joint_pos=own))
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, robot=robot))

    def holding(self, positions: Mapping[str, float]) -> PaceSim2realEnvCfg:
        """The same with some of the joints held: they have no drives, and nothing of them is identified.

        Args:
            positions: Where each is held [rad, of slides m], by name.

        Raises:
            ValueError: If no joint is left, or parameters of the user's own are for all joints.
        """
        if not positions:
            return self
        robot, names = self.scene.robot, self.sim2real.joint_order
        kept = [name for name in names if name not in positions]
        if not kept:
            raise ValueError(f"All joints are held ({', '.join(names)}): nothing is left to identify.")
        if self.sim2real.extra_parameters:
            raise ValueError(
                f"extra_parameters are written for all joints of the robot: {', '.join(positions)} cannot be held. "
                "Record all joints, or leave these parameters out."
            )
        drives = {group: cfg.on_joints(names, kept) for group, cfg in robot.actuators.items()}
        state = robot.init_state
        state = dataclasses.replace(
            state,
            joint_pos=_of_kept(state.joint_pos, names, kept, "joint_pos"),
            joint_vel=_of_kept(state.joint_vel, names, kept, "joint_vel"),
        )
        robot = dataclasses.replace(
            robot,
            actuators={group: cfg for group, cfg in drives.items() if cfg is not None},
            init_state=state,
            joint_order=None,
            held_joints={**robot.held_joints, **positions},
        )
        effects = [cfg for cfg in effect_cfgs(self.sim2real.effects) if not set(cfg.joints(names)).isdisjoint(kept)]
        return dataclasses.replace(
            self,
            scene=dataclasses.replace(self.scene, robot=robot),
            sim2real=self.sim2real.on_joints(kept).replace(effects=tuple(effects)),
        )

    def on_joints(self, joint_names: Sequence[str]) -> PaceSim2realEnvCfg:
        """The same for some of the joints: the drives of the others, effects and custom terms are left out."""
        robot, names = self.scene.robot, self.sim2real.joint_order
        drives = {group: cfg.on_joints(names, joint_names) for group, cfg in robot.actuators.items()}
        state = robot.init_state
        kept = [name in joint_names for name in names]
        state = dataclasses.replace(
            state,
            joint_pos=resolve_joint_values(state.joint_pos, names, field="joint_pos", default=0.0)[kept],
            joint_vel=resolve_joint_values(state.joint_vel, names, field="joint_vel", default=0.0)[kept],
        )
        robot = dataclasses.replace(
            robot,
            actuators={group: cfg for group, cfg in drives.items() if cfg is not None},
            init_state=state,
        )
        return dataclasses.replace(
            self,
            scene=dataclasses.replace(self.scene, robot=robot),
            sim2real=self.sim2real.on_joints(joint_names),
            actions=_actions(),
            observations=_observations(),
            terminations=_terminations(),
            events={},
            commands={},
            rewards={},
            curriculum={},
        )


def _of_kept(value: JointValue, names: Sequence[str], kept: Sequence[str], field: str) -> JointValue:
    """Values of an initial state without those of the joints that are held; patterns of joints without drives stay."""
    if isinstance(value, (int, float)):
        return value
    own, others = value, {}
    names = list(names)
    if isinstance(value, Mapping):
        driven = {pattern for pattern in value if any(re.fullmatch(pattern, name) for name in names)}
        own = {pattern: value[pattern] for pattern in driven}
        others = {pattern: each for pattern, each in value.items() if pattern not in driven}
    each = resolve_joint_values(own, names, field=field, default=0.0)
    if not isinstance(value, Mapping):
        return each[[names.index(name) for name in kept]]
    return {re.escape(name): float(each[names.index(name)]) for name in kept} | others
