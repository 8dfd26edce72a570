"""The identified drive: PD control, encoder bias, delay and a DC motor's torque-speed limit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch

from pace_actuators.dc_motor import clip_effort, pd_effort
from pace_actuators.delay_buffer import DelayBuffer
from pace_actuators.joint_values import JointValue, resolve_joint_values
from pace_actuators.pace_dc_motor_cfg import PaceDCMotorCfg

EnvIds = Sequence[int] | torch.Tensor | slice | None

_NOT_NEGATIVE = (lambda x: (x >= 0) & x.isfinite(), "a finite number >= 0")
_DOMAINS: dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], str]] = {
    "stiffness": _NOT_NEGATIVE,
    "damping": _NOT_NEGATIVE,
    "armature": _NOT_NEGATIVE,
    "friction": _NOT_NEGATIVE,
    "viscous_friction": _NOT_NEGATIVE,
    "saturation_effort": (
        lambda x: (x >= 0) & x.isfinite(),
        "a finite number >= 0, or None for no torque-speed curve",
    ),
    "effort_limit": (lambda x: x >= 0, "a number >= 0, or inf"),
    "velocity_limit": (lambda x: x > 0, "a number > 0, or inf"),
    "encoder_bias": (torch.isfinite, "a finite number"),
}
"""Which values a field of the configuration may have, and how to say so."""


class PaceDCMotor:
    """A PD-controlled DC motor with encoder bias and delay, batched over environments.

    The way of a command through the drive, once per control step up to the hold, once per call after it:

        q_enc = q - bias
        τ     = kp (q* - q_enc) + kd (q̇* - q̇) + τ_ff        q*, q̇*, τ_ff delayed  (delay_mode "command")
        τ     = τ(t - delay)                                  the torque delayed     (delay_mode "effort")
        ------- held for ``control_decimation`` calls -------
        τ     = clip(τ, τ_min(v), τ_max(v))                   four-quadrant torque-speed limit
        τ     = 0 where the drive is disabled

    Source: Bjelonic et al., PACE (arXiv 2509.06342); torque-speed limit as Isaac Lab's ``DCMotor``.
    The constructor, the attributes and :meth:`compute` are those of an Isaac Lab actuator. Override
    :meth:`compute_effort_command` or :meth:`drive_effort` to model a motor of your own.

    Attributes:
        computed_effort: The controller's torque before the drive's limits [N m], (num_envs, num_joints).
        applied_effort: The torque at the joint [N m], (num_envs, num_joints).
        stiffness, damping, effort_limit, saturation_effort, velocity_limit: See the configuration;
            each (num_envs, num_joints) and writable per environment.
        armature, friction, dynamic_friction, viscous_friction: For the simulator, (num_envs, num_joints).
        encoder_bias: [rad], (num_envs, num_joints).
        torque_enable: Whether the drive gives torque, (num_envs, 1), or ``None`` when all do.
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
        self._check_choices()

        self.stiffness = self._parameter("stiffness", stiffness)
        self.damping = self._parameter("damping", damping)
        self.armature = self._parameter("armature", armature)
        self.friction = self._parameter("friction", friction)
        self.dynamic_friction = (
            self.friction.clone()
            if dynamic_friction is None or cfg.friction is not None
            else self._tensor(dynamic_friction, "dynamic_friction")
        )
        self.viscous_friction = self._parameter("viscous_friction", viscous_friction)
        self.effort_limit = self._parameter("effort_limit", effort_limit)
        self.effort_limit_sim = self.effort_limit.clone()
        self.velocity_limit = self._parameter("velocity_limit", velocity_limit)
        self.velocity_limit_sim = self.velocity_limit.clone()
        if cfg.saturation_effort is None:
            # no torque-speed curve was asked for: a (finite) stall torque at the limit and no fall with speed
            self.saturation_effort = self.effort_limit.clamp(max=torch.finfo(dtype).max)
            self.velocity_limit = torch.full_like(self.velocity_limit, torch.inf)
        else:
            self.saturation_effort = self._parameter("saturation_effort", torch.inf)
        self.encoder_bias = self._parameter("encoder_bias", 0.0)
        self.torque_enable: torch.Tensor | None = None

        self.computed_effort = torch.zeros_like(self.stiffness)
        self.applied_effort = torch.zeros_like(self.stiffness)
        delayed = ("positions", "velocities", "efforts") if cfg.delay_mode == "command" else ("torque",)
        self._delay_buffers = {
            name: DelayBuffer(cfg.max_delay, num_envs, self._device, cfg.delay_interpolation) for name in delayed
        }
        self._silent: set[str] = set()  # commands that were not given at the last control step
        self._calls_until_control = 0
        self.update_time_lags(cfg.delay)

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
    def time_lags(self) -> torch.Tensor:
        """Delay [control steps] of each environment, (num_envs,), or joint, (num_envs, num_joints)."""
        return next(iter(self._delay_buffers.values())).time_lags

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
        if self._calls_until_control == 0:
            self.computed_effort = self.compute_effort_command(control_action, joint_pos, joint_vel)
            self._calls_until_control = self.cfg.control_decimation
        self._calls_until_control -= 1
        self.applied_effort = self.drive_effort(self.computed_effort, joint_pos, joint_vel)
        return dataclasses.replace(
            control_action, joint_positions=None, joint_velocities=None, joint_efforts=self.applied_effort
        )

    def compute_effort_command(
        self, control_action: Any, joint_pos: torch.Tensor, joint_vel: torch.Tensor
    ) -> torch.Tensor:
        """The controller's part, once per control step: encoder, delays and PD law.

        Args:
            control_action: As in :meth:`compute`.
            joint_pos: q [rad], (num_envs, num_joints).
            joint_vel: v [rad/s], (num_envs, num_joints).

        Returns:
            The torque that is asked of the drive [N m], (num_envs, num_joints).
        """
        position = self._delayed("positions", control_action.joint_positions)
        velocity = self._delayed("velocities", control_action.joint_velocities)
        feed_forward = self._delayed("efforts", control_action.joint_efforts)
        encoder_pos = joint_pos - self.encoder_bias
        if position is None:  # no position target: velocity and effort control
            position = encoder_pos
        velocity_error = -joint_vel if velocity is None else velocity - joint_vel
        effort = pd_effort(position - encoder_pos, velocity_error, self.stiffness, self.damping)
        if feed_forward is not None:
            effort += feed_forward
        if self.cfg.delay_mode == "effort":
            return self._delay_buffers["torque"].compute(effort)
        return effort

    def drive_effort(
        self, effort_command: torch.Tensor, joint_pos: torch.Tensor, joint_vel: torch.Tensor
    ) -> torch.Tensor:
        """The drive's part, at every call: what the motor makes of the torque asked of it.

        Args:
            effort_command: The torque asked for [N m], (num_envs, num_joints).
            joint_pos: q [rad], (num_envs, num_joints).
            joint_vel: v [rad/s], (num_envs, num_joints).

        Returns:
            The torque at the joint [N m], (num_envs, num_joints).
        """
        effort = clip_effort(effort_command, joint_vel, self.saturation_effort, self.effort_limit, self.velocity_limit)
        return effort if self.torque_enable is None else effort * self.torque_enable

    def reset(self, env_ids: EnvIds = None) -> None:
        """Forget the history of all or some environments; parameters stay."""
        for buffer in self._delay_buffers.values():
            buffer.reset(env_ids)
        if env_ids is None:
            self._silent.clear()
            self._calls_until_control = 0

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
        for buffer in self._delay_buffers.values():
            buffer.set_time_lag(delay, env_ids)

    def set_torque_enable(self, enabled: torch.Tensor | None) -> None:
        """Say which environments' drives give torque: bool, shape (num_envs,); ``None`` for all."""
        self.torque_enable = None if enabled is None else enabled.to(self._dtype).reshape(self._num_envs, 1)

    def _delayed(self, name: str, data: torch.Tensor | None) -> torch.Tensor | None:
        buffer = self._delay_buffers.get(name)
        if buffer is None:
            return data
        if data is None:
            self._silent.add(name)
            return None
        if name in self._silent:  # until now there was no target, or it was zero
            self._silent.remove(name)
            buffer.reset()
            if name != "positions":
                buffer.compute(torch.zeros_like(data))
        return buffer.compute(data)

    def _parameter(self, field: str, default: torch.Tensor | float) -> torch.Tensor:
        value: JointValue | None = getattr(self.cfg, field)
        if value is None:
            result = self._tensor(default, field)
        else:
            result = self._tensor(resolve_joint_values(value, self._joint_names, field=field), field)
        valid, expected = _DOMAINS[field]
        bad = ~valid(result)
        if bool(bad.any()):
            joint = self._joint_names[int(bad.any(dim=0).nonzero()[0])]
            raise ValueError(f"{field} of {joint} is {result[bad][0].item():g}, expected {expected}.")
        return result

    def _tensor(self, value: torch.Tensor | float, field: str) -> torch.Tensor:
        tensor = torch.as_tensor(value, dtype=self._dtype, device=self._device)
        try:
            return tensor.expand(self._num_envs, self.num_joints).clone()
        except RuntimeError:
            raise ValueError(
                f"{field} has shape {tuple(tensor.shape)}, expected a number, ({self.num_joints},) or "
                f"({self._num_envs}, {self.num_joints})."
            ) from None

    def _check_choices(self) -> None:
        if self.cfg.delay_mode not in ("command", "effort"):
            raise ValueError(f"Unknown delay_mode {self.cfg.delay_mode!r}. Available: 'command', 'effort'.")
        if not (isinstance(self.cfg.control_decimation, int) and self.cfg.control_decimation >= 1):
            raise ValueError(f"control_decimation is {self.cfg.control_decimation!r}, expected an integer >= 1.")
