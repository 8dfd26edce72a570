"""Do the SO-101's recordings have the model's signs and zeros, and how stiff is the drive?

A joint that carries weight leans: target - position = -(gravity's torque)/stiffness, plus friction, which changes its
sign with the direction of motion. The mean of up and down strokes is the lean. With the right signs all joints that
carry weight give a positive stiffness, and the same one, since all have the same servo and gains.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from real_robots import COUNTS_PER_RAD, JAW_CLOSED, JAW_COUNTS

from pace_envs.assets_dir import ASSETS_DIR
from pace_envs.robots import SO101_JOINTS
from pace_optim.recording import load_recording

WEIGHT_JOINTS = ("shoulder_lift", "elbow_flex", "wrist_flex")
_LAG = 0.1  # [s]; targets are compared with positions this much later
_MOVING = (0.01, 0.2)  # [rad/s]


@dataclass(frozen=True, kw_only=True)
class Sag:
    """What slow strokes of one joint show."""

    joint: str
    """The joint."""

    lean: float
    """Mean of target minus position over up and down strokes [rad]."""

    hysteresis: float
    """Half the difference between up and down strokes [rad]: friction over stiffness."""

    gravity: dict[tuple[int, ...], float]
    """Mean torque of gravity, in the recording's sign [N m], by the signs of WEIGHT_JOINTS against the model."""


def static_sag(path: Path) -> list[Sag]:
    """Lean, hysteresis and gravity of every joint in a slow recording such as friction_gravity.

    Raises:
        ValueError: If a joint does not move slowly both ways.
    """
    recording = load_recording(path)
    time, position = recording.time, recording.dof_pos
    late = np.stack([np.interp(time - _LAG, time, column) for column in recording.des_dof_pos.T], axis=1)
    speed = np.gradient(late, time, axis=0)
    # a stroke drags once the joint has taken up the hysteresis: it must have moved in the same direction for 1 s
    rate = np.gradient(np.stack([np.interp(time - 1.0, time, column) for column in late.T], axis=1), time, axis=0)
    error, same = late - position, np.sign(rate) == np.sign(speed)
    slow = (np.abs(speed) > _MOVING[0]) & (np.abs(speed) < _MOVING[1]) & same & (time > 5.0)[:, None]
    result = []
    for j, joint in enumerate(SO101_JOINTS):
        up, down = slow[:, j] & (speed[:, j] > 0), slow[:, j] & (speed[:, j] < 0)
        if min(up.sum(), down.sum()) < 50:
            raise ValueError(f"{path}: {joint} does not move slowly both ways. Use friction_gravity.npz.")
        mean_up, mean_down = float(error[up, j].mean()), float(error[down, j].mean())
        result.append(
            Sag(
                joint=joint,
                lean=(mean_up + mean_down) / 2,
                hysteresis=(mean_up - mean_down) / 2,
                gravity={signs: _gravity(position[up | down], signs, j) for signs in _sign_choices()},
            )
        )
    return result


def sag_table(sags: list[Sag]) -> str:
    """Lean and hysteresis, then the stiffness that each choice of signs asks for, the likeliest first."""
    lines = [f"{'joint':14} {'lean [mrad]':>12} {'hysteresis':>12} {'gravity [N m]':>14}  (signs of the model)"]
    plain = (1,) * len(WEIGHT_JOINTS)
    for sag in sags:
        lines.append(f"{sag.joint:14} {1e3 * sag.lean:12.1f} {1e3 * sag.hysteresis:12.1f} {sag.gravity[plain]:14.3f}")
    lines += ["", f"stiffness [N m/rad] by the signs of {', '.join(WEIGHT_JOINTS)}:"]
    carrying = [sag for sag in sags if sag.joint in WEIGHT_JOINTS]
    rows = []
    for signs in _sign_choices():
        stiffness = np.array([-sag.gravity[signs] / sag.lean for sag in carrying])
        spread = float(stiffness.std() / abs(stiffness.mean()))
        rows.append((bool((stiffness < 0).any()), spread, signs, stiffness))
    for impossible, spread, signs, stiffness in sorted(rows, key=lambda row: row[:2]):
        text = "impossible: one is negative" if impossible else f"spread {100 * spread:.0f} %"
        lines.append("  ".join([str(signs).ljust(12), *(f"{value:7.1f}" for value in stiffness), text]))
    return "\n".join(lines)


def _sign_choices() -> list[tuple[int, ...]]:
    return list(itertools.product((1, -1), repeat=len(WEIGHT_JOINTS)))


def _gravity(positions: np.ndarray, signs: tuple[int, ...], joint: int) -> float:
    """Mean torque of gravity on a joint, in the recording's sign [N m]."""
    model = mujoco.MjModel.from_xml_path(str(ASSETS_DIR / "so101" / "so101.xml"))
    data = mujoco.MjData(model)
    sign = np.array([dict(zip(WEIGHT_JOINTS, signs, strict=True)).get(name, 1) for name in SO101_JOINTS])
    address = [model.joint(name).qposadr[0] for name in SO101_JOINTS]
    torques = []
    for position in positions[::20]:
        data.qpos[address] = sign * position
        data.qpos[address[5]] = JAW_CLOSED + position[5] * JAW_COUNTS / COUNTS_PER_RAD
        mujoco.mj_forward(model, data)  # at rest, so that the bias is the holding torque
        torques.append(-sign[joint] * data.qfrc_bias[model.joint(SO101_JOINTS[joint]).dofadr[0]])
    return float(np.mean(torques))
