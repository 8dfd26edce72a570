"""The identified drive: PD control, encoder bias, delay and a DC motor's torque-speed limit."""

from __future__ import annotations

import dataclasses
import math
import re
import warnings
from collections.abc import Sequence
from typing import Any

import torch

from pace_actuators.dc_motor import clip_effort, clip_to_line, pd_effort
from pace_actuators.drive_delays import DriveDelays
from pace_actuators.drive_parameters import DriveParameters
from pace_actuators.drive_rates import calls_per_run
from pace_actuators.effects import EffectCfg, EffectStack, effect_cfgs
from pace_actuators.identified import delay_in_steps, step_notes
from pace_actuators.pace_dc_motor_cfg import PaceDCMotorCfg

EnvIds = Sequence[int] | torch.Tensor | slice | None

_INVERSION_STEPS = 6
"""Fixed-point steps to invert an encoder's error: it is small, each step divides what is left by ten or more."""


@dataclasses.dataclass
class _Run:
    """What the controller keeps of a run for commands that arrive before the next, (num_envs, num_joints) each."""

    encoder_pos: torch.Tensor
    encoder_vel: torch.Tensor
    stiffness: torch.Tensor
    damping: torch.Tensor
    velocity: torch.Tensor | None
    feed_forward: torch.Tensor | None
    added: torch.Tensor | None = None


class PaceDCMotor:
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
    :meth:`compute_effort_command` or :meth:`drive_effort` to model a motor of your own.

    Attributes:
        computed_effort: The controller's torque before the drive's limits [N m], (num_envs, num_joints).
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
        centred: Whether the first call of a control step gives the mean of the old and the new torque. Where a
            simulator updates speeds before positions (semi-implicit Euler), a torque acts half a physics step early;
            with this it does not.
        is_trapezoidal: Whether the simulator moves positions with the mean of the old and the new speed.
    """

    is_implicit_model = False

    def __init__(
        self,
        cfg: PaceDCMotorCfg,
        joint_names: Sequence[str],
        joint_ids: slice | torch.Tensor | Sequence[int],
        num_envs: int,
        device: str | torch.device = "cpu",
        stiffness: torch.Tensor | float = 0.0,
        damping: torch.Tensor | float = 0.0,
        armature: torch.Tensor | float = 0.0,
        friction: torch.Tensor | float = 0.0,
        dynamic_friction: torch.Tensor | float | None = None,
        viscous_friction: torch.Tensor | float = 0.0,
        effort_limit: torch.Tensor | float = torch.inf,
        velocity_limit: torch.Tensor | float = torch.inf,
        *,
        physics_dt: float | None = None,
        dtype: torch.dtype = torch.float32,
    ):
        """Create the drive of a group of joints.

        Args:
            cfg: The configuration.
            joint_names: Names of the joints of the group, in order.
            joint_ids: Their indices in the articulation (kept for the caller).
            num_envs: Number of environments.
            device: Device of all tensors.
            stiffness: Used where the configuration says ``None``; so are the following arguments.
            damping: [N m s/rad].
            armature: [kg m^2].
            friction: Coulomb friction [N m].
            dynamic_friction: Isaac Lab's friction while sliding [N m]; equal to ``friction`` if ``None``, and
                where the configuration gives the friction.
            viscous_friction: [N m s/rad].
            effort_limit: [N m].
            velocity_limit: [rad/s].
            physics_dt: Time between two calls of :meth:`compute` [s], where the configuration says ``None``.
            dtype: Type of all tensors.

        Raises:
            ValueError: If a value is missing, negative or not finite where it must be.
        """
        self.cfg = cfg
        self._joint_names = list(joint_names)
        self._joint_indices = joint_ids
        self._num_envs = num_envs
        self._device = torch.device(device)
        self._dtype = dtype
        parameters = DriveParameters(cfg, joint_names, num_envs, self._device, dtype)

        self.stiffness = parameters.read("stiffness", stiffness)
        self.damping = parameters.read("damping", damping)
        self.armature = parameters.read("armature", armature)
        self.friction = parameters.read("friction", friction)
        self.dynamic_friction = (
            self.friction.clone()
            if dynamic_friction is None or cfg.friction is not None
            else parameters.tensor(dynamic_friction, "dynamic_friction")
        )
        self.viscous_friction = parameters.read("viscous_friction", viscous_friction)
        self.effort_limit = parameters.read("effort_limit", effort_limit)
        self.effort_limit_sim = self.effort_limit.clone()
        self.velocity_limit = parameters.read("velocity_limit", velocity_limit)
        self.velocity_limit_sim = self.velocity_limit.clone()
        if cfg.saturation_effort is None:
            # no torque-speed line was asked for: a stall torque (finite) beyond all others and no fall with speed
            self.saturation_effort = torch.full_like(self.effort_limit, torch.finfo(dtype).max)
            self.velocity_limit = torch.full_like(self.velocity_limit, torch.inf)
        else:
            self.saturation_effort = parameters.read("saturation_effort", torch.inf)
        self.encoder_bias = parameters.read("encoder_bias", 0.0)
        self.torque_enable: torch.Tensor | None = None
        self.holds_line = False
        self.centred = False
        self.is_trapezoidal = False
        self._first_call = True
        self._speed_slope: torch.Tensor | None = None
        self._loop_slope: torch.Tensor | None = None
        self._run: _Run | None = None

        self.computed_effort = torch.zeros_like(self.stiffness)
        self.applied_effort = self._held_effort = torch.zeros_like(self.stiffness)
        delayed = ("positions", "velocities", "efforts") if cfg.delay_mode == "command" else ("torque",)
        dt = self._physics_dt = cfg.physics_dt or physics_dt
        delay, max_delay = delay_in_steps(cfg, dt)
        for note in step_notes(cfg, dt):
            warnings.warn(note, stacklevel=2)
        self._calls_per_run = calls = calls_per_run(cfg, dt)
        self._delays = DriveDelays(
            delayed,
            max_delay,
            num_envs,
            self._device,
            cfg.delay_interpolation,
            runs=cfg.control_decimation // calls,
            parts=calls,
        )
        self._asked = self.computed_effort
        self._calls_until_control = 0
        self.update_time_lags(delay)
        self._delays.set_lead(self._lead)
        self.effects = self._make_effects(dt)
        self.update_effects()

    @property
    def _feeds_back(self) -> bool:
        """Whether an effect lets the torque of a loop that is held follow the motion in between."""
        held = not self.cfg.implicit and self.cfg.delay_mode == "command"
        return held and self.effects is not None and self.effects.has("feedback")

    @property
    def num_joints(self) -> int:
        """Number of joints in the group."""
        return len(self._joint_names)

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints in the group."""
        return self._joint_names

    @property
    def joint_indices(self) -> slice | torch.Tensor | Sequence[int]:
        """Indices of the group's joints in the articulation."""
        return self._joint_indices

    @property
    def run_dt(self) -> float:
        """Time between two runs of the controller [s]; infinite where the physics step is not known."""
        return math.inf if self._physics_dt is None else self._calls_per_run * self._physics_dt

    @property
    def time_lags(self) -> torch.Tensor:
        """Delay [control steps] of each environment, (num_envs,), or joint, (num_envs, num_joints)."""
        return self._delays.time_lags

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
        """
        if self.effects is not None:
            self.effects.begin_step(joint_pos, joint_vel)
        before, first = self._asked, self._first_call
        if self._calls_until_control == 0:
            self.computed_effort = self.compute_effort_command(control_action, joint_pos, joint_vel)
            self._calls_until_control = self._calls_per_run
            self._first_call = False
        elif self._delays.changes(part := self._calls_per_run - self._calls_until_control):
            self.computed_effort = self._effort_command_at(part)
        self._calls_until_control -= 1
        asked = self.computed_effort
        if self.effects is not None and self.effects.has("effort_command"):
            asked = self.effects.asked_of_drive(asked)
            if self._loop_slope is not None:
                self._loop_slope = self._loop_slope * self.effects.state.speed_slope
        self._asked = asked
        if self.centred and not first and asked is not before:
            asked = 0.5 * (before + asked)
        if self._feeds_back:
            asked, self._loop_slope = self.effects.fed_back(asked)  # type: ignore[union-attr]
        effort = self.drive_effort(asked, joint_pos, joint_vel)
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
        if self.cfg.implicit:
            encoder_pos = self._within_the_step(encoder_pos, encoder_vel, stiffness, damping)
        if position is None:  # no position target: velocity and effort control
            position = encoder_pos
        velocity_error = -encoder_vel if velocity is None else velocity - encoder_vel
        position_error = position - encoder_pos
        effort = pd_effort(position_error, velocity_error, stiffness, damping)
        if self._calls_per_run > 1:
            self._run = _Run(encoder_pos, encoder_vel.clone(), stiffness, damping, velocity, feed_forward)
        if self.effects is not None and self.effects.has("controller_effort"):
            if target is not None:
                position_error = self._delays.mean("positions", position) - encoder_pos
            plain = effort.clone()
            effort = self.effects.given_by_controller(effort, position_error)
            if self._run is not None:
                self._run.added = effort - plain
        if feed_forward is not None:
            effort += feed_forward
        return self._delays.push("torque", effort) if self.cfg.delay_mode == "effort" else effort

    def _effort_command_at(self, part: int) -> torch.Tensor:
        """The controller's torque [N m] at a call between two of its runs, when a command or a torque has arrived."""
        delays, run = self._delays, self._run
        if self.cfg.delay_mode == "effort":
            return delays.at("torque", part, self.computed_effort)
        if run is None:  # a subclass has a law of its own
            return self.computed_effort
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
        asked, slope = effort_command, None
        speed = joint_vel if self.effects is None else self.effects.state.motor_vel
        clip = clip_effort
        if self.effects is not None and self.effects.acts_in_drive:
            asked = torch.clamp(asked, -self.effort_limit, self.effort_limit)
            if (slope := self._loop_slope) is not None:
                slope = slope * (asked == effort_command)
            asked, slope = self.effects.given_by_drive(asked, slope)
            clip = clip_to_line
        effort = clip(asked, speed, self.saturation_effort, self.effort_limit, self.velocity_limit)
        own = self._loop_slope if slope is None else slope
        if self.holds_line:
            line = self.saturation_effort / self.velocity_limit
            free = effort.abs() != self.effort_limit
            self._speed_slope = torch.where(effort == asked, 0.0 if own is None else own, line * free)
        elif self._loop_slope is not None:
            self._speed_slope = (self._loop_slope if own is None else own) * (effort == asked)
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

    def flags(self) -> list[tuple]:
        """Everything of the drive and its effects that is no tensor and can be compared: what Python branches over."""
        stack = self.effects
        things: list[Any] = [self, self._delays, *([] if stack is None else [stack, *stack.effects])]
        return [
            tuple(
                (key, frozenset(value) if isinstance(value, set) else value)
                for key, value in vars(each).items()
                if value is None or isinstance(value, (bool, int, float, str, set))
            )
            for each in things
        ]

    def update_effects(self) -> None:
        """Take over changed parameters of the base model and of the effects."""
        if self.effects is not None:
            self.effects.take_over(self.armature, self.friction, self.viscous_friction)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Forget the history of all or some environments; parameters stay."""
        self._delays.reset(env_ids)
        if env_ids is None:
            self._calls_until_control = 0
            self._first_call = True
        if self.effects is not None:
            self.effects.reset(env_ids)

    def update_encoder_bias(self, encoder_bias: torch.Tensor | float, env_ids: EnvIds = None) -> None:
        """Set the encoder bias [rad], (len(env_ids), num_joints) or broadcastable to it."""
        rows = slice(None) if env_ids is None else env_ids
        self.encoder_bias[rows] = torch.as_tensor(encoder_bias, dtype=self._dtype, device=self._device)

    def update_time_lags(self, delay: torch.Tensor | float, env_ids: EnvIds = None) -> None:
        """Set the delay [control steps]: a number, (len(env_ids),) or, per joint, (len(env_ids), num_joints).

        Raises:
            ValueError: If a delay lies outside 0 to ``max_delay``, or their number is wrong.
        """
        if isinstance(delay, torch.Tensor) and delay.ndim == 2 and delay.shape[1] not in (1, self.num_joints):
            raise ValueError(
                f"delay has shape {tuple(delay.shape)}, expected 1 or {self.num_joints} columns: "
                "one delay per environment or per joint."
            )
        self._delays.set_time_lag(delay, env_ids)

    def take_over_simulator(self, *, is_trapezoidal: bool, holds_line: bool) -> None:
        """Say how the simulator moves positions, and what it holds between two calls: see the attributes."""
        self.holds_line, self.is_trapezoidal = holds_line, is_trapezoidal
        self.centred = holds_line and not is_trapezoidal
        if self.effects is not None:
            self.effects.is_trapezoidal = is_trapezoidal
        self._delays.set_lead(self._lead)

    @property
    def _lead(self) -> float:
        """By how much the simulator lets a delayed command act too early, in runs of the controller."""
        early = self.cfg.centred_commands and self.cfg.delay_mode == "command"
        return 0.5 / self._calls_per_run if early and not (self.is_trapezoidal or self.centred) else 0.0

    def set_torque_enable(self, enabled: torch.Tensor | None) -> None:
        """Say which environments' drives give torque: bool, shape (num_envs,); ``None`` for all."""
        self.torque_enable = None if enabled is None else enabled.to(self._dtype).reshape(self._num_envs, 1)
        if self.effects is not None:
            given = self.effects.state.enabled
            given.copy_(torch.ones_like(given) if self.torque_enable is None else self.torque_enable.expand_as(given))

    def _make_effects(self, physics_dt: float | None) -> EffectStack | None:
        cfgs = [cfg for cfg in effect_cfgs(self.cfg.effects) if _applies(cfg, self._joint_names)]
        if not cfgs:
            return None
        if physics_dt is None:
            raise ValueError(
                f"The effects {', '.join(cfg.label for cfg in cfgs)} need to know the time between two calls: set "
                "physics_dt [s] in the actuator's configuration."
            )
        return EffectStack(
            cfgs,
            self._joint_names,
            self._num_envs,
            dt=physics_dt,
            control_dt=physics_dt * self._calls_per_run,
            delay_mode=self.cfg.delay_mode,
            device=self._device,
            dtype=self._dtype,
        )


def _applies(cfg: EffectCfg, joint_names: Sequence[str]) -> bool:
    """Whether an effect has joints in this group of joints; in another group it may have some."""
    return any(
        re.fullmatch(pattern, name)
        for pattern in ([cfg.joint_names_expr] if isinstance(cfg.joint_names_expr, str) else cfg.joint_names_expr)
        for name in joint_names
    )
