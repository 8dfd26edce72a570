"""How one joint takes part in a motion: amplitude, centre, band, seed; drawn at random within the room it has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from pace_envs.tasks.pace import ExcitationCfg, PaceCfg
from pace_optim.motion.design.motion_check import MotionLimits
from pace_optim.motion.signals import Trajectory, make_excitation

_SMALLEST_AMPLITUDE = 0.2  # of the room
_NARROWEST_BAND = 3.0  # upper over lower end
_WHOLE = 0.4  # how often a draw takes the whole band, or all the room
_SPEED_MARGIN = 0.98
_WINDOW = 0.8  # over which the largest speed is looked for [s]
_LIMIT_MARGIN = 0.05  # of the joint's range


@dataclass(frozen=True, kw_only=True)
class JointMotion:
    """One joint's part: target = centre + amplitude * signal."""

    amplitude: float
    """Of a signal of 1 [rad]; its sign is the direction."""
    centre: float
    """Middle of the motion [rad]."""
    min_frequency: float
    """Lower end of the band [Hz]."""
    max_frequency: float
    """Upper end of the band [Hz]."""
    seed: int
    """Of the signal's phases, levels and times."""


@dataclass(frozen=True, kw_only=True)
class Room:
    """Where one joint's targets may lie, and how fast they may be."""

    lower: float
    """Smallest target [rad]."""
    upper: float
    """Largest target [rad]."""
    direction: float
    """+1 or -1, the direction of the unoptimised motion."""
    speed: float
    """No-load speed of the drive, which a target does not pass [rad/s]."""
    min_frequency: float
    """Lower end of the widest band [Hz]."""
    max_frequency: float
    """Upper end of the widest band [Hz]."""

    def draw(self, rng: np.random.Generator) -> JointMotion:
        """A motion anywhere in the room; large amplitudes and the whole band are drawn often."""
        half = (self.upper - self.lower) / 2
        amplitude = half * (1.0 if rng.random() < _WHOLE else rng.uniform(_SMALLEST_AMPLITUDE, 1.0))
        low, high = self.min_frequency, self.max_frequency
        if rng.random() > _WHOLE and high > _NARROWEST_BAND * low:
            high = float(np.exp(rng.uniform(np.log(_NARROWEST_BAND * low), np.log(high))))
            low = float(np.exp(rng.uniform(np.log(low), np.log(high / _NARROWEST_BAND))))
        return JointMotion(
            amplitude=self.direction * amplitude,
            centre=float(self.lower + amplitude + 2 * (half - amplitude) * rng.random()),
            min_frequency=low,
            max_frequency=high,
            seed=int(rng.integers(2**31)),
        )

    def vary(self, motion: JointMotion, rng: np.random.Generator, width: float) -> JointMotion:
        """A motion near another one.

        Args:
            width: Standard deviation of the change, as a share of the room and of the band's ends.
        """
        half = (self.upper - self.lower) / 2
        amplitude = np.clip(abs(motion.amplitude) * np.exp(width * rng.normal()), _SMALLEST_AMPLITUDE * half, half)
        centre = motion.centre + width * half * rng.normal()
        low, high = (end * np.exp(2 * width * rng.normal()) for end in (motion.min_frequency, motion.max_frequency))
        low = np.clip(low, self.min_frequency, self.max_frequency)
        high = np.clip(high, self.min_frequency, self.max_frequency)
        if high < _NARROWEST_BAND * low:  # moved into each other: keep the band
            low, high = motion.min_frequency, motion.max_frequency
        return JointMotion(
            amplitude=float(np.copysign(amplitude, motion.amplitude)),
            centre=float(np.clip(centre, self.lower + amplitude, self.upper - amplitude)),
            min_frequency=float(low),
            max_frequency=float(high),
            seed=motion.seed if rng.random() < 0.5 else int(rng.integers(2**31)),
        )


def rooms(
    cfg: PaceCfg, limits: MotionLimits, min_frequency: float, max_frequency: float, reach: float
) -> tuple[Room, ...]:
    """Each joint's room: the range that ``cfg.excitation`` gives, widened by ``reach``, inside the joint limits.

    Args:
        cfg: The robot's configuration; its ``excitation`` must not be None.
        min_frequency: Lower end of the band [Hz].
        max_frequency: Upper end of the band [Hz].
    """
    excitation = cfg.excitation
    assert excitation is not None  # an unoptimised motion was made from it
    result = []
    for j, (bias, direction, scale) in enumerate(
        zip(excitation.bias, excitation.direction, excitation.scale, strict=True)
    ):
        centre, half = bias * direction * scale, reach * abs(scale)
        low, high = limits.position[j].tolist()
        margin = _LIMIT_MARGIN * (high - low) if np.isfinite(high - low) else 0.0
        result.append(
            Room(
                lower=max(centre - half, low + margin),
                upper=min(centre + half, high - margin),
                direction=float(np.sign(direction * scale) or 1.0),
                speed=float(limits.velocity[j]),
                min_frequency=min_frequency,
                max_frequency=max_frequency,
            )
        )
    return tuple(result)


def command(
    name: str,
    excitation: str,
    cfg: PaceCfg,
    joints: Sequence[JointMotion],
    all_rooms: Sequence[Room],
    *,
    control_dt: float,
    duration: float | None,
) -> tuple[Trajectory, tuple[JointMotion, ...]]:
    """The targets of all joints, each its own motion; faster than its drive, a joint's amplitude is made smaller.

    Args:
        duration: Of the trajectory [s]; ``None`` means the excitation's usual one.

    Returns:
        The trajectory and the motions as they are in it.
    """
    columns, made = [], []
    for j, (motion, room) in enumerate(zip(joints, all_rooms, strict=True)):
        try:
            part = _alone(excitation, cfg, j, motion, control_dt, duration)
        except ValueError:  # the excitation finds no signal in so narrow a band
            motion = replace(motion, min_frequency=room.min_frequency, max_frequency=room.max_frequency)
            part = _alone(excitation, cfg, j, motion, control_dt, duration)
        target = part.des_dof_pos[:, 0]
        if not part.has_jumps:
            target = motion.centre + slowed(target - motion.centre, room.speed, control_dt)
        columns.append(target)
        made.append(motion)
    trajectory = Trajectory(
        name=name,
        time=part.time,
        des_dof_pos=np.stack(columns, axis=1),
        joint_names=tuple(cfg.joint_order),
        has_jumps=part.has_jumps,
    )
    return trajectory, tuple(made)


def slowed(swing: np.ndarray, speed: float, control_dt: float) -> np.ndarray:
    """A swing about zero, kept below a speed: made smaller where it is fast, as a chirp's end but not its beginning.

    Args:
        swing: (T,) [rad].
        speed: Largest speed, may be infinite [rad/s].
        control_dt: Time between two values [s].
    """
    rate = np.abs(np.diff(swing, append=swing[-1])) / control_dt
    if rate.max() <= speed:
        return swing
    speed = _SPEED_MARGIN * speed
    window = 2 * round(_WINDOW / control_dt / 2) + 1
    largest = ndimage.maximum_filter1d(rate, window, mode="nearest")
    envelope = np.minimum(1.0, speed / np.maximum(largest, 1e-12))
    swing = swing * ndimage.uniform_filter1d(envelope, window, mode="nearest")
    rest = float(np.abs(np.diff(swing)).max()) / control_dt  # the envelope's own slope adds a little
    return swing * min(1.0, speed / max(rest, 1e-12))


def within_speed(unoptimized: Trajectory, all_rooms: Sequence[Room], control_dt: float) -> Trajectory:
    """A motion whose targets are nowhere faster than the drives; one that jumps on purpose is left as it is.

    Args:
        unoptimized: The motion; it starts at the centre of every joint.
    """
    if unoptimized.has_jumps:
        return unoptimized
    centre = unoptimized.des_dof_pos[0]
    columns = [
        centre[j] + slowed(unoptimized.des_dof_pos[:, j] - centre[j], room.speed, control_dt)
        for j, room in enumerate(all_rooms)
    ]
    return replace(unoptimized, des_dof_pos=np.stack(columns, axis=1))


def _alone(
    excitation: str, cfg: PaceCfg, j: int, motion: JointMotion, control_dt: float, duration: float | None
) -> Trajectory:
    """The excitation of a robot that has only this joint."""
    one = cfg.on_joints(cfg.joint_order[j : j + 1]).replace(
        excitation=ExcitationCfg(
            bias=(motion.centre / motion.amplitude if motion.amplitude else 0.0,),  # without amplitude it rests at 0
            direction=(1.0,),
            scale=(motion.amplitude,),
        ),
    )
    return make_excitation(
        excitation,
        one,
        control_dt=control_dt,
        duration=duration,
        min_frequency=motion.min_frequency,
        max_frequency=motion.max_frequency,
        seed=motion.seed,
    )[0]
