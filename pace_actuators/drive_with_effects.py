"""A drive as the simulator and its effects see it."""

from __future__ import annotations

import torch

from pace_actuators.drive import Drive

_INVERSION_STEPS = 6
"""Fixed-point steps to invert an encoder's error: it is small, each step divides what is left by ten or more."""


class DriveWithEffects(Drive):
    """What the simulator is to apply, what encoders show, and what effects are told."""

    @property
    def _feeds_back(self) -> bool:
        """Whether an effect lets the torque of a loop that is held follow the motion in between."""
        held = not self.cfg.implicit and self.cfg.delay_mode == "command"
        return held and self.effects is not None and self.effects.has("feedback")

    @property
    def held_effort(self) -> torch.Tensor:
        """The torque that the simulator is to hold until the next call [N m], (num_envs, num_joints).

        ``applied_effort``, unless ``holds_line``: then the torque that the line has at standstill.
        """
        return self._held_effort

    @property
    def joint_armature(self) -> torch.Tensor:
        """Rotor inertia that the simulator is to carry [kg m²], (num_envs, num_joints)."""
        return self.armature if self.effects is None else self.effects.state.armature

    @property
    def joint_friction(self) -> torch.Tensor:
        """Coulomb friction that the simulator is to apply until the next call [N m], (num_envs, num_joints)."""
        stack = self.effects
        return stack.state.friction if stack is not None and stack.changes_passive else self.friction

    @property
    def joint_viscous_friction(self) -> torch.Tensor:
        """Viscous friction that the simulator is to apply until the next call [N m s/rad], (num_envs, num_joints)."""
        stack = self.effects
        if stack is not None and stack.changes_passive:
            return stack.state.viscous_friction
        return self.viscous_friction if self._speed_slope is None else self.viscous_friction + self._speed_slope

    @property
    def joint_implicit_damping(self) -> torch.Tensor | None:
        """More viscous friction, which must act on the speed at the end of the step [N m s/rad]; ``None`` if none."""
        stack = self.effects
        return stack.state.implicit_damping if stack is not None and stack.changes_passive else None

    @property
    def changes_passive(self) -> bool:
        """Whether ``joint_friction`` and ``joint_viscous_friction`` change from call to call."""
        own = self.holds_line or self.cfg.implicit or self._feeds_back
        return own or (self.effects is not None and self.effects.changes_passive)

    @property
    def needs_load(self) -> bool:
        """Whether an effect reads the torque of gravity and load (:meth:`set_load_effort`)."""
        return self.effects is not None and self.effects.needs_load

    @property
    def needs_link(self) -> bool:
        """Whether effects need what :meth:`set_link` gives."""
        return self.effects is not None and self.effects.needs_link

    @property
    def changes_armature(self) -> bool:
        """Whether ``joint_armature`` changes from call to call."""
        return self.effects is not None and self.effects.changes_armature

    @property
    def distorts_measurement(self) -> bool:
        """Whether an effect lets encoders show something else than the joints' positions."""
        return self.effects is not None and self.effects.has("measurement")

    def sensed_position(self, joint_pos: torch.Tensor) -> torch.Tensor:
        """What the encoder shows, before its bias is subtracted [rad], (num_envs, num_joints).

        Args:
            joint_pos: q [rad], (num_envs, num_joints).
        """
        return joint_pos if self.effects is None else self.effects.sensed_position(joint_pos)

    def position_that_shows(self, encoder_pos: torch.Tensor) -> torch.Tensor:
        """The joint position at which the encoder shows a value before its bias: inverse of :meth:`sensed_position`.

        Args:
            encoder_pos: [rad], (num_envs, num_joints).
        """
        position = encoder_pos.clone()
        if self.distorts_measurement:
            for _ in range(_INVERSION_STEPS):
                position += encoder_pos - self.sensed_position(position)
        return position

    def observe(self, joint_pos: torch.Tensor, joint_vel: torch.Tensor) -> torch.Tensor:
        """What the encoder shows now, before its bias; may be called before :meth:`compute` of the same instant.

        Args:
            joint_pos: q [rad], (num_envs, num_joints).
            joint_vel: v [rad/s], (num_envs, num_joints).
        """
        if self.effects is None:
            return joint_pos
        self.effects.begin_step(joint_pos, joint_vel)
        return self.sensed_position(joint_pos)

    def set_load_effort(self, load_effort: torch.Tensor) -> None:
        """Give the torque of gravity and load on the joints at this instant [N m], (num_envs, num_joints)."""
        if self.effects is not None:
            self.effects.state.load_effort = load_effort

    def set_link(self, inertia: torch.Tensor, stiffness: torch.Tensor, spare: torch.Tensor) -> None:
        """Give what the joints carry at this instant, (num_envs, num_joints) each.

        Args:
            inertia: Without armature [kg m²].
            stiffness: How fast gravity pulls back with the angle [N m/rad].
            spare: What may be taken from the inertia beyond the armature [kg m²].
        """
        if self.effects is not None:
            s = self.effects.state
            s.link_inertia, s.load_stiffness, s.spare_inertia = inertia, stiffness, spare

    def set_session_time(self, time: torch.Tensor) -> None:
        """Set the time since the session began [s], (num_envs, 1) or (num_envs, num_joints); it goes on from there."""
        if self.effects is not None:
            self.effects.state.time = time.expand_as(self.effects.state.time)
