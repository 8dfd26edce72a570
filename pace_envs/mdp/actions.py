"""Action terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch

from pace_actuators import JointValue, resolve_joint_values
from pace_actuators.joint_units import units_for
from pace_envs.managers import ActionTerm, ActionTermCfg

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


class JointPositionAction(ActionTerm):
    """Joint position targets: q* = scale * action + offset, both (num_joints,) [rad]."""

    cfg: JointPositionActionCfg
    meaning = "target = action * scale + offset, in the encoder's coordinates [rad]"

    def __init__(self, cfg: JointPositionActionCfg, env: ManagerBasedEnv):
        """Find the joints, their scales and offsets."""
        super().__init__(cfg, env)
        ids, names = self._asset.find_joints(cfg.joint_names, preserve_order=cfg.preserve_order)
        self.joint_names = names
        self._joint_ids = None if ids == list(range(self._asset.num_joints)) else torch.tensor(ids, device=env.device)
        self.scale = env.sim.tensor(resolve_joint_values(cfg.scale, names, field="scale", default=1.0))
        self.offset = env.sim.tensor(resolve_joint_values(cfg.offset, names, field="offset", default=0.0))
        if cfg.use_default_offset:
            self.offset = self._asset.data.default_joint_pos[0, ids].clone()
        self._plain = bool((self.scale == 1.0).all()) and not bool(self.offset.any())
        self.processed_actions = torch.zeros(env.num_envs, len(ids), dtype=env.dtype, device=env.device)

    @property
    def action_dim(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    def describe(self) -> dict[str, Any]:
        """Its joints, and what it makes of the action."""
        types = dict(zip(self._asset.joint_names, self._asset.joint_types, strict=True))
        return {
            "joint_names": self.joint_names,
            "target": units_for(self.meaning, [types[name] for name in self.joint_names]),
            "scale": self.scale.tolist(),
            "offset": self.offset.tolist(),
        }

    def process_actions(self, actions: torch.Tensor) -> None:
        """Scale and offset."""
        self.processed_actions = actions if self._plain else actions * self.scale + self.offset

    def apply_actions(self) -> None:
        """Set the joints' position targets."""
        self._asset.set_joint_position_target(self.processed_actions, self._joint_ids)


@dataclass(kw_only=True)
class JointPositionActionCfg(ActionTermCfg):
    """Configuration of :class:`JointPositionAction`."""

    class_type: type[ActionTerm] = JointPositionAction
    """The term's class."""

    joint_names: str | tuple[str, ...] = ".*"
    """Expressions of the joints."""

    scale: JointValue = 1.0
    """Factor [rad]."""

    offset: JointValue = 0.0
    """Offset [rad]."""

    use_default_offset: bool = True
    """Whether the default joint positions are the offset."""

    preserve_order: bool = False
    """Order of the action: by the expressions instead of by ``joint_names`` of the articulation."""


class JointVelocityAction(JointPositionAction):
    """Joint velocity targets: q̇* = scale * action + offset [rad/s]. Drives without stiffness follow them alone."""

    meaning = "speed target = action * scale + offset [rad/s]"

    def apply_actions(self) -> None:
        """Set the joints' velocity targets."""
        self._asset.set_joint_velocity_target(self.processed_actions, self._joint_ids)


@dataclass(kw_only=True)
class JointVelocityActionCfg(JointPositionActionCfg):
    """Configuration of :class:`JointVelocityAction`; scale and offset in rad/s."""

    class_type: type[ActionTerm] = JointVelocityAction
    """The term's class."""

    use_default_offset: bool = False
    """Stays ``False``: default positions are no speeds."""


class JointEffortAction(JointPositionAction):
    """Torques, added to what the drives' controllers ask for: τ_ff = scale * action + offset [N m]."""

    meaning = "torque beside the controller's = action * scale + offset [N m]"

    def apply_actions(self) -> None:
        """Set the joints' feed-forward torques."""
        self._asset.set_joint_effort_target(self.processed_actions, self._joint_ids)


@dataclass(kw_only=True)
class JointEffortActionCfg(JointPositionActionCfg):
    """Configuration of :class:`JointEffortAction`; scale and offset in N m."""

    class_type: type[ActionTerm] = JointEffortAction
    """The term's class."""

    use_default_offset: bool = False
    """Stays ``False``: default positions are no torques."""
