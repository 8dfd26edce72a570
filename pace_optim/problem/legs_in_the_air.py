"""When the legs of a robot are in the air, where no contact of its feet is logged: by the torques of its drives.

A leg in the air is moved by its drives and its base alone. Of each of its joints, with all terms smoothed alike,

    τ_drive(t - delay) - τ_links = a q̈ + d q̇ + f sign(q̇) + b + e dτ_drive/dt

with armature a, friction d and f, an encoder's bias b, and e for delays between those that are tried. The ground adds
its force to a leg that stands, which is many times what is left of the equation in the air. The equation's coefficients
are fitted to the instants that it leaves least of, by concentration steps (Rousseeuw and Van Driessen, Technometrics
41, 1999). They begin with the instants at which the leg moves fastest. What balances then is in the air.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.ndimage import gaussian_filter1d

from pace_envs import ManagerBasedEnv
from pace_optim.problem.bounded_least_squares import bounded_least_squares
from pace_optim.problem.bounds_of_logs import asked_torque, gains
from pace_optim.problem.inverse_dynamics import LinkMotion, frame_motion, model_of
from pace_optim.recording import Recording

_SMOOTHING = 0.01
"""Standard deviation of the smoothing [s]; of slow recordings 1.5 samples."""
_EDGE = 4.0
"""Ends of a recording that do not count, in standard deviations of the smoothing."""
_SHARES = (0.05, 0.1, 0.2)
"""Parts of the instants to which the equation is fitted ..."""
_FEWEST = 60
"""... and so many at least."""
_MOST = 20_000
"""Instants that are looked at."""
_GROWTHS = 4
"""Fits to all instants that balance."""
_DELAYS = 6
"""That are tried."""
_STEPS = 20
"""Of concentration, at most."""
_HANGS = 0.5
"""Misfit of all instants, over the torque's standard deviation, below which a leg never stands."""
_FOUND = 0.12
"""Misfit of those that balance, over the deviation of their torque, that is in the air; the joints' geometric mean."""
_BALANCED = 0.1
"""Part of the torque's standard deviation that is left in the air at most."""
_SMEARED = 1.5
"""So many standard deviations of the smoothing, the ground's force shows before and after it acts."""
_AT_ONCE = 5000
"""Instants whose inverse dynamics are computed together."""


def standing_legs(
    recording: Recording, env: ManagerBasedEnv, legs: Sequence[Sequence[int]], frame: np.ndarray, point: np.ndarray
) -> np.ndarray | None:
    """Which legs the ground holds, (T, legs) bool; ``None`` where no leg is ever found in the air.

    Args:
        recording: On the robot's joints and control grid, with gains that are stated.
        env: The robot, its base fixed in the model.
        legs: Joints of each, by index.
        frame: Angular velocity [rad/s] and specific force [m/s²] of the base at the samples, (T, 6).
        point: Where that force was measured, (3,) [m].
    """
    dt = float(np.median(np.diff(recording.time)))
    width = max(_SMOOTHING / dt, 1.5)
    edge = int(np.ceil(_EDGE * width))
    inner = np.arange(edge, recording.num_samples - edge)
    if len(inner) < _FEWEST:
        return None
    balances = _balances(recording, env, frame, point, dt, width)
    left = [_left_of(balances, joints, inner) for joints in legs]
    if all(each is None for each in left):
        return None
    result = np.ones((recording.num_samples, len(legs)), dtype=bool)
    for leg, each in enumerate(left):
        if each is not None:
            result[:, leg] = ndimage.binary_erosion(
                each > _BALANCED, iterations=round(_SMEARED * width), border_value=1
            )
    return result


@dataclass(frozen=True, kw_only=True, eq=False)
class _Balance:
    """The equation with one delay of the commands, at T instants of n joints."""

    drive: np.ndarray
    """Torques of the drives, (T, n) [N m]."""
    links: np.ndarray
    """What the links take, (T, n) [N m]."""
    table: np.ndarray
    """What the coefficients are multiplied by, (T, n, 5)."""
    lower: np.ndarray
    upper: np.ndarray
    """Bounds of the coefficients, (n, 5)."""

    def left(self, joints: Sequence[int], rows: np.ndarray) -> np.ndarray:
        """What is left of some joints at all instants if the equation is fitted to those of ``rows``, (T, joints)."""
        result = []
        for j in joints:
            values, table = self.drive[:, j] - self.links[:, j], self.table[:, j]
            found, _ = bounded_least_squares(table[rows], values[rows], self.lower[j], self.upper[j])
            result.append(values - table @ found)
        return np.stack(result, axis=1)


def _balances(
    recording: Recording, env: ManagerBasedEnv, frame: np.ndarray, point: np.ndarray, dt: float, width: float
) -> list[_Balance]:
    """One for each delay that is tried."""
    sim2real = env.cfg.sim2real  # type: ignore[attr-defined]
    position, frame = (gaussian_filter1d(each, width, axis=0) for each in (recording.dof_pos, frame))
    speed = np.gradient(position, dt, axis=0)
    acceleration = np.gradient(speed, dt, axis=0)
    direction = gaussian_filter1d(np.sign(speed), width, axis=0)
    model, base, links = model_of(env, 0), frame_motion(frame, dt), np.empty_like(position)
    for first in range(0, len(position), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        motion = LinkMotion.of(model, recording.joint_names, position[part], speed[part], acceleration[part])
        links[part] = motion.torque(base[part], point)
    delays = np.unique(np.linspace(0, math.ceil(float(sim2real.bounds["delay"][0, 1])), _DELAYS).round().astype(int))
    between = 0.5 * max(np.diff(delays), default=1) * recording.control_dt
    kp, kd = gains(env, recording)
    bias = kp * sim2real.bounds["encoder_bias"].abs().max(dim=1).values.numpy()
    nothing, anything, late = np.zeros_like(kp), np.full_like(kp, np.inf), np.full_like(kp, between)
    result = []
    for delay in delays.tolist():
        drive = gaussian_filter1d(asked_torque(env, _later(recording, delay)), width, axis=0)
        terms = [acceleration, speed, direction, np.ones_like(speed), np.gradient(drive, dt, axis=0)]
        result.append(
            _Balance(
                drive=drive,
                links=links,
                table=np.stack(terms, axis=-1),
                lower=np.stack([nothing, -kd, nothing, -bias, -late], axis=-1),
                upper=np.stack([anything, anything, anything, bias, late], axis=-1),
            )
        )
    return result


def _later(recording: Recording, delay: int) -> Recording:
    """The recording with commands that come so many control steps later."""
    commands: dict[str, Any] = {
        name: series[np.maximum(np.arange(len(series)) - delay, 0)]
        for name in ("command", "command_vel", "command_effort")
        if (series := getattr(recording, name)) is not None
    }
    return replace(recording, **commands)


def _left_of(balances: Sequence[_Balance], joints: Sequence[int], inner: np.ndarray) -> np.ndarray | None:
    """The largest of what is left of a leg's joints, over the standard deviations of their torques, (T,).

    ``None`` where the leg is never in the air; zeros where it always is. Of all delays and beginnings, those count of
    which the instants that balance have most of the leg's motion.
    """
    own = list(joints)
    looked = inner[:: 1 + len(inner) // _MOST]
    moved = balances[0].table[looked][:, own, :2]
    energy = (np.square(moved) / moved.var(axis=0)).sum(axis=(1, 2))
    fastest = np.argsort(-energy)
    best: tuple[float, np.ndarray] | None = None
    for balance in balances:
        spread = np.maximum(balance.drive[looked][:, own].std(axis=0), 1e-9)
        if (_rms(balance.left(own, looked)[looked]) < _HANGS * spread).all():
            return np.zeros(len(balance.drive))
        for share in _SHARES:
            count = min(max(_FEWEST, round(share * len(looked))), len(looked))
            rows = _concentrated(balance, own, looked, looked[fastest[:count]])
            for _ in range(_GROWTHS):
                left = np.abs(balance.left(own, rows) / spread).max(axis=1)
                rows = looked[left[looked] < _BALANCED]
                if len(rows) < _FEWEST:
                    break
            else:
                misfit = _rms(balance.left(own, rows)[rows]) / np.maximum(balance.drive[rows][:, own].std(axis=0), 1e-9)
                gain = float(energy[left[looked] < _BALANCED].sum())
                if np.log(misfit).mean() < math.log(_FOUND) and (best is None or gain > best[0]):
                    best = gain, left
    return None if best is None else best[1]


def _concentrated(balance: _Balance, joints: list[int], looked: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """As many instants as ``rows`` has, of ``looked``, that the equation fits best."""
    for _ in range(_STEPS):
        left = balance.left(joints, rows)
        size = (np.square(left[looked]) / np.square(left[rows]).mean(axis=0)).sum(axis=1)
        closest = np.sort(looked[np.argpartition(size, len(rows) - 1)[: len(rows)]])
        if np.array_equal(closest, rows):
            break
        rows = closest
    return rows


def _rms(series: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(series).mean(axis=0))
