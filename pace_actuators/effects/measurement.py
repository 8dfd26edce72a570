"""Effects between the joint and what the controller and the log see of it."""

from __future__ import annotations

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect, EffectParameter
from pace_actuators.effects.registry import register_effect


@register_effect
class EncoderScale(Effect):
    """The encoder's scale is off: q_enc = (1 + e) q - bias; the speed that the controller sees is scaled alike."""

    name = "encoder_scale"
    stage = "measurement"
    parameters = (EffectParameter(name="error", unit="1", lower=-0.1, upper=0.1, null=0.0, start=0.002),)
    equation = "q_enc = (1 + e) q - bias"
    part = "counts per turn, gear ratio"
    looks = "amplitude off at all speeds"
    source = "e.g. a wrong gear ratio or a non-linear potentiometer"
    probes = ({"error": 0.002},)
    separates = "a wide range of motion, and a known added mass"

    def measurement(self, s: DriveState) -> None:
        """Scale the position."""
        s.encoder_pos += self.error * s.joint_pos

    def sensed_velocity(self, s: DriveState) -> None:
        """Scale the speed."""
        s.encoder_vel += self.error * s.joint_vel
        s.speed_slope *= 1 + self.error


@register_effect
class EncoderEccentricity(Effect):
    """The encoder's disc is off centre: its error repeats once per turn, a sin q + b cos q."""

    name = "encoder_eccentricity"
    stage = "measurement"
    joint_types = ("hinge",)
    parameters = (
        EffectParameter(name="sine", unit="rad", lower=-0.05, upper=0.05, null=0.0, start=0.0005),
        EffectParameter(name="cosine", unit="rad", lower=-0.05, upper=0.05, null=0.0, start=0.0),
    )
    equation = "q_enc = q + a sin q + b cos q - bias"
    part = "the encoder disc or magnet: off centre"
    looks = "an error that repeats once per turn"
    source = "standard for magnetic and optical ring encoders"
    probes = ({"sine": 0.001, "cosine": 0.0}, {"sine": 0.0, "cosine": 0.001})
    separates = "a wide range of motion"

    def measurement(self, s: DriveState) -> None:
        """Add the once-per-turn error."""
        s.encoder_pos += self.sine * torch.sin(s.joint_pos) + self.cosine * torch.cos(s.joint_pos)

    def sensed_velocity(self, s: DriveState) -> None:
        """Its derivative in time."""
        s.encoder_vel += (self.sine * torch.cos(s.joint_pos) - self.cosine * torch.sin(s.joint_pos)) * s.joint_vel


@register_effect
class VelocityFilter(Effect):
    """The controller sees a filtered speed: T v̇_ctrl + v_ctrl = v, exact for a speed that is constant over a step."""

    name = "velocity_filter"
    stage = "measurement"
    memory = ("_seen",)
    _seen: torch.Tensor
    parameters = (EffectParameter(name="time_constant", unit="s", lower=0.0, upper=0.03, null=0.0, start=0.003),)
    equation = "T dv_ctrl/dt + v_ctrl = v"
    part = "the firmware's filter of speeds"
    looks = "too little damping above a few Hz"
    source = "first-order low-pass in servo drives"
    probes = ({"time_constant": 0.002}, {"time_constant": 0.01})
    two_sided = False
    separates = "recordings at another derivative gain"

    def prepare(self) -> None:
        """Weight of the newest speed."""
        self._weight = -torch.expm1(-self.control_dt / self.time_constant)

    def sensed_velocity(self, s: DriveState) -> None:
        """Filter the speed; the first counts as settled."""
        self.begin(_seen=s.encoder_vel)
        self._seen = torch.lerp(self._seen, s.encoder_vel, self._weight)
        s.encoder_vel = self._seen
        s.speed_slope *= self._weight


@register_effect
class MeasurementDelay(Effect):
    """The log is late by T: a sample stamped t shows the joint as it was at t - T. The loop is not affected."""

    name = "measurement_delay"
    stage = "recording"
    parameters = (EffectParameter(name="delay", unit="s", lower=0.0, upper=0.03, null=0.0, start=0.001),)
    equation = "q_logged(t) = q_enc(t - T)"
    part = "the bus, the log's stamps"
    looks = "pure lag; the way the joint settles is not late"
    source = "logging over a bus or a network"
    probes = ({"delay": 0.001},)
    two_sided = False
    twins = ("other_delay",)
    absorbed_by = "delay"
    separates = "time stamps taken by the drive itself"

    def observation_lag(self, time: torch.Tensor) -> torch.Tensor:
        """The same at all times."""
        return self.delay


@register_effect
class ClockSkew(Effect):
    """The log's clock runs at another rate than the robot's: what it stamps t happened at (1 + s) t."""

    name = "clock_skew"
    stage = "recording"
    shared = True
    parameters = (EffectParameter(name="skew", unit="1", lower=-0.005, upper=0.005, null=0.0, start=1e-4),)
    equation = "q_logged(t) = q_enc((1 + s) t)"
    part = "the clocks of robot and logger"
    looks = "a phase error that grows with time in each recording"
    source = "two computers without a common clock"
    probes = ({"skew": 1e-4},)
    separates = "a longer recording"

    def observation_lag(self, time: torch.Tensor) -> torch.Tensor:
        """It grows with time."""
        return -self.skew * time
