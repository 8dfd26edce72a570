"""Which variable carries what the model does not explain."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy import signal

from pace_optim.diagnosis.fitted import Fitted
from pace_optim.diagnosis.model import BASE
from pace_optim.diagnosis.side_by_side import SideBySide, Slot
from pace_optim.joint_twins.problem import TwinProblem

_CUTOFF = 20.0
_BINS = 30
_FOLDS = 5
_BLOCK_S = 1.0
_WORTH_A_WORD = 0.1
VARIABLES = {
    "q": "position [rad]",
    "v": "speed [rad/s]",
    "q·sgn v": "position [rad], times the sign of speed",
    "|τ|·sgn v": "size of the torque [N m], times the sign of speed",
    "τ": "torque [N m]",
    "t": "time in the recording [s]",
}


def error_map(problem: TwinProblem, model: Fitted, floor: torch.Tensor) -> dict[str, Any]:
    """What part of the missing torque a map of one variable explains, joint by joint.

    With Δ measured less simulated, both low-passed without delay, the torque that the model lacks is

        r = (M + J) Δq̈ + (d + kd) Δq̇ + F Δsgn q̇ + (kp - K) Δq

    A map is one value per bin of the variable, times its sign where it has one; R² is cross-validated over blocks of
    one second.

    Args:
        problem: The joints simulated alone.
        model: What was fitted.
        floor: Of each joint, (n,) [rad]; a joint whose error is below is left out.
    """
    torques, signals, folds, rms = _residual_torques(problem, model)
    joints: dict[str, dict[str, Any]] = {}
    for j, name in enumerate(problem.joint_names):
        if rms[j] <= float(floor[j]):
            continue
        r2, curves = {}, {}
        for variable in VARIABLES:
            r2[variable], curves[variable] = _map_of(
                signals[variable][:, j], torques[:, j], signals, variable, folds, j
            )
        best = max(r2, key=lambda variable: r2[variable])
        joints[name] = {
            "r2": r2,
            "best": best,
            "best_label": VARIABLES[best],
            "sentence": _sentence(r2[best], VARIABLES[best]),
            "curve": curves[best],
        }
    if not joints:
        return {}
    worst = max(joints, key=lambda name: max(joints[name]["r2"].values()))
    return {"sentence": f"{worst}: {joints[worst]['sentence']}", "joints": joints}


def _sentence(r2: float, label: str) -> str:
    if r2 < _WORTH_A_WORD:
        return "no single variable carries the missing torque."
    return f"a map of {label.split(' [')[0]}{label.partition(']')[2]} explains {100 * r2:.0f} % of the missing torque."


def _residual_torques(
    problem: TwinProblem, model: Fitted
) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Missing torque (K, n), what it may depend on, the fold of each sample (K,), and the RMS error (n,)."""
    batch = SideBySide(problem, [Slot(model=model.model, rows=1)], training=False)
    data, path = batch.dataset, problem.path
    physical = model.model.to_physical(model.x)
    errors = batch.simulate([physical[None]], data.sampled)[0].numpy().astype(float)
    steps = data.sampled.any(dim=1).nonzero()[:, 0].tolist()
    row = {step: i for i, step in enumerate(steps)}
    base = dict(zip(BASE, physical[:, : len(BASE)].T.numpy(), strict=True))
    kp, kd = _gains(batch)
    parts: dict[str, list[np.ndarray]] = {key: [] for key in ("r", *VARIABLES)}
    folds, squares, count = [], 0.0, 0
    for r, recording in enumerate(data.recordings):
        at = np.arange(recording.num_samples) * recording.sample_stride
        dt = recording.sample_stride * problem.control_dt
        k = np.minimum(at, len(path.feel.torque) - 1)
        error = errors[[row[step] for step in at.tolist()], r]
        squares, count = squares + np.square(error).sum(axis=0), count + len(at)
        q = _smooth(np.asarray(recording.dof_pos) + base["encoder_bias"], dt)
        gap = _smooth(-error, dt)
        v, gap_v = np.gradient(q, dt, axis=0), np.gradient(gap, dt, axis=0)
        a, gap_a = np.gradient(v, dt, axis=0), np.gradient(gap_v, dt, axis=0)
        inertia = path.feel.inertia[k, r].numpy() + base["armature"]
        stiffness = path.stiffness[np.minimum(k, len(path.stiffness) - 1), r].numpy()
        turned = _smooth(np.sign(v) - np.sign(v - gap_v), dt)
        missing = inertia * gap_a + (base["viscous_friction"] + kd[r]) * gap_v + (kp[r] - stiffness) * gap
        parts["r"].append(missing + base["friction"] * turned)
        torque = inertia * a - path.feel.torque[k, r].numpy()
        time = np.broadcast_to(at[:, None] * problem.control_dt, q.shape)
        for key, value in zip(VARIABLES, (q, v, q, np.abs(torque), torque, time), strict=True):
            parts[key].append(value)
        folds.append(((at * problem.control_dt / _BLOCK_S).astype(int) + r) % _FOLDS)
    joined = {key: np.concatenate(values) for key, values in parts.items()}
    return joined.pop("r"), joined, np.concatenate(folds), np.sqrt(squares / count)


def _gains(batch: SideBySide) -> tuple[np.ndarray, np.ndarray]:
    """Proportional and derivative gains of each recording and joint, (R, n)."""
    robot = batch.rollout.robot
    kp = torch.zeros(robot.data.joint_pos.shape, dtype=torch.float64)
    kd = torch.zeros_like(kp)
    for actuator in robot.actuators.values():
        kp[:, actuator.joint_indices], kd[:, actuator.joint_indices] = actuator.stiffness, actuator.damping
    return kp.numpy(), kd.numpy()


def _smooth(values: np.ndarray, dt: float) -> np.ndarray:
    sos = signal.butter(2, min(_CUTOFF * 2 * dt, 0.8), output="sos")
    return signal.sosfiltfilt(sos, values, axis=0)


def _map_of(
    value: np.ndarray, torque: np.ndarray, signals: dict[str, np.ndarray], variable: str, folds: np.ndarray, j: int
) -> tuple[float, dict[str, list[float]]]:
    """R² of a map, cross-validated, and the map from all samples."""
    weight = np.sign(signals["v"][:, j]) if variable.endswith("sgn v") else np.ones(len(torque))
    edges = np.unique(np.quantile(value, np.linspace(0, 1, _BINS + 1)[1:-1]))
    bins, count = np.searchsorted(edges, value), len(edges) + 1

    def fitted(where: np.ndarray) -> np.ndarray:
        top = np.bincount(bins[where], (weight * torque)[where], count)
        return top / np.maximum(np.bincount(bins[where], weight[where] ** 2, count), 1.0)

    left, whole = 0.0, 0.0
    for fold in range(_FOLDS):
        own = folds == fold
        left += float(np.square(torque[own] - (weight * fitted(~own)[bins])[own]).sum())
        whole += float(np.square(torque[own] - torque[~own].mean()).sum())
    every = np.ones(len(torque), dtype=bool)
    middle = np.bincount(bins, value, count) / np.maximum(np.bincount(bins, minlength=count), 1)
    return 1 - left / max(whole, 1e-30), {"at": middle.tolist(), "torque": fitted(every).tolist()}
