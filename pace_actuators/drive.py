"""What a drive holds: its numbers, its delays and its effects, batched over environments."""

from __future__ import annotations

import copy
import dataclasses
import math
import re
import warnings
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import torch

from pace_actuators.delay_buffer import EnvIds, Jump
from pace_actuators.drive_delays import DriveDelays
from pace_actuators.effects import EffectCfg, EffectStack, effect_cfgs
from pace_actuators.effects.effect import Conditions, Heat
from pace_actuators.identified import delay_in_steps, step_notes
from pace_actuators.pace_dc_motor_cfg import DriveParameters, PaceDCMotorCfg, calls_per_run
from pace_actuators.part import Part

_ROUNDING = 1e-3
"""Of a period: by so much a run may come early, as sums of steps are rounded."""
_INVERSION_STEPS = 6
"""Fixed-point steps to invert an encoder's error: it is small, each step divides what is left by ten or more."""


@dataclasses.dataclass
class ControllerRun:
    """What the controller keeps of a run for commands that arrive before the next, (num_envs, num_joints) each."""

    encoder_pos: torch.Tensor
    encoder_vel: torch.Tensor
    stiffness: torch.Tensor
    damping: torch.Tensor
    velocity: torch.Tensor | None
    feed_forward: torch.Tensor | None
    added: torch.Tensor | None = None


class Drive(Part):
    """The numbers, delays and effects of a group of joints' drives; the law is :class:`PaceDCMotor`'s."""

    is_implicit_model = False
    memory = (
        *("computed_effort", "motor_effort", "applied_effort", "_held_effort", "_speed_slope", "_loop_slope", "_jump"),
        *("_calls_until_control", "_run", "_renewed", "_any_renewed", "_alone", "_since_run", "_held_pos", "_held_vel"),
    )

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
            joint_names: Names of the joints of the group, in order.
            joint_ids: Their indices in the articulation (kept for the caller).
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
        # without a torque-speed line: a stall torque (finite) beyond all others and no fall with speed
        stall = parameters.read("saturation_effort", torch.inf)
        self.velocity_limit[stall.isinf()] = torch.inf
        self.saturation_effort = stall.clamp(max=torch.finfo(dtype).max)
        self.encoder_bias = parameters.read("encoder_bias", 0.0)
        self.torque_enable: torch.Tensor | None = None
        self.holds_line = False
        self.is_trapezoidal = False
        self._speed_slope: torch.Tensor | None = None
        self._loop_slope: torch.Tensor | None = None
        self._run: ControllerRun | None = None
        self._jump: Jump | None = None

        self.computed_effort = torch.zeros_like(self.stiffness)
        self.applied_effort = self._held_effort = self.motor_effort = torch.zeros_like(self.stiffness)
        delayed = ("positions", "velocities", "efforts") if cfg.delay_mode == "command" else ("torque",)
        dt = self._physics_dt = cfg.physics_dt or physics_dt
        delay, max_delay = delay_in_steps(cfg, dt)
        for note in step_notes(cfg, dt):
            warnings.warn(note, stacklevel=2)
        calls = calls_per_run(cfg, dt)
        self._own_dt = cfg.drive_dt if calls is None else None
        self._calls_per_run = calls = calls or 1
        self._since_run = torch.full_like(self.stiffness, self._own_dt or 0.0)
        self._held_pos, self._held_vel = torch.zeros_like(self.stiffness), torch.zeros_like(self.stiffness)
        self._delays = DriveDelays(
            delayed,
            max_delay,
            num_envs,
            self._device,
            cfg.delay_interpolation,
            runs=cfg.control_decimation // calls,
            parts=calls,
        )
        self._calls_until_control = 0
        self._renewed = torch.zeros(num_envs, 1, dtype=torch.bool, device=self._device)  # since the last call
        self._any_renewed = False
        self._alone: torch.Tensor | None = None
        self.update_time_lags(delay)
        self._delays.set_lead(self._lead)
        self.effects = self._make_effects(dt)
        self.update_effects()

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
        if self._own_dt is not None:
            return self._own_dt
        return math.inf if self._physics_dt is None else self._calls_per_run * self._physics_dt

    @property
    def time_lags(self) -> torch.Tensor:
        """Delay [control steps] of each environment, (num_envs,), or joint, (num_envs, num_joints)."""
        return self._delays.time_lags

    def _held_between_runs(
        self, position: torch.Tensor, speed: torch.Tensor, period: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What a controller with its own clock saw when it last ran; it runs as soon as its period [s] is over."""
        runs = self._since_run >= (1 - _ROUNDING) * period
        self._since_run = torch.where(runs, self._since_run - period, self._since_run) + (self._physics_dt or 0.0)
        self._held_pos = torch.where(runs, position, self._held_pos)
        self._held_vel = torch.where(runs, speed, self._held_vel)
        return self._held_pos, self._held_vel

    def update_effects(self) -> None:
        """Take over changed parameters of the base model and of the effects."""
        if self.effects is not None:
            self.effects.take_over(self.armature, self.friction, self.viscous_friction)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Forget the history of all or some environments; parameters stay.

        The controller of a drive that is reset runs at the next call, also where the others hold their torque.
        """
        chosen = None if env_ids is None else self._mask(env_ids)
        self._delays.reset(chosen)
        if self._own_dt is not None:
            self._since_run[slice(None) if chosen is None else chosen] = self._own_dt
        if chosen is None:
            self._calls_until_control = 0
            self._any_renewed = False
        elif self._calls_until_control:
            self._renewed |= chosen[:, None]
            self._any_renewed = True
        if self.effects is not None:
            self.effects.reset(chosen)

    def update_encoder_bias(self, encoder_bias: torch.Tensor | float, env_ids: EnvIds = None) -> None:
        """Set the encoder bias [rad], (len(env_ids), num_joints) or broadcastable to it.

        Raises:
            ValueError: If it has another shape.
        """
        rows = slice(None) if env_ids is None else env_ids
        bias = torch.as_tensor(encoder_bias, dtype=self._dtype, device=self._device)
        try:
            self.encoder_bias[rows] = bias
        except RuntimeError:
            raise ValueError(
                f"encoder_bias has shape {tuple(bias.shape)}, expected {tuple(self.encoder_bias[rows].shape)} (one row "
                "per environment, one column per joint), or a number."
            ) from None

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
        if self.effects is not None:
            for effect in self.effects.effects:
                effect.is_trapezoidal = is_trapezoidal
        self._delays.set_lead(self._lead)

    @property
    def _lead(self) -> float:
        """By how much the simulator lets a delayed command act too early, in runs of the controller."""
        held = (self.cfg.centred_commands or self.cfg.second_order) and self.cfg.delay_mode == "command"
        return 0.5 / self._calls_per_run if held and not self.is_trapezoidal else 0.0

    @property
    def _ahead(self) -> float:
        """By how long the simulator shows positions too early [s]."""
        early = self.cfg.second_order and not self.is_trapezoidal and not self.cfg.implicit
        return 0.5 * self._physics_dt if early and self._physics_dt is not None else 0.0

    def set_torque_enable(self, enabled: torch.Tensor | None) -> None:
        """Say which environments' drives give torque: bool, shape (num_envs,); ``None`` for all.

        Raises:
            ValueError: If it has another shape.
        """
        if isinstance(enabled, torch.Tensor) and enabled.numel() != self._num_envs:
            raise ValueError(f"torque_enable has shape {tuple(enabled.shape)}, expected ({self._num_envs},).")
        self.torque_enable = None if enabled is None else enabled.to(self._dtype).reshape(self._num_envs, 1)
        if self.effects is not None:
            given = self.effects.state.enabled
            given.copy_(torch.ones_like(given) if self.torque_enable is None else self.torque_enable.expand_as(given))

    def parts(self) -> dict[str, Part]:
        """All that keeps something from call to call, by name: itself, its delays, its effects and their state."""
        parts: dict[str, Part] = {"drive": self, "delays": self._delays}
        parts |= {f"delays.{name}": buffer for name, buffer in self._delays.buffers.items()}
        if self.effects is not None:
            parts |= {"effects": self.effects, "effects.state": self.effects.state}
            for i, effect in enumerate(self.effects.effects):
                parts[own := f"effects.{i}.{effect.name}"] = effect
                parts |= {f"{own}.{name}": buffer for name, buffer in effect.buffers.items()}
        return parts

    def branches(self) -> dict[str, dict[str, Hashable]]:
        """All that Python branches over in a call, by part: with the same, calls do the same operations."""
        return {name: part.flags() for name, part in self.parts().items()}

    @torch.inference_mode(False)  # may be restored outside of the caller's inference mode too
    def snapshot(self) -> dict[str, Any]:
        """All that it keeps from call to call, by name: copies, nearly all of them tensors."""
        return {
            f"{name}.{key}": _copied(getattr(part, key)) for name, part in self.parts().items() for key in part.kept()
        }

    @torch.inference_mode(False)
    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a :meth:`snapshot` of it, or of a drive like it; its numbers stay."""
        parts = self.parts()
        for name, value in snapshot.items():
            part, _, key = name.rpartition(".")
            setattr(parts[part], key, _copied(value))

    # ---- what the simulator is to apply, what encoders show, and what effects read -------------------------------

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
    def joint_friction_time(self) -> torch.Tensor | None:
        """Time constant with which that friction gives way [s], 0 where it is hard; ``None`` where no effect says."""
        stack = self.effects
        return stack.state.friction_time if stack is not None and stack.has("constraint") else None

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

    def held(
        self,
        joint_pos: torch.Tensor,
        joint_vel: torch.Tensor,
        position: torch.Tensor,
        speed: torch.Tensor,
        free: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Where joints are whose encoders are held; what moves with them is put there. Before :meth:`compute`.

        Args:
            joint_pos: q [rad], (num_envs, num_joints).
            joint_vel: v [rad/s], (num_envs, num_joints).
            position: What encoders show before their bias [rad], (num_envs, num_joints).
            speed: The speed that they show [rad/s], (num_envs, num_joints).
            free: Joints that are not held, (num_envs, num_joints) bool: any value may stand there.

        Returns:
            Position and speed of the joints; where they are free, any.
        """
        if self.effects is None or not self.effects.has("hold"):
            return position, speed
        return self.effects.held(joint_pos, joint_vel, position, speed, free)

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

    def remember(self, heat: Heat) -> None:
        """Give effects the drive's work in the session before, once the parameters are known."""
        for effect in () if self.effects is None else self.effects.effects:
            effect.remember(heat)

    def notice(self, conditions: Conditions) -> None:
        """Give effects the logged conditions of the drive."""
        for effect in () if self.effects is None else self.effects.effects:
            effect.notice(conditions)

    # ---- inside --------------------------------------------------------------------------------------------------

    def _mask(self, env_ids: Sequence[int] | torch.Tensor | slice) -> torch.Tensor:
        """Environments, by index or already a mask, as (num_envs,) bool."""
        if isinstance(env_ids, torch.Tensor) and env_ids.dtype == torch.bool:
            return env_ids
        chosen = torch.zeros(self._num_envs, dtype=torch.bool, device=self._device)
        chosen[env_ids] = True
        return chosen

    def _check_shapes(self, **given: torch.Tensor | None) -> None:
        """Refuse what has not a row per environment and a column per joint: torch would spread it without a word."""
        expected = (self._num_envs, len(self._joint_names))
        for name, value in given.items():
            is_tensor = isinstance(value, torch.Tensor)
            if value is not None and (not is_tensor or value.shape != expected):
                found = f"shape {tuple(value.shape)}" if is_tensor else f"type {type(value).__name__}"
                raise ValueError(
                    f"{name} has {found}, expected a tensor of shape {expected}: a row per environment, a column for "
                    f"each of the joints {', '.join(self._joint_names)}."
                )

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


def _copied(value: Any) -> Any:
    return value.clone() if isinstance(value, torch.Tensor) else copy.copy(value)


def _applies(cfg: EffectCfg, joint_names: Sequence[str]) -> bool:
    """Whether an effect has joints in this group of joints; in another group it may have some."""
    return any(
        re.fullmatch(pattern, name)
        for pattern in ([cfg.joint_names_expr] if isinstance(cfg.joint_names_expr, str) else cfg.joint_names_expr)
        for name in joint_names
    )
