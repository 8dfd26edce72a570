"""The identified drive: PD control, encoder bias, delay and a DC motor's torque-speed limit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from pace_actuators.dc_motor import clip_to_line, pd_effort
from pace_actuators.delay_buffer import Jump
from pace_actuators.drive import ControllerRun, Drive


class PaceDCMotor(Drive):
    """A PD-controlled DC motor with encoder bias and delay, batched over environments.

    The way of a command through the drive, once per run of its controller up to the hold, once per call after it:

        q_enc = q - bias
        τ     = kp (q* - q_enc) + kd (q̇* - q̇) + τ_ff        q*, q̇*, τ_ff delayed  (delay_mode "command")
        τ     = τ(t - delay)                                  the torque delayed     (delay_mode "effort")
        ------- held until the controller runs again; a command that arrives in between acts at once -------
        (the effect fast_loop lets τ follow the motion in between)
        τ     = clip(τ, ± effort_limit)                       limit of what is asked, a current limit
        τ     = clip(τ, τ_min(v), τ_max(v))                   torque-speed line
        τ     = 0 where the drive is disabled

    The two limits make Isaac Lab's four-quadrant clip. Effects of ``cfg.effects`` act on this way, each at its stage:
    command, measurement, controller, drive (between the two limits: current loop, torque constant), friction and
    transmission (after them). What they ask the simulator to apply itself is in ``joint_armature``,
    ``joint_friction`` and ``joint_viscous_friction``.

    Source: Bjelonic et al., PACE (arXiv 2509.06342); torque-speed limit as Isaac Lab's ``DCMotor``.
    The constructor, the attributes and :meth:`compute` are those of an Isaac Lab actuator. Override
    :meth:`compute_effort_command` or :meth:`drive_effort` to model another motor; what that keeps from call to call,
    name in ``memory``.

    Attributes:
        computed_effort: The controller's torque before the drive's limits [N m], (num_envs, num_joints).
        motor_effort: The motor's torque, before friction and transmission [N m], (num_envs, num_joints).
        applied_effort: The torque at the joint [N m], (num_envs, num_joints).
        stiffness, damping, effort_limit, saturation_effort, velocity_limit: See the configuration;
            each (num_envs, num_joints) and writable per environment.
        armature, friction, dynamic_friction, viscous_friction: The identified ones, (num_envs, num_joints).
        effects: The effects beyond the base model, an ``EffectStack``, or ``None``.
        encoder_bias: [rad], (num_envs, num_joints).
        torque_enable: Whether the drive gives torque, (num_envs, 1), or ``None`` when all do.
        holds_line: Whether, between two calls, the simulator holds a torque that runs along the torque-speed line
            (``held_effort`` with its slope in ``joint_viscous_friction``) rather than one number: more exact, for
            simulators that take both.
        is_trapezoidal: Whether the simulator moves positions with the mean of the old and the new speed.
    """

    def compute(self, control_action: Any, joint_pos: torch.Tensor, joint_vel: torch.Tensor) -> Any:
        """Turn commands into joint torques.

        Args:
            control_action: Has ``joint_positions`` [rad], ``joint_velocities`` [rad/s] and
                ``joint_efforts`` [N m], each (num_envs, num_joints) or ``None`` for zero
                (:class:`ActuatorActions` or Isaac Lab's ``ArticulationActions``).
            joint_pos: True joint positions q [rad], (num_envs, num_joints).
            joint_vel: Joint velocities v [rad/s], (num_envs, num_joints).

        Returns:
            A copy of ``control_action`` whose ``joint_efforts`` are the torques at the joints [N m].

        Raises:
            ValueError: If something has another shape.
        """
        self._check_shapes(
            joint_pos=joint_pos,
            joint_vel=joint_vel,
            joint_positions=control_action.joint_positions,
            joint_velocities=control_action.joint_velocities,
            joint_efforts=control_action.joint_efforts,
        )
        if ahead := self._ahead:
            joint_pos = torch.add(joint_pos, joint_vel, alpha=-ahead)
        if self.effects is not None:
            self.effects.begin_step(joint_pos, joint_vel)
        if self._calls_until_control == 0:
            self.computed_effort = self.compute_effort_command(control_action, joint_pos, joint_vel)
            self._calls_until_control = self._calls_per_run
            self._alone = None
        else:
            if self._delays.changes(part := self._calls_per_run - self._calls_until_control):
                self.computed_effort = self._effort_command_at(part)
            if self._any_renewed:
                self._alone = self._run_alone(control_action, joint_pos, joint_vel)
                self._renewed.zero_()
                self._any_renewed = False
            if self._alone is not None:
                others = self._alone.isnan()
                self.computed_effort = torch.where(others, self.computed_effort, self._alone)
                if self._jump is not None:
                    self._jump = self._jump._replace(rise=self._jump.rise * others)
        self._calls_until_control -= 1
        asked = self.computed_effort
        if self.effects is not None and self.effects.has("effort_command"):
            asked = self.effects.asked_of_drive(asked)
            if self._loop_slope is not None:
                self._loop_slope = self._loop_slope * self.effects.state.speed_slope
        if self._feeds_back:
            asked, self._loop_slope = self.effects.fed_back(asked)  # type: ignore[union-attr]
        effort = self.motor_effort = self.drive_effort(asked, joint_pos, joint_vel)
        self._jump = None
        if self.effects is not None:
            effort = self.transmitted_effort(effort)
            self.effects.end_step()
        self.applied_effort = self._held_effort = effort
        if self._speed_slope is not None:
            if self.effects is not None and self.effects.changes_passive:  # the line is in it
                self.applied_effort = torch.addcmul(effort, self._speed_slope, joint_vel, value=-1)
            else:
                self._held_effort = torch.addcmul(effort, self._speed_slope, joint_vel)
        return dataclasses.replace(
            control_action, joint_positions=None, joint_velocities=None, joint_efforts=self.applied_effort
        )

    def step(
        self, state: Mapping[str, Any], control_action: Any, joint_pos: torch.Tensor, joint_vel: torch.Tensor
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        """:meth:`compute` as a function: the drive itself stays as it was. It copies the state, which takes time.

        Args:
            state: Of :meth:`snapshot`, or of a step before. What effects read of the robot is in it.
            control_action: As in :meth:`compute`.
            joint_pos: q [rad], (num_envs, num_joints).
            joint_vel: v [rad/s], (num_envs, num_joints).

        Returns:
            The torques at the joints [N m], (num_envs, num_joints), and the state after them.
        """
        own = self.snapshot()
        self.restore(state)
        try:
            return self.compute(control_action, joint_pos, joint_vel).joint_efforts, self.snapshot()
        finally:
            self.restore(own)

    def compute_effort_command(
        self, control_action: Any, joint_pos: torch.Tensor, joint_vel: torch.Tensor
    ) -> torch.Tensor:
        """The controller's part, once per run of it: encoder, delays and PD law.

        Args:
            control_action: As in :meth:`compute`.
            joint_pos: q [rad], (num_envs, num_joints).
            joint_vel: v [rad/s], (num_envs, num_joints).

        Returns:
            The torque that is asked of the drive [N m], (num_envs, num_joints).
        """
        target = control_action.joint_positions
        if target is not None and self.effects is not None:
            target = self.effects.target_inside(target)
        position = self._delays.push("positions", target)
        velocity = self._delays.push("velocities", control_action.joint_velocities)
        feed_forward = self._delays.push("efforts", control_action.joint_efforts)
        stiffness, damping, encoder_vel = self.stiffness, self.damping, joint_vel
        if self.effects is not None:
            encoder_vel, stiffness, damping = self.effects.seen_by_controller(joint_vel, stiffness, damping)
        encoder_pos = self.sensed_position(joint_pos) - self.encoder_bias
        if self._own_dt is not None:
            encoder_pos, encoder_vel = self._held_between_runs(encoder_pos, encoder_vel, self._own_dt)
        if self.cfg.implicit:
            encoder_pos = self._within_the_step(encoder_pos, encoder_vel, stiffness, damping)
        if position is None:  # no position target: velocity and effort control
            position = encoder_pos
        velocity_error = -encoder_vel if velocity is None else velocity - encoder_vel
        position_error = position - encoder_pos
        effort = pd_effort(position_error, velocity_error, stiffness, damping)
        if self._calls_per_run > 1:
            self._run = ControllerRun(encoder_pos, encoder_vel.clone(), stiffness, damping, velocity, feed_forward)
        if self.effects is not None and self.effects.has("controller_effort"):
            if target is not None:
                position_error = self._delays.mean("positions", position) - encoder_pos
            plain = effort.clone()
            effort = self.effects.given_by_controller(effort, position_error)
            if self._run is not None:
                self._run.added = effort - plain
        if feed_forward is not None:
            effort += feed_forward
        if self.cfg.delay_mode == "effort":
            effort = self._delays.push("torque", effort)
        self._jump = self._jump_of_torque(0, stiffness, damping)
        return effort

    def _run_alone(self, control_action: Any, joint_pos: torch.Tensor, joint_vel: torch.Tensor) -> torch.Tensor:
        """What the controllers of reset drives ask while the others hold [N m]; NaN for the others.

        Nothing of the others changes. A delay shows the present command, as after any reset.
        """
        own = self.snapshot()
        self.reset()
        if self.effects is not None:
            self.effects.begin_step(joint_pos, joint_vel)
        effort = self.compute_effort_command(control_action, joint_pos, joint_vel)
        self.restore(own)
        others = torch.full_like(effort, torch.nan) if self._alone is None else self._alone
        return torch.where(self._renewed, effort, others)

    def _effort_command_at(self, part: int) -> torch.Tensor:
        """The controller's torque [N m] at a call between two of its runs, when a command or a torque has arrived."""
        delays, run = self._delays, self._run
        if run is None:  # a subclass has another law
            return self.computed_effort
        self._jump = self._jump_of_torque(part, run.stiffness, run.damping)
        if self.cfg.delay_mode == "effort":
            return delays.at("torque", part, self.computed_effort)
        position = delays.at("positions", part, None)
        velocity = delays.at("velocities", part, run.velocity)
        feed_forward = delays.at("efforts", part, run.feed_forward)
        position_error = torch.zeros_like(run.encoder_pos) if position is None else position - run.encoder_pos
        velocity_error = -run.encoder_vel if velocity is None else velocity - run.encoder_vel
        effort = pd_effort(position_error, velocity_error, run.stiffness, run.damping)
        for more in (run.added, feed_forward):
            if more is not None:
                effort += more
        return effort

    def _jump_of_torque(self, part: int, stiffness: torch.Tensor, damping: torch.Tensor) -> Jump | None:
        """How the torque that is asked changes within a call, as a command or a torque arrives [N m]."""
        gains = {"positions": stiffness, "velocities": damping, "efforts": None}
        delayed = gains if self.cfg.delay_mode == "command" else {"torque": None}
        jumps = [(self._delays.jump(name, part), gain) for name, gain in delayed.items()]
        found = [(jump, gain) for jump, gain in jumps if jump is not None]
        if not found:
            return None
        rises = [jump.rise if gain is None else gain * jump.rise for jump, gain in found]
        return Jump(_sum(rises), found[0][0].share)

    def _in_parts(self, effort: torch.Tensor) -> list[tuple[torch.Tensor | float, torch.Tensor]]:
        """The torques of which a mean torque is made in a call, and how much of the time each has."""
        if self._jump is None:
            return [(1.0, effort)]
        rise, share = self._jump
        return [(1 - share, effort + share * rise), (share, effort - (1 - share) * rise)]

    def _within_the_step(
        self, position: torch.Tensor, speed: torch.Tensor, stiffness: torch.Tensor, damping: torch.Tensor
    ) -> torch.Tensor:
        """What a continuous controller sees of the position in the coming step [rad]; sets its slope over the speed.

        Where a simulator moves positions with the mean speed, the law is that of the middle of the step.
        """
        sees_all = self.effects is None or not self.effects.has("sensed_velocity")
        self._loop_slope = damping if sees_all else damping * self.effects.state.speed_slope  # type: ignore[union-attr]
        if not self.is_trapezoidal or self._physics_dt is None:
            return position
        half = 0.5 * self._physics_dt
        self._loop_slope = self._loop_slope + half * stiffness
        return torch.add(position, speed, alpha=half)

    def drive_effort(
        self, effort_command: torch.Tensor, joint_pos: torch.Tensor, joint_vel: torch.Tensor
    ) -> torch.Tensor:
        """The drive's part, at every call: what the motor makes of the torque asked of it.

        Args:
            effort_command: The torque asked for [N m], (num_envs, num_joints).
            joint_pos: q [rad], (num_envs, num_joints).
            joint_vel: v [rad/s], (num_envs, num_joints).

        Returns:
            The motor's torque [N m], (num_envs, num_joints).
        """
        asked, slope = effort_command, self._loop_slope
        speed = joint_vel if self.effects is None else self.effects.state.motor_vel
        parts = self._in_parts(asked)
        clamped = [(share, part, part.clamp(-self.effort_limit, self.effort_limit)) for share, part in parts]
        asked = _mean(asked, clamped)
        if slope is not None:
            slope = _sum([share * (slope * (after == part)) for share, part, after in clamped])
        parts = [(share, after) for share, _, after in clamped]
        if self.effects is not None and self.effects.acts_in_drive:
            given, slope = self.effects.given_by_drive(asked, slope)
            parts = [(1.0, given)] if len(parts) == 1 else [(share, part + (given - asked)) for share, part in parts]
            asked = given
        limits = speed, self.saturation_effort, self.effort_limit, self.velocity_limit
        clipped = [(share, part, clip_to_line(part, *limits)) for share, part in parts]
        effort = _mean(asked, clipped)
        if self.holds_line or self._loop_slope is not None:
            own = 0.0 if slope is None else slope
            line = self.saturation_effort / self.velocity_limit if self.holds_line else 0.0
            slopes = [
                torch.where(after == part, own, line * (after.abs() != self.effort_limit)) for _, part, after in clipped
            ]
            self._speed_slope = _sum([share * each for (share, *_), each in zip(clipped, slopes, strict=True)])
        if self.torque_enable is not None:
            effort = effort * self.torque_enable
            if self._speed_slope is not None:
                self._speed_slope = self._speed_slope * self.torque_enable
        return effort

    def transmitted_effort(self, effort: torch.Tensor) -> torch.Tensor:
        """The transmission's part, at every call: effects of friction and transmission.

        Args:
            effort: The motor's torque [N m], (num_envs, num_joints).

        Returns:
            The torque at the joint [N m]; friction that the simulator is to apply is in ``joint_friction`` and
            ``joint_viscous_friction``.
        """
        if self.effects is None or not self.effects.changes_passive:
            return effort
        return self.effects.at_the_joint(effort, self.friction, self.viscous_friction, self._speed_slope)


def _mean(asked: torch.Tensor, limited: Sequence[tuple[torch.Tensor | float, torch.Tensor, torch.Tensor]]) -> Any:
    """What limits leave of a mean torque [N m]; exactly that torque where no part of it meets one.

    Args:
        asked: The mean torque [N m].
        limited: Of each part its share of the time, its torque, and what limits leave of that.
    """
    if len(limited) == 1:
        return limited[0][2]
    return asked + _sum([share * (after - part) for share, part, after in limited])


def _sum(terms: Sequence[torch.Tensor]) -> torch.Tensor:
    return sum(terms[1:], terms[0])
