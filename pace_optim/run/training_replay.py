"""A run's recordings, replayed inside a training environment: the same drives, its physics, the base held."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import torch

from pace_actuators import IdentifiedDrives
from pace_actuators.drive_result import ALL
from pace_actuators.identified import DRIVE_FIELDS
from pace_actuators.joint_units import JointType, joint_label, units_for
from pace_actuators.text import listed
from pace_envs import ManagerBasedRLEnv
from pace_envs.identified import use_identified
from pace_envs.manager_based_env import ManagerBasedEnvCfg
from pace_envs.registration import set_physics_dt
from pace_envs.tasks.pace import PaceSim2realEnvCfg
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.recordings import conform_all, read_logs
from pace_optim.problem.rollout import Rollout
from pace_optim.recording.dataset import make_dataset
from pace_optim.run.open import Run
from pace_optim.run.result import FitResult, rmse_by_joint

_DEPTH = 100.0
"""How far the ground is below, so that no leg reaches it [m]."""
_MANY = 10.0
"""Times the fit's error from which on it is stated as such."""


@dataclass(frozen=True, kw_only=True)
class TrainingReplay:
    """Errors of a fit in a training environment, beside its own."""

    joint_names: tuple[str, ...]
    """The joints, in order."""

    joint_types: tuple[JointType, ...]
    """Whether each of them turns or slides."""

    control_dt: float
    """Control step of the training environment [s]."""

    fitted_control_dt: float
    """Control step of the identification [s]."""

    fitted: Mapping[str, Mapping[str, float]]
    """RMSE of the fit by ``"train"`` and ``"validation"``, joint (and ``"all"``) [rad]."""

    replayed: Mapping[str, Mapping[str, float]]
    """The same in the training environment."""

    touching: tuple[str, ...] = ()
    """Links that touch each other where the recordings begin, as "A and B"."""

    @property
    def table(self) -> list[str]:
        """Its lines, one per joint."""
        width = max(len(name) + len(" [mrad]") for name in (*self.joint_names, "joint"))
        parts = [part for part in ("train", "validation") if self.replayed.get(part)]
        head = "".join(f"{part + ': fit':>18}{'training env':>15}{'change':>11}" for part in parts)
        lines = [f"{'RMSE ' + units_for('[mrad]', self.joint_types):<{width}}{head}"]
        labels = [joint_label(*each, self.joint_types) for each in zip(self.joint_names, self.joint_types, strict=True)]
        for name, label in zip((*self.joint_names, ALL), (*labels, ALL), strict=True):
            cells = ""
            for part in parts:
                fitted, here = self.fitted[part][name], self.replayed[part][name]
                ratio = here / fitted
                change = f"{100 * (ratio - 1):+.2f} %" if ratio < _MANY else f"{ratio:,.0f} times"
                cells += f"{1e3 * fitted:>18.4f}{1e3 * here:>15.4f}{change:>11}"
            lines.append(f"{label:<{width}}{cells}")
        lines.append(
            f"control steps: {1e3 * self.fitted_control_dt:g} ms in the fit, {1e3 * self.control_dt:g} ms here"
        )
        if self.touching:
            pairs = listed(self.touching, 4)
            lines.append(f"Links of the training environment's robot touch each other and push its joints: {pairs}.")
            lines.append("In the fit, nothing touches. Correct their shapes, or exclude the pairs in <contact>.")
        return lines

    def __str__(self) -> str:
        """The table as text."""
        return "\n".join(self.table)


def replay_in_training(run: str | Path, cfg: ManagerBasedEnvCfg | None = None) -> TrainingReplay:
    """Let the robot of a training environment follow the recordings of a fit, its base held in the air.

    The drives are those that :func:`pace_envs.identified.use_identified` makes of the result, with the gains that were
    in force in the recordings; the model, its contacts and the physics are the training environment's.

    Args:
        run: The fit's folder, or its ``result.json``.
        cfg: The training environment; it is not changed. ``None`` means that of the identification, with the drives
            as a training would have them.
    """
    opened = Run.open(run)
    folder, settings, fitted_cfg = opened.folder, opened.settings, opened.load_cfg()
    result = FitResult.load(folder)
    if not isinstance(fitted_cfg, PaceSim2realEnvCfg):
        raise ValueError(f"{settings.task} is no identification task: {folder} cannot be replayed.")
    if cfg is None:
        cfg = copy.deepcopy(fitted_cfg)
        set_physics_dt(cfg, result.physics_dt, "the fit's physics step")
    env_cfg = _held_robot(fitted_cfg, cfg, folder)
    control_dt = env_cfg.sim.dt * env_cfg.decimation
    env = ManagerBasedRLEnv(_with_envs(env_cfg, 1))
    paths = settings.data or [str(fitted_cfg.sim2real.recording)]
    logs = read_logs(
        (paths, settings.validation),
        env,
        joints=".*",
        columns=settings.columns,
        facts=settings.facts,
        rate=settings.rate,
        strict=settings.strict,
    )
    trained, held_out = (conform_all(each, env, control_dt, strict=settings.strict) for each in logs.groups)
    dataset = make_dataset(trained, held_out)
    env.close()
    env = ManagerBasedRLEnv(_with_envs(env_cfg, dataset.num_recordings))
    error, touching = _errors(env, Rollout(env, dataset, _AsItIs()))  # type: ignore[arg-type]
    env.close()
    step = dataset.sampled.any(dim=1).nonzero()[:, 0]  # logs may be slower than the control step
    where = dataset.sampled[step]
    residuals = Residuals(error=error[None] * where[None, :, :, None], where=where, step=step)
    return TrainingReplay(
        joint_names=tuple(result.joint_names),
        joint_types=result.joint_types,
        control_dt=control_dt,
        fitted_control_dt=IdentifiedDrives.load(folder).at.control_dt,
        fitted=result.rmse,
        replayed={
            part: rmse_by_joint(residuals, mask[step], tuple(result.joint_names))
            for part, mask in (("train", dataset.train), ("validation", dataset.validation))
        },
        touching=touching,
    )


class _AsItIs:
    """Stands for the parameter space: the drives keep the values of their configuration."""

    def apply(self, *_: Any) -> None:
        """Write nothing."""


def _held_robot(fitted: PaceSim2realEnvCfg, training: ManagerBasedEnvCfg, folder: Path) -> PaceSim2realEnvCfg:
    """The identification task with the training environment's robot and physics, and its ground far below."""
    cfg, training = copy.deepcopy(fitted), copy.deepcopy(training)
    drives = {name: _with_recorded_gains(drive, fitted) for name, drive in training.scene.robot.actuators.items()}
    training.scene.robot.actuators = drives
    use_identified(training, folder, gains=True, on_the_rig=True)
    robot = replace(
        training.scene.robot,
        fix_base=True,
        joint_order=tuple(fitted.sim2real.joint_order),
        init_state=fitted.scene.robot.init_state,
    )
    terrain = training.scene.terrain and replace(training.scene.terrain, height=-_DEPTH)
    cfg.scene = replace(cfg.scene, robot=robot, terrain=terrain)
    cfg.sim = training.sim
    decimations = {drive.control_decimation for drive in robot.actuators.values()}
    if len(decimations) > 1:
        raise ValueError(
            f"The drives have control_decimation {', '.join(map(str, sorted(decimations)))}, expected one for all: a "
            "recording is replayed at one control step."
        )
    cfg.decimation = decimations.pop()
    return cfg


def _with_recorded_gains(drive: Any, fitted: PaceSim2realEnvCfg) -> Any:
    """A training drive with the gains and limits of the identification task, for results that do not say them."""
    groups = [each for each in fitted.scene.robot.actuators.values() if each.joint_names_expr == drive.joint_names_expr]
    return replace(drive, **{name: getattr(groups[0], name) for name in DRIVE_FIELDS}) if groups else drive


def _with_envs(cfg: PaceSim2realEnvCfg, num_envs: int) -> PaceSim2realEnvCfg:
    cfg = copy.deepcopy(cfg)
    cfg.scene.num_envs = num_envs
    return cfg


def _errors(env: ManagerBasedRLEnv, rollout: Rollout) -> tuple[torch.Tensor, tuple[str, ...]]:
    """q_sim - bias - q_measured at every step with a sample, (K, R, n) [rad], and links that touch at the beginning."""
    robot, data = env.scene["robot"], rollout.dataset
    bias = torch.zeros(env.num_envs, robot.num_joints, dtype=torch.float64)
    for actuator in robot.actuators.values():
        bias[:, actuator.joint_indices] = actuator.encoder_bias
    rollout.start(torch.empty(1, 0), data.sampled)
    touching = _touching(env)
    return torch.stack([sim - bias - real for sim, real in rollout]), touching


def _touching(env: ManagerBasedRLEnv) -> tuple[str, ...]:
    """Links of the first environment that touch each other, as "A and B"."""
    model = env.sim.model_of(0)
    data = mujoco.MjData(model)
    env.sim.read_data(0, data)
    mujoco.mj_forward(model, data)
    bodies = [sorted(model.geom_bodyid[list(contact.geom)].tolist()) for contact in data.contact if contact.dist < 0]
    return tuple(dict.fromkeys(" and ".join(model.body(body).name for body in pair) for pair in bodies))
