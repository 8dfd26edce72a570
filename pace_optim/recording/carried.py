"""What recordings show of joints that a moving base carries; `problem/moving_base` brings it onto a robot's model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy import ndimage

from .data import Recording
from .noise import noise_floor
from .time_base import interpolate_linear

GRAVITY = 9.81
"""[m/s²]."""
_SLOPE = 0.005
"""Speeds are slopes over so much time to either side [s]."""
_SHAKEN = 0.02
"""Noise of the accelerometer is taken over so much time to either side [s]."""
LIFTED = 0.03
"""Time after lift-off that does not count [s]: a foot that leaves the ground touches it between samples for a while."""
MARGIN = 0.01
"""Time before touch-down that does not count [s]."""
SHORTEST = 0.06
"""Of a free phase that counts [s]."""
_LOADED = 0.05
"""Part of a foot's usual force in stance from which it stands."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Carried:
    """R recordings of n joints at T control steps."""

    base: torch.Tensor
    """Angular velocity [rad/s] and specific force [m/s²] of the base, in the model's axes, (T, R, 6)."""
    point: torch.Tensor
    """Where that force acts, (R, 3) [m], in the model's world."""
    measured: torch.Tensor
    """Position [rad] and speed [rad/s] as the encoders have them, (T, R, n, 2)."""
    free: torch.Tensor
    """Where only the drive and the base act on a joint, (T, R, n) bool; elsewhere it is held as measured."""
    start_std: torch.Tensor
    """How well encoders show where a free phase begins, (R, n, 2) [rad, rad/s]; 0 where the base rests."""
    force_std: torch.Tensor
    """How well the accelerometer measures the specific force at each control step, (T, R, 3) [m/s²]."""

    @property
    def moves(self) -> torch.Tensor:
        """In which recordings the base moves, (R,) bool."""
        return (self.start_std[..., 0] > 0).any(dim=1)

    def select(self, recordings: Sequence[int]) -> Carried:
        """Some of the recordings, by index."""
        chosen = list(recordings)
        return replace(self.at(slice(None), chosen), free=self.free[:, chosen])

    def at(self, step: Any, recording: Any) -> Carried:
        """Parts of the recordings: of each (W,) those control steps (T', W). Each begins where it was measured."""
        free = self.free[step, recording].clone()
        free[0] = False
        return Carried(
            base=self.base[step, recording],
            point=self.point[recording],
            measured=self.measured[step, recording],
            free=free,
            start_std=self.start_std[recording],
            force_std=self.force_std[step, recording],
        )

    def on_joints(self, joints: Sequence[int]) -> Carried:
        """The same of some of the joints, by index."""
        chosen = list(joints)
        return replace(
            self,
            measured=self.measured[..., chosen, :],
            free=self.free[..., chosen],
            start_std=self.start_std[:, chosen],
        )

    def motion(self, parts: int, control_dt: float, loop_dt: float = 0.0) -> torch.Tensor:
        """Of the frame in the middle of each physics step, (T, parts, R, 9).

        Straight between control steps. The angular acceleration is the slope, so that its noise adds up to that of the
        gyroscope and no more. The force jumps when drives change their torques, and an accelerometer shows it as it was
        until then. So what it shows is the mean force of half of the loops' period before.

        Args:
            parts: Physics steps in a control step.
            control_dt: [s].
            loop_dt: Time for which drives hold their torques [s].
        """
        last, late = len(self.base) - 1, 0.5 * loop_dt / control_dt
        share = (torch.arange(parts, dtype=self.base.dtype) + 0.5) / parts
        following = torch.cat([self.base[1:], self.base[-1:]])
        turned = torch.lerp(self.base[:, None, :, :3], following[:, None, :, :3], share[None, :, None, None])
        turning = ((following - self.base)[..., :3] / control_dt)[:, None].expand_as(turned)
        at = (torch.arange(last + 1)[:, None] + share + late).clamp(max=last)
        low = at.floor().long().clamp(max=max(0, last - 1))
        pushed = torch.lerp(
            self.base[low][..., 3:], self.base[(low + 1).clamp(max=last)][..., 3:], (at - low)[..., None, None]
        )
        return torch.cat([turned, turning, pushed], dim=-1).contiguous()

    def held(self) -> torch.Tensor:
        """Positions and speeds at which joints are held, (T, R, n, 2); NaN where they are free."""
        return torch.where(self.free[..., None], torch.nan, self.measured).contiguous()


def read_earlier(frame: np.ndarray, delay: float, dt: float) -> np.ndarray:
    """What an IMU shows that is read too late, put where it belongs, (T, 6).

    Args:
        frame: As logged, (T, 6).
        delay: How much too late [s].
        dt: Between samples [s].
    """
    at = np.arange(len(frame))
    return interpolate_linear(at, frame, at + delay / dt)


def force_noise(force: np.ndarray, dt: float) -> np.ndarray:
    """How well samples determine a specific force, (T, 3) [m/s²].

    White noise of standard deviation σ leaves second differences of √6 σ. So does what happens between samples: feet
    that hit the ground shake the base faster than an IMU is read. Their mean square over 20 ms to either side is taken.

    Args:
        force: (T, 3) [m/s²].
        dt: Between samples [s].
    """
    square = np.zeros_like(force)
    square[1:-1] = np.square(force[2:] - 2 * force[1:-1] + force[:-2]) / 6.0
    width = 2 * round(_SHAKEN / dt) + 1
    return np.sqrt(ndimage.uniform_filter1d(square, width, axis=0, mode="nearest"))


def free_phases(standing: np.ndarray, dt: float) -> np.ndarray:
    """When a foot is in the air for long enough, with a margin, (T,) bool.

    Chatter at touch-down leaves phases too short to count.

    Args:
        standing: Whether it touches the ground, (T,) bool.
        dt: Time between samples [s].
    """
    lifted, margin, shortest = round(LIFTED / dt), round(MARGIN / dt), max(3, round(SHORTEST / dt))
    edges = np.flatnonzero(np.diff(np.concatenate([[True], standing, [True]]).astype(int)))
    result = np.zeros(len(standing), dtype=bool)
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        first = begin + (lifted if begin else 0)
        last = end - (margin if end < len(standing) else 0)
        if last - first >= shortest:
            result[first:last] = True
    return result


def part_of_phase(free: np.ndarray) -> np.ndarray:
    """How much of a free phase has passed, 0 to 1; NaN elsewhere, (T,).

    Args:
        free: (T,) bool.
    """
    result = np.full(len(free), np.nan)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(int)))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        result[first:end] = (np.arange(first, end) - first + 0.5) / (end - first)
    return result


def standing_feet(recording: Recording) -> np.ndarray | None:
    """Which feet touch the ground, (T, feet) bool; ``None`` where the recording does not say."""
    if recording.contact is not None:
        return recording.contact
    if recording.foot_force is None:
        return None
    force = recording.foot_force
    size = np.linalg.norm(force, axis=2) if force.ndim == 3 else np.abs(force)
    return size > np.maximum(_LOADED * np.quantile(size, 0.9, axis=0), 1e-9)


def measured_motion(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Positions and speeds by the encoders at control steps, (steps, n, 2), and their standard deviations, (n, 2).

    Speeds are slopes of straight lines over 5 ms to either side. Their error is the noise's, and what the slope over
    twice that time has beside it.
    """
    at = recording.sample_steps
    offset = 0.0 if recording.sample_offset is None else recording.sample_offset
    steps = np.arange(int(at[-1]) + 1)
    dt = float(np.median(np.diff(recording.time)))
    half = max(1, round(_SLOPE / dt))
    position = recording.dof_pos
    speed, wide = (_slopes(position, dt, width) for width in (half, 2 * half))
    noise = np.array([noise_floor(column, dt).sigma for column in position.T])
    of_noise = noise / (dt * np.sqrt(2 * np.square(np.arange(1, half + 1)).sum()))
    std = np.stack([np.maximum(noise, 1e-6), np.sqrt(of_noise**2 + np.square(speed - wide).mean(axis=0))], axis=-1)
    both = np.stack([position, speed], axis=-1)
    on_grid = np.empty((len(steps), *both.shape[1:]))
    for j, kind in np.ndindex(both.shape[1:]):
        on_grid[:, j, kind] = np.interp(steps, at + offset, both[:, j, kind])
    return on_grid, std


def _slopes(position: np.ndarray, dt: float, half: int) -> np.ndarray:
    """Slope of the straight line through 2 half + 1 samples around each, fewer at the ends, (T, n)."""
    total = np.zeros_like(position)
    weight = np.zeros(len(position))
    for i in range(1, half + 1):
        inner = slice(i, len(position) - i)
        total[inner] += i * (position[2 * i :] - position[: -2 * i])
        weight[inner] += 2 * i * i
    ends = weight == 0
    result = total / np.where(ends, 1.0, weight)[:, None] / dt
    result[ends] = np.gradient(position, dt, axis=0)[ends]
    return result
