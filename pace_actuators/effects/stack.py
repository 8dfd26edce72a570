"""The effects of a drive, run stage by stage."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect
from pace_actuators.effects.effect_cfg import EffectCfg
from pace_actuators.effects.registry import available_effects
from pace_actuators.effects.two_mass import join_couplings
from pace_actuators.joint_values import resolve_joint_values
from pace_actuators.part import Part

_IN_DRIVE = ("current_limit", "current_loop", "drive", "torque_speed")
"""The way of a torque through the drive: what is asked, what flows, what comes of it, what the supply leaves."""

_STAGES = (
    "advance",
    "hold",
    "command",
    "measurement",
    "sensed_velocity",
    "controller",
    "controller_effort",
    "effort_command",
    "feedback",
    *_IN_DRIVE,
    "friction",
    "transmission",
    "armature",
    "constraint",
)


class EffectStack(Part):
    """Holds a drive's effects and the state that they share."""

    memory = ("_step_begun",)

    def __init__(
        self,
        cfgs: Sequence[EffectCfg],
        joint_names: Sequence[str],
        num_envs: int,
        *,
        dt: float,
        control_dt: float,
        delay_mode: str,
        device: torch.device,
        dtype: torch.dtype,
    ):
        """Build the effects.

        Args:
            dt: Time between two calls of the drive [s].
            control_dt: Time between two runs of the controller [s].
            delay_mode: What the drive's own delay delays.
            dtype: Type of all tensors.
        """
        self.state = DriveState.zeros(num_envs, len(joint_names), device, dtype)
        self.state.enabled.fill_(1.0)
        self._joint_names = list(joint_names)
        self._num_envs = num_envs
        self.dt = dt
        self.effects: list[Effect] = []
        for cfg in cfgs:
            rows = slice(None) if cfg.env_rows is None else cfg.env_rows
            effect = cfg.effect_class(
                num_envs,
                len(joint_names),
                dt=dt,
                control_dt=control_dt,
                delay_mode=delay_mode,
                rows=rows,
                device=device,
                dtype=dtype,
            )
            self.effects.append(effect)
            self._configure(effect, cfg)
        self._step_begun = False
        self._arrange()

    def _arrange(self) -> None:
        """Note what each effect sees of the state, in which order they act, and what they do together."""
        known = {name: place for place, name in enumerate(available_effects())}
        in_order = sorted(self.effects, key=lambda effect: (_side(effect), known.get(effect.name, len(known))))
        self.views = {each: self.state.of_rows(each.rows, each.reads_load, each.reads_link) for each in self.effects}
        """What each effect sees of the state."""
        self._at = {
            stage: [(getattr(effect, stage), self.views[effect]) for effect in in_order if effect.overrides(stage)]
            for stage in _STAGES
        }
        for effect in self.effects:
            effect.meets_soft_friction = bool(self._at["constraint"])
        self.acts_in_drive = any(self._at[stage] for stage in _IN_DRIVE)
        """Whether what is asked of the motor becomes another torque between its two limits."""
        self.changes_passive = bool(self._at["friction"] or self._at["transmission"])
        """Whether friction or viscous friction change from step to step."""
        self.changes_armature = any(effect.changes_armature for effect in self.effects)
        """Whether the armature changes from step to step."""
        self.lags = [effect for effect in self.effects if effect.overrides("observation_lag")]
        self.needs_load = any(effect.reads_load for effect in self.effects)
        """Whether the torque of gravity and load must be given."""
        self.needs_link = any(effect.reads_link for effect in self.effects)
        """Whether the inertia of what the joints carry must be given."""

    def has(self, stage: str) -> bool:
        """Whether an effect acts at a stage."""
        return bool(self._at[stage])

    def run(self, stage: str) -> None:
        """Let all effects of a stage act."""
        for act, view in self._at[stage]:
            act(view)

    def of(self, effects: Sequence[Effect], state: DriveState) -> EffectStack:
        """A stack like it, of effects that share a state."""
        stack = copy.copy(self)
        stack.effects, stack.state, stack._num_envs = list(effects), state, len(state.time)
        stack._arrange()
        return stack

    def find(self, name: str) -> Effect:
        """The effect of that name."""
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise ValueError(
            f"The drive has no effect {name!r}. It has: {', '.join(e.name for e in self.effects) or 'none'}."
        )

    def reset(self, chosen: torch.Tensor | None = None) -> None:
        """Forget the history of all environments, or of some, (num_envs,) bool."""
        self._step_begun = False
        for effect in self.effects:
            own = None if chosen is None else chosen[effect.rows]
            if own is None or own.is_cuda or bool(own.any()):  # a GPU is not waited for
                effect.reset_state(slice(None) if own is None else own)

    def take_over(self, armature: torch.Tensor, friction: torch.Tensor, viscous_friction: torch.Tensor) -> None:
        """Take over changed parameters of the base model, (num_envs, num_joints) each, and of the effects."""
        s = self.state
        s.base_armature, s.base_friction, s.base_viscous_friction = armature, friction, viscous_friction
        for effect in self.effects:
            effect.prepare()
        join_couplings(self.effects, self._num_envs)
        s.armature, s.friction, s.viscous_friction = armature, friction, viscous_friction
        self.run("armature")
        s.friction_time.zero_()
        self.run("constraint")

    def begin_step(self, joint_pos: torch.Tensor, joint_vel: torch.Tensor) -> None:
        """Bring the effects' own states to the present instant, once per physics step."""
        if self._step_begun:
            return
        s = self.state
        s.joint_pos, s.joint_vel = joint_pos, joint_vel
        s.motor_pos, s.motor_vel = joint_pos, joint_vel
        self.run("advance")
        self._step_begun = True

    def held(
        self,
        joint_pos: torch.Tensor,
        joint_vel: torch.Tensor,
        position: torch.Tensor,
        speed: torch.Tensor,
        free: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Hold encoders: position [rad] and speed [rad/s] of the joints, as :meth:`PaceDCMotor.held`."""
        self.begin_step(joint_pos, joint_vel)
        s = self.state
        s.held, s.held_pos, s.held_vel = torch.where(free, 0.0, 1.0), position, speed
        s.motor_pos = torch.where(free, s.motor_pos, position)
        s.motor_vel = torch.where(free, s.motor_vel, speed)
        self.run("hold")
        s.joint_pos = torch.where(free, joint_pos, s.held_pos)
        s.joint_vel = torch.where(free, joint_vel, s.held_vel)
        return s.joint_pos.clone(), s.joint_vel.clone()

    def end_step(self) -> None:
        """Let the time go on to the next instant."""
        self.state.time += self.dt
        self._step_begun = False

    def target_inside(self, position: torch.Tensor) -> torch.Tensor:
        """The target after the effects on it [rad]."""
        if not self._at["command"]:
            return position
        self.state.joint_pos_target = position
        self.run("command")
        return self.state.joint_pos_target

    def sensed_position(self, joint_pos: torch.Tensor) -> torch.Tensor:
        """What the encoder shows, before its bias is subtracted [rad]."""
        if not self._at["measurement"]:
            return joint_pos
        s = self.state
        s.encoder_pos, s.joint_pos = joint_pos, joint_pos
        self.run("measurement")
        return s.encoder_pos

    def seen_by_controller(
        self, joint_vel: torch.Tensor, stiffness: torch.Tensor, damping: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Speed and gains after the effects on them; ``state.speed_slope`` is the part of the speed that is seen."""
        s = self.state
        if self._at["sensed_velocity"]:
            s.speed_slope.fill_(1.0)
            s.encoder_vel = joint_vel
            self.run("sensed_velocity")
            joint_vel = s.encoder_vel
        if self._at["controller"]:
            s.stiffness, s.damping = stiffness, damping
            self.run("controller")
            stiffness, damping = s.stiffness, s.damping
        return joint_vel, stiffness, damping

    def given_by_controller(self, effort: torch.Tensor, position_error: torch.Tensor) -> torch.Tensor:
        """The torque of the PD law after the effects on it [N m]; ``position_error`` is what that saw [rad]."""
        if not self._at["controller_effort"]:
            return effort
        s = self.state
        s.effort, s.position_error = effort, position_error
        self.run("controller_effort")
        return s.effort.clone()

    def asked_of_drive(self, effort: torch.Tensor) -> torch.Tensor:
        """The controller's torque after the effects on it [N m]; ``state.speed_slope`` is the newest one's part."""
        if not self._at["effort_command"]:
            return effort
        self.state.speed_slope.fill_(1.0)
        self.state.effort = effort
        self.run("effort_command")
        return self.state.effort.clone()

    def fed_back(self, effort: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The torque that is asked as it follows the motion [N m], and how fast it falls with the speed in the step."""
        s = self.state
        s.effort = effort
        s.speed_slope.zero_()
        self.run("feedback")
        return s.effort.clone(), s.speed_slope.clone()

    def given_by_drive(
        self, effort: torch.Tensor, speed_slope: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The torque before the torque-speed line [N m], and how fast it falls with the speed where effects limit it.

        Args:
            effort: What is asked of the motor, within its limit [N m].
            speed_slope: How fast that falls with the speed within the physics step; ``None`` for not at all.
        """
        s = self.state
        s.effort = effort
        if speed_slope is None:
            s.speed_slope.zero_()
        else:
            s.speed_slope = speed_slope
        for stage in _IN_DRIVE:
            self.run(stage)
        return s.effort, s.speed_slope

    def at_the_joint(
        self,
        effort: torch.Tensor,
        friction: torch.Tensor,
        viscous_friction: torch.Tensor,
        speed_slope: torch.Tensor | None,
    ) -> torch.Tensor:
        """The torque after friction and transmission [N m]; what the simulator is to apply itself is in ``state``.

        Args:
            effort: The motor's torque [N m].
            friction: Coulomb friction of the base model [N m].
            viscous_friction: Of the base model [N m s/rad].
            speed_slope: How fast the motor's torque falls with the speed between two calls; ``None`` for not at all.
        """
        s = self.state
        s.motor_effort, s.effort = effort, effort
        s.friction, s.viscous_friction = friction, viscous_friction
        s.implicit_damping.zero_()
        if speed_slope is not None:
            s.effort += speed_slope * s.motor_vel
            s.viscous_friction += speed_slope
        if self.changes_armature:
            s.armature = s.base_armature
            self.run("armature")
        self.run("friction")
        self._only_brakes()
        self.run("transmission")
        self._only_brakes()
        return s.effort.clone()

    def _only_brakes(self) -> None:
        """Friction drives nothing, neither the joint nor a motor that a transmission parts from it."""
        s = self.state
        torch.clamp(s.friction, min=0.0, out=s.friction)
        torch.clamp(s.viscous_friction, min=0.0, out=s.viscous_friction)

    def observation_lag(self, time: torch.Tensor) -> torch.Tensor | None:
        """How late the samples of a recording are [s], (num_envs, num_joints); ``None`` if no effect says so.

        Args:
            time: Of the samples since their recording began [s], (num_envs, num_joints).
        """
        if not self.lags:
            return None
        total = torch.zeros_like(self.state.time)
        for effect in self.lags:
            lag = effect.observation_lag(time[effect.rows])
            if lag is not None:
                total[effect.rows] += lag
        return total

    def _configure(self, effect: Effect, cfg: EffectCfg) -> None:
        names = cfg.joints(self._joint_names)
        joints = torch.tensor([self._joint_names.index(name) for name in names], device=self.state.time.device)
        for name, value in cfg.values.items():
            values = resolve_joint_values(value, names, field=f"{effect.name}.{name}")
            effect.set_parameter(name, values, joints=joints)
        effect.prepare()


def _side(effect: Effect) -> int:
    """From motor to link: friction, what parts the two, torques on the link."""
    if effect.parts_motor_and_link:
        return 1
    return 0 if effect.stage == "friction" else 2
