"""Simulating commanded trajectories with known parameters."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from pace_envs.tasks.pace import PaceCfg
from pace_optim.motion.signals import Trajectory
from pace_optim.problem.drive_facts import of_joints
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.rollout import Rollout
from pace_optim.recording import Drive, Load, Recording, conform_recording
from pace_optim.recording.dataset import make_dataset

if TYPE_CHECKING:
    from pace_envs import Articulation, ManagerBasedEnv


def true_parameters(cfg: PaceCfg, space: ParameterSpace, overrides: Mapping[str, float]) -> torch.Tensor:
    """``PaceCfg.sample_params`` with some values replaced, as a vector (size,).

    Args:
        overrides: By name (all joints) or ``name/joint``; the latter win.
    """
    keys_of = {parameter.name: parameter.keys for parameter in space.parameters}
    values: dict[str, dict[str, float]] = {}
    for name, given in cfg.sample_params.items():
        _check_name(name, keys_of, f"sample_params of {cfg.robot_name}")
        values[name] = dict(given) if isinstance(given, Mapping) else dict.fromkeys(keys_of[name], float(given))
    for label, value in sorted(overrides.items(), key=lambda item: "/" in item[0]):
        name, slash, key = label.partition("/")
        _check_name(name, keys_of, "--parameter")
        if slash and key not in keys_of[name]:
            hint = _did_you_mean(key, keys_of[name])
            raise ValueError(f"--parameter {label}: {name} has no {key!r}.{hint} It has {', '.join(keys_of[name])}.")
        if not np.isfinite(value):
            raise ValueError(f"--parameter {label}={value}: expected a finite number.")
        for each in (key,) if slash else keys_of[name]:
            values.setdefault(name, {})[each] = value
    for name, keys in keys_of.items():
        if missing := [key for key in keys if key not in values.get(name, {})]:
            raise ValueError(
                f"The true value of {name} of {', '.join(missing)} is not known. Give it with --parameter "
                f"{name}=VALUE, or in sample_params of {cfg.robot_name}."
            )
    return space.from_dict(values)


def _check_name(name: str, keys_of: Iterable[str], where: str) -> None:
    available = tuple(keys_of)
    if name not in available:
        raise ValueError(
            f"{where}: there is no parameter {name!r}.{_did_you_mean(name, available)} Available: "
            f"{', '.join(available)}."
        )


def _did_you_mean(name: str, available: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(available), n=1)
    return f" Did you mean {close[0]!r}?" if close else ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Encoder:
    """Noise, then rounding to the encoder's steps.

    reading = round((q + e) / h) h,    e ~ N(0, noise²),  h = 2π / 2^bits
    """

    noise: float
    """Standard deviation [rad]."""
    bits: int | None
    """2^bits steps per turn; ``None`` does not round."""
    rng: np.random.Generator
    """Source of the noise."""
    radians: tuple[float, ...] = (1.0,)
    """What counts as a radian of each joint [rad, of slides m]: noise and steps are parts of it."""

    @property
    def is_exact(self) -> bool:
        """Whether every reading is the position itself."""
        return self.noise == 0 and self.bits is None

    def read(self, position: np.ndarray) -> np.ndarray:
        """Readings of positions [rad], same shape."""
        if self.noise:
            position = position + self.rng.normal(0.0, self.noise, position.shape) * np.array(self.radians)
        if self.bits is not None:
            step = 2 * np.pi / 2**self.bits * np.array(self.radians)
            position = np.round(position / step) * step
        return position


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulated:
    """A simulated recording, and what no encoder sees."""

    recording: Recording
    """What is written."""
    position: np.ndarray
    """The joints' own positions, (T, n) [rad]."""
    torque: np.ndarray
    """Torques applied between two samples, (T - 1, n) [N m]."""


def simulate(
    env: ManagerBasedEnv,
    trajectories: Sequence[Trajectory],
    *,
    space: ParameterSpace,
    truth: torch.Tensor,
    encoder: Encoder,
    drive: Drive,
    load: Load,
) -> list[Simulated]:
    """Let the robot follow trajectories of the same length, side by side.

    The robot starts at rest with its encoder at the first target. At every control step (1) the encoder is read,
    which is what is recorded and what the controller sees, (2) that step's target is issued, (3) the simulation
    advances.

    Args:
        truth: Their true values, (size,).
        encoder: Reads the positions, bias taken off.
        drive: Gains and limits instead of the robot's; a field of ``None`` keeps the robot's.
    """
    robot = env.scene["robot"]
    drafts = draft_recordings(env, trajectories, drive, load)
    dataset = make_dataset(drafts, train_fraction=1)
    rollout = Rollout(env, dataset, space)
    rollout.start(truth[None], dataset.sampled)

    shape = (len(trajectories[0].time), len(trajectories), robot.num_joints)
    position, reading, speed, torque = (np.zeros(shape) for _ in range(4))
    bias = truth[space["encoder_bias"]].numpy()
    for k, (true_position, _) in enumerate(rollout):
        position[k], speed[k] = true_position.numpy(), rollout.sim_dof_vel.numpy()
        torque[k - 1] = robot.data.applied_torque.numpy()  # of the step that led here; k = 0 is dropped
        reading[k] = encoder.read(position[k] - bias)
        if not encoder.is_exact:
            _show_to_controllers(robot, position[k] - reading[k])
    _check_finite(position, trajectories)
    drive_in_force = Drive(**{field.name: of_joints(env, field.name) for field in fields(Drive)})
    return [
        Simulated(
            recording=replace(
                drafts[r],
                dof_pos=np.ascontiguousarray(reading[:, r]),
                des_dof_pos=trajectories[r].told_pos,  # in rows: repeated values side by side make small files
                des_dof_vel=trajectories[r].told_vel,
                dof_vel=np.ascontiguousarray(speed[:, r]),
                drive=drive_in_force,
                notes=(),
            ),
            position=position[:, r],
            torque=torque[:-1, r],
        )
        for r in range(len(trajectories))
    ]


def draft_recordings(
    env: ManagerBasedEnv, trajectories: Sequence[Trajectory], drive: Drive, load: Load
) -> list[Recording]:
    """Recordings before they are made, on the control grid: the encoder stays at the first target."""
    robot = env.scene["robot"]
    accepts_load = env.cfg.sim2real.apply_load is not None  # type: ignore[attr-defined]
    return [
        conform_recording(
            trajectory.draft(drive, load),
            joint_order=robot.joint_names,
            control_dt=env.step_dt,
            load_bodies=robot.body_names,
            accepts_load=accepts_load,
        )
        for trajectory in trajectories
    ]


def _show_to_controllers(robot: Articulation, offset: np.ndarray) -> None:
    """Let controllers see the readings: position - offset, (num_envs, n) [rad]."""
    values = torch.as_tensor(offset)
    for actuator in robot.actuators.values():
        actuator.update_encoder_bias(values[:, actuator.joint_indices])


def _check_finite(position: np.ndarray, trajectories: Sequence[Trajectory]) -> None:
    bad = ~np.isfinite(position)
    if bad.any():
        k, r, j = np.argwhere(bad)[0]
        raise ValueError(
            f"The simulation of {trajectories[r].name!r} diverges at {trajectories[r].time[k]:.3f} s, joint "
            f"{trajectories[r].joint_names[j]}. Give it more armature, less delay or lower gains, or a "
            "finer --physics_dt."
        )
