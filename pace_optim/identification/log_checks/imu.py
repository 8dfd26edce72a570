"""What may be wrong with the IMU of a base that moves, and with the contacts of its feet."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from pace_optim.identification.log_checks.balance import Balance, Links, View, balances
from pace_optim.recording.time_base import interpolate_linear

_GRAVITY = 9.81
"""[m/s²]."""
_UPWARDS = 0.7
"""Cosine of the angle within which the mean specific force of a robot on its feet points upwards."""
_EARLY, _LATE = -0.01, 0.03
"""Delays of an IMU against the encoders that are looked for [s]."""
_NAMED = 0.002
"""Delay that is named [s]."""
_GAIN = 0.9
"""Part of the misfit, in the joints' geometric mean, that is left at most without a delay that is named."""
_FORCE_UNITS = (
    (_GRAVITY, "g", 'multiply by 9.81, or state unit = "g"'),
    (1e-3, "thousandths of m/s²", "divide by 1000"),
    (_GRAVITY * 1e-3, "thousandths of g", "multiply by 0.00981"),
)
_TURN_UNITS = ((np.pi / 180, "degrees per second", "multiply by pi/180"), (1e-3, "mrad/s", "divide by 1000"))


def other_units(view: View) -> Iterator[tuple[View, str]]:
    """The IMU in other units than m/s² and rad/s."""
    if view.frame is None:
        return
    for of_turns, of_forces in itertools.product((None, *_TURN_UNITS), (None, *_FORCE_UNITS)):
        if of_turns is None and of_forces is None:
            continue
        frame, said = view.frame.copy(), []
        parts = (of_turns, slice(0, 3), "base_ang_vel"), (of_forces, slice(3, 6), "base_lin_acc")
        for unit, columns, series in parts:
            if unit is not None:
                frame[:, columns] *= unit[0]
                said.append(f"{series} is in {unit[1]}: {unit[2]}")
        yield replace(view, frame=frame), f"{' and '.join(said)} (looked at with {{joints}})."


def other_axes(view: View) -> Iterator[tuple[View, str]]:
    """The IMU turned, or with axes exchanged or reversed: those ways in which a robot on its feet feels its weight."""
    if view.frame is None:
        return
    upwards = -view.gravity / max(float(np.linalg.norm(view.gravity)), 1e-9)
    mean = view.frame[view.used, 3:].mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-9)
    signed = itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3))
    turns = [np.diag(signs) @ np.eye(3)[list(order)] for order, signs in signed]
    for series, of_turns, of_forces in (
        ("base_ang_vel", True, False),
        ("base_lin_acc", False, True),
        ("the IMU", True, True),
    ):
        for turn in turns:
            same = np.array_equal(turn, np.eye(3))
            if same or float((turn @ mean if of_forces else mean) @ upwards) < _UPWARDS:
                continue
            frame = view.frame.copy()
            for yes, columns in ((of_turns, slice(0, 3)), (of_forces, slice(3, 6))):
                if yes:
                    frame[:, columns] = frame[:, columns] @ turn.T
            text = (
                f"{series} has other axes than the model: {_in_words(turn)}. Correct axes or signs, or turn the "
                "site of the IMU (looked at with {joints})."
            )
            yield replace(view, frame=frame), text


def _in_words(turn: np.ndarray) -> str:
    """Which of the logged axes each axis of the model's is."""
    parts = []
    for axis, row in zip("xyz", turn, strict=True):
        logged = int(np.abs(row).argmax())
        parts.append(f"{axis} is {'-' if row[logged] < 0 else ''}{'xyz'[logged]}")
    return ", ".join(parts)


def late(view: View) -> tuple[View, float] | None:
    """The view with an IMU that is not late, and how late it is [s]; ``None`` where it is not.

    The delay is that at which torques balance best, in the joints' geometric mean.
    """
    if view.frame is None:
        return None
    coarse = replace(view, coarse=True)
    links = Links.of(coarse)
    before = _misfit(coarse, links)
    if before is None:
        return None

    def misfit(delay: float) -> float:
        earlier = _earlier(coarse, delay)
        return _misfit(earlier, Links.of(earlier, links)) or before

    found = minimize_scalar(misfit, bounds=(_EARLY, _LATE), method="bounded", options={"xatol": 5e-4, "maxiter": 12})
    if abs(found.x) < _NAMED or found.fun > _GAIN * before:
        return None
    return _earlier(view, float(found.x)), float(found.x)


def _earlier(view: View, delay: float) -> View:
    """The same with an IMU that is read earlier by a time [s]."""
    if view.frame is None:
        return view
    at = np.arange(len(view.frame)) * view.dt
    return replace(view, frame=interpolate_linear(at, view.frame, at + delay))


def _misfit(view: View, links: Links) -> float | None:
    """Geometric mean of the joints' misfits; ``None`` where no joint is judged."""
    found: dict[int, Balance] = balances(view, links, range(len(view.joints)))
    return float(np.exp(np.mean([np.log(each.misfit) for each in found.values()]))) if found else None


def stuck_contacts(view: View, is_doubted: Callable[[], list[int]]) -> Iterator[tuple[list[int], str]]:
    """Feet whose contact never changes although their legs move as others do: joints, and what is wrong.

    Args:
        is_doubted: Finds the joints that do not balance.
    """
    if view.standing is None or len(view.feet) < 2:
        return
    share = view.standing.mean(axis=0)
    if not ((share > 0) & (share < 1)).any():
        return
    travel = np.ptp(view.position, axis=0)
    for foot, (name, joints) in enumerate(view.feet):
        moves = any(travel[j] > 0.5 * float(np.median(travel)) for j in joints)
        if share[foot] == 1 and moves:
            yield (
                joints,
                (
                    f"the contact of {name} is 1 throughout although its leg moves as others do: it is stuck, and "
                    "{joints} count nowhere. Repair it, or log foot_force."
                ),
            )
        elif share[foot] == 0 and set(joints) & set(is_doubted()):
            yield (
                joints,
                (
                    f"the contact of {name} is 0 throughout, and the torques of {{joints}} do not balance: it is "
                    "stuck. Repair it, or log foot_force."
                ),
            )
