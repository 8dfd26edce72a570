"""Effects between the command and the controller."""

from __future__ import annotations

import math
from typing import ClassVar

import torch

from pace_actuators.delay_buffer import DelayBuffer
from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect, EffectParameter, off
from pace_actuators.effects.registry import register_effect


@register_effect
class CommandRateLimit(Effect):
    """The drive's firmware lets its target move only so fast.

    x(k) = x(k-1) + clip(q* - x(k-1), ± v_max Δt), Δt the control step.
    """

    name = "command_rate_limit"
    stage = "command"
    memory = ("_target",)
    _target: torch.Tensor
    parameters = (
        EffectParameter(
            name="velocity",
            unit="rad/s",
            lower=0.2,
            upper=50.0,
            null=float("inf"),
            start=5.0,
            scale="log",
            meaning="fastest motion of the target inside the drive",
        ),
    )
    equation = "|dq*/dt| <= v_max inside the drive"
    part = "the profile velocity of the firmware"
    looks = "measured speed never exceeds a plateau"
    source = "profile velocity of servo firmware, e.g. Dynamixel control tables"
    probes = ({"velocity": 8.0}, {"velocity": 4.0}, {"velocity": 2.0}, {"velocity": 1.0}, {"velocity": 0.5})
    two_sided = False
    separates = "a larger and faster motion"

    def prepare(self) -> None:
        """Largest move per control step."""
        self._step = self.velocity * self.control_dt

    def command(self, s: DriveState) -> None:
        """Follow the target at the limit; the first counts as reached."""
        self.begin(_target=s.joint_pos_target)
        error = s.joint_pos_target - self._target
        limited = self._target + error.clamp(-self._step, self._step)
        self._target = torch.where(error.abs() <= self._step, s.joint_pos_target, limited)
        s.joint_pos_target = self._target


@register_effect
class CommandAccelerationLimit(Effect):
    """The drive's firmware moves its target on a profile: as fast as it may, and so that it can stop at the command.

    With a the acceleration, h a step of the profile, e = q* - x what is left to go:

        v <- v + clip(sgn(e) min(|e|/h, a h (√(1/4 + 2 |e|/(a h²)) - 1/2)) - v, ± a h),  x <- x + h v
    """

    name = "command_acceleration_limit"
    stage = "command"
    memory = ("_target", "_speed")
    _target: torch.Tensor
    _speed: torch.Tensor
    parameters = (
        EffectParameter(
            name="acceleration",
            unit="rad/s^2",
            lower=2.0,
            upper=2000.0,
            null=float("inf"),
            start=100.0,
            scale="log",
            meaning="of the target inside the drive",
        ),
    )
    equation = "|d²q*/dt²| <= a inside the drive, which stops at its command"
    part = "the profile acceleration of the firmware"
    looks = "from some frequency on, the acceleration no longer rises: late and too wide in the fast parts"
    source = "profile acceleration of servo firmware, e.g. Dynamixel and Feetech control tables"
    probes = tuple({"acceleration": a} for a in (300.0, 150.0, 80.0, 40.0, 20.0, 10.0))
    two_sided = False
    separates = "a larger and faster motion"
    profile_dt: ClassVar[float] = 0.00125
    """Longest step of the profile [s]."""

    def prepare(self) -> None:
        """Steps of the profile in a control step, and what one adds to the speed."""
        self._steps = max(1, math.ceil(self.control_dt / self.profile_dt - 1e-9))
        self._h = self.control_dt / self._steps
        self._off = off(self.acceleration)
        self._gain = torch.where(self._off, 1.0, self.acceleration) * self._h

    def command(self, s: DriveState) -> None:
        """Follow the target on the profile; the first counts as reached."""
        self.begin(_target=s.joint_pos_target, _speed=0.0)
        h, gain = self._h, self._gain
        for _ in range(self._steps):
            error = s.joint_pos_target - self._target
            left = error.abs()
            stops = gain * (torch.sqrt(0.25 + 2 * left / (gain * h)) - 0.5)
            change = torch.copysign(torch.minimum(stops, left / h), error) - self._speed
            self._speed = self._speed + torch.clamp(change, -gain, gain)
            self._target = self._target + h * self._speed
        s.joint_pos_target = torch.where(self._off, s.joint_pos_target, self._target)


@register_effect
class CommandFilter(Effect):
    """The drive's firmware smooths its target by a first-order low-pass: T dx/dt + x = q*, exact for a held command."""

    name = "command_filter"
    stage = "command"
    memory = ("_target",)
    _target: torch.Tensor
    parameters = (EffectParameter(name="time_constant", unit="s", lower=0.0, upper=0.2, null=0.0, start=0.01),)
    equation = "T dx/dt + x = q*, the controller follows x"
    part = "the firmware's filter or interpolation of commands"
    looks = "late and too small in the fast parts; rounded steps"
    source = "interpolation and input filters of servo and joint drives"
    probes = ({"time_constant": 0.003}, {"time_constant": 0.01}, {"time_constant": 0.04})
    two_sided = False
    separates = "steps, whose rounding a pure delay does not have"

    def prepare(self) -> None:
        """Weight of a command in the target, one control step after it."""
        self._weight = -torch.expm1(-self.control_dt / self.time_constant)

    def command(self, s: DriveState) -> None:
        """Follow the command; the first counts as reached."""
        self.begin(_target=s.joint_pos_target)
        self._target = torch.lerp(self._target, s.joint_pos_target, self._weight)
        s.joint_pos_target = self._target


@register_effect
class OtherDelay(Effect):
    """The delay path that the base model does not have.

    Where the base delays commands, the controller's torque is delayed too (feedback included); where the base delays
    torque, the commands are delayed too.
    """

    name = "other_delay"
    stage = "command"
    parameters = (
        EffectParameter(
            name="delay",
            unit="s",
            lower=0.0,
            upper=0.03,
            null=0.0,
            start=0.002,
            meaning="delay of the other path",
            possible=(0.0, 0.03),  # as long as its buffer
        ),
    )
    equation = "τ(t - s) where the base delays q*, q*(t - s) where the base delays τ"
    part = "whether bus or current loop is late"
    looks = "phase at the band's upper end, and less damping of the loop"
    source = "PACE (arXiv 2509.06342), delay modes of its releases"
    probes = ({"delay": 0.001}, {"delay": 0.003})
    two_sided = False
    twins = ("measurement_delay",)
    separates = "recordings at another proportional gain"

    def prepare(self) -> None:
        """Lags in the steps of the path: torques pass at every physics step, targets at every run of the controller."""
        dt = self.dt if self.delay_mode == "command" else self.control_dt
        upper = self.parameters[0].upper / dt
        if not self.buffers:
            self.buffers["path"] = DelayBuffer(upper, self.shape[0], self._options["device"])
        self.buffers["path"].set_time_lag((self.delay / dt).clamp(0.0, upper).double())

    def command(self, s: DriveState) -> None:
        """Delay the target where the base delays the torque."""
        if self.delay_mode == "effort":
            s.joint_pos_target = self.buffers["path"].compute(s.joint_pos_target)

    def effort_command(self, s: DriveState) -> None:
        """Delay the torque where the base delays the command."""
        if self.delay_mode == "command":
            s.effort = self.buffers["path"].compute(s.effort)
            s.speed_slope *= (1 - self.delay / self.dt).clamp(min=0.0)


@register_effect
class ProportionalGain(Effect):
    """The controller's proportional gain is not what the recording says: g kp."""

    name = "proportional_gain"
    stage = "controller"
    parameters = (EffectParameter(name="gain", unit="1", lower=0.1, upper=10.0, null=1.0, start=1.02, scale="log"),)
    equation = "g kp"
    part = "the stated kp and its unit"
    looks = "static sag and stiffness off; parameters change from gain set to gain set"
    source = "EFFECTS of PACE on MuJoCo; users of PACE report drives whose gains are not in SI units"
    probes = ({"gain": 1.02}, {"gain": 0.4}, {"gain": 2.5})
    scales = "proportional gain"
    separates = "recordings at another gain, and a known added mass"

    def controller(self, s: DriveState) -> None:
        """Scale kp."""
        s.stiffness *= self.gain


@register_effect
class DerivativeGain(Effect):
    """The controller's derivative gain is not what the recording says: g kd."""

    name = "derivative_gain"
    stage = "controller"
    parameters = (EffectParameter(name="gain", unit="1", lower=0.1, upper=10.0, null=1.0, start=1.05, scale="log"),)
    equation = "g kd"
    part = "the stated kd and its unit"
    looks = "damping changes from gain set to gain set"
    source = "as proportional_gain"
    probes = ({"gain": 1.05}, {"gain": 0.3}, {"gain": 3.0})
    scales = "derivative gain"
    separates = "recordings at another derivative gain"

    def controller(self, s: DriveState) -> None:
        """Scale kd."""
        s.damping *= self.gain


@register_effect
class GravityCompensation(Effect):
    """The drive feeds a part of the load's torque forward, which the recording does not say: τ - c τ_g.

    τ_g is the torque of weight, Coriolis and centrifugal forces of the model's links on the joint: MuJoCo's
    ``-qfrc_bias``, the torque at zero acceleration. It has no inertia times acceleration and no springs. The torque
    that holds the joint has the other sign.
    """

    name = "gravity_compensation"
    stage = "controller"
    parameters = (
        EffectParameter(name="share", unit="1", lower=-0.5, upper=2.0, null=0.0, start=0.1, plausible=(0.0, 1.5)),
    )
    equation = "τ - c τ_g, τ_g the torque of weight, Coriolis and centrifugal forces on the joint (no accelerations)"
    part = "the controller's gravity feed-forward"
    looks = "the joint leans less than its load and gains say; at c = 1 it does not lean at all"
    source = "controllers of robot arms (e.g. Sawyer, Panda), which know their own dynamics"
    probes = ({"share": 0.1},)
    reads_load = True
    separates = "a motion fast enough to separate weight from inertia, and a recording without the feed-forward"

    def effort_command(self, s: DriveState) -> None:
        """Add what holds that part of the load."""
        s.effort -= self.share * s.load_effort


@register_effect
class FastLoop(Effect):
    """The drive's own loop runs faster than commands come: between two of them its torque follows the motion.

    With q₀ and v₀ what the controller saw at the last command: τ - s (kp (q - q₀) + kd (v - v₀)). A loop of period h
    under commands of period Δt is s = 1 - h/Δt.
    """

    name = "fast_loop"
    stage = "controller"
    memory = ("_seen", "_speed")
    _seen: torch.Tensor
    _speed: torch.Tensor
    parameters = (
        EffectParameter(
            name="share", unit="1", lower=0.0, upper=1.0, null=0.0, start=0.5, possible=(0.0, 1.0),
            meaning="1 for a loop that runs continuously, 0 for one that runs with its commands",
        ),
    )  # fmt: skip
    equation = "τ - s (kp (q - q₀) + kd (v - v₀)), q₀ and v₀ as at the last command"
    part = "the stated rate of the drive's loop"
    looks = "viscous friction and delay change from gain set to gain set"
    source = "position loops of servo drives, which run at 1 to 20 kHz whatever the bus does; drive_dt states it"
    probes = ({"share": 0.5}, {"share": 1.0})
    two_sided = False
    separates = "recordings at another proportional gain"

    def controller(self, s: DriveState) -> None:
        """Remember what it sees."""
        self._seen, self._speed = s.joint_pos.clone(), s.joint_vel.clone()

    def feedback(self, s: DriveState) -> None:
        """Follow the motion: up to here, and within the step."""
        moved, faster, slope = s.joint_pos - self._seen, s.joint_vel - self._speed, s.damping
        if self.is_trapezoidal:  # the law of the middle of the step
            half = 0.5 * self.dt
            moved, slope = moved + half * s.joint_vel, slope + half * s.stiffness
        s.effort -= self.share * (s.stiffness * moved + s.damping * faster)
        s.speed_slope += self.share * slope


@register_effect
class IntegralGain(Effect):
    """The controller integrates its error, which the recording does not say: τ + I.

    I(k) = clip(I(k-1) + ki e(k) Δt, ± τ_I), Δt the control step, e the error of position; I is 0 when a recording or an
    episode begins.
    """

    name = "integral_gain"
    stage = "controller"
    memory = ("_integral",)
    _integral: torch.Tensor
    parameters = (
        EffectParameter(name="gain", unit="N m/(rad s)", lower=0.0, upper=1000.0, null=0.0, start=10.0, meaning="ki"),
        EffectParameter(
            name="effort",
            unit="N m",
            lower=0.1,
            upper=200.0,
            null=None,
            start=20.0,
            scale="log",
            meaning="largest torque of the integral",
        ),
    )
    equation = "τ + ki ∫ (q* - q) dt, the integral's torque within ± τ_I"
    part = "the I term of the firmware"
    looks = "the joint leans less and less while its command holds; it overshoots after a step"
    source = "PID position loops of servo drives, e.g. Dynamixel control tables; mjlab's integral_gain"
    probes = ({"effort": 100.0}, {"effort": 5.0}, {"effort": 1.0})
    two_sided = False
    separates = "a staircase that holds each of its steps longer"

    def prepare(self) -> None:
        """What an error adds in a control step."""
        self._per_step = self.gain * self.control_dt

    def controller_effort(self, s: DriveState) -> None:
        """Add the integral's torque; it begins empty."""
        self.begin(_integral=0.0)
        summed = self._integral + self._per_step * s.position_error
        self._integral = torch.clamp(summed, -self.effort, self.effort)
        s.effort += self._integral
