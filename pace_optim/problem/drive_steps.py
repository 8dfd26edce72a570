"""The steps at which drives are simulated, and whether their loops are stable there."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import mujoco
import numpy as np

from pace_envs import ManagerBasedEnv, ManagerBasedRLEnv, set_physics_dt
from pace_envs.tasks.pace import PaceSim2realEnvCfg
from pace_optim.problem.drive_facts import acting_gains, drive_in, gains, of_joints
from pace_optim.recording import Recording

_FINE = 0.5
"""Largest kd dt / inertia at which a continuous loop is simulated: its steps are of second order."""
_APART = 0.025
"""Part of a drive's period by which whole physics steps may miss it."""
_FINEST = 10
"""Physics steps per time step that are taken for that at most."""


def set_control_step(cfg: PaceSim2realEnvCfg) -> None:
    """Let commands come, and delays count, in steps of the environment: a drive that runs faster has its ``drive_dt``.

    Args:
        cfg: The environment; its drives are changed.
    """
    control_dt = cfg.sim.dt * cfg.decimation
    for drive in cfg.scene.robot.actuators.values():
        if drive.control_decimation == cfg.decimation:
            continue
        own = cfg.sim.dt * drive.control_decimation
        if cfg.decimation % drive.control_decimation:
            raise ValueError(
                f"The drive's controller runs every {1e3 * own:g} ms, the environment steps every "
                f"{1e3 * control_dt:g} ms: the one must divide the other. Set the drive's control_decimation to the "
                "environment's decimation, and its own rate as drive_dt."
            )
        if drive.drive_dt is None and not drive.implicit:
            drive.drive_dt = own
        drive.delay, drive.max_delay = (
            None if steps is None else steps * own / control_dt for steps in (drive.delay, drive.max_delay)
        )
        drive.control_decimation = cfg.decimation


def set_drive_rate(cfg: PaceSim2realEnvCfg, physics_dt: float | None = None) -> None:
    """Make the longest physics step as fine as the drives' own rates, such that their periods are whole numbers of it.

    Where a period fits no step, its drive runs on a separate clock, which is right to 2.5 % from run to run.

    Args:
        cfg: The environment; it is changed.
        physics_dt: The physics step that is asked for [s]; one that is longer than that is refused where drives are
            built, and changes nothing here.
    """
    own = [drive.drive_dt for drive in cfg.scene.robot.actuators.values() if drive.drive_dt is not None]
    if own and (physics_dt is None or physics_dt < min(own) * (1 + 1e-9)):
        parts = max(1, math.ceil(cfg.sim.dt / min(own) * (1 - 1e-9)))
        while any(abs(runs - round(runs)) > _APART * runs for runs in (parts * each / cfg.sim.dt for each in own)):
            parts += 1
        set_physics_dt(cfg, cfg.sim.dt / parts)


def set_drive_step(cfg: PaceSim2realEnvCfg, env: ManagerBasedRLEnv | None = None) -> float | None:
    """The physics step that a task asks for, made finer where drives that run continuously need it.

    Args:
        cfg: The environment's configuration; it takes steps of second order where a drive runs continuously.
        env: The environment, if it has been built.

    Returns:
        The step [s]; ``None`` if the present one is fine enough. A search may take the present one: it is stable.
    """
    steps = math.ceil(cfg.sim2real.physics_steps / cfg.decimation)  # of a control step; a drive's rate has made some
    if any(drive.implicit for drive in cfg.scene.robot.actuators.values()):
        cfg.sim.integrator, cfg.scene.num_envs = "leapfrog", 1
        own = env or ManagerBasedRLEnv(cfg)
        inverse = _inverse_inertia(own, upper=False)
        damping = of_joints(own, "damping", only_implicit=True)
        if env is None:
            own.close()
        steep = float((damping * cfg.sim.dt * inverse.diagonal()).max())
        steps = max(steps, min(_FINEST, math.ceil(steep / _FINE)))
    return cfg.sim.dt / steps if steps > 1 else None


def loop_dt(cfg: PaceSim2realEnvCfg, control_dt: float) -> float:
    """Shortest time between two runs of the drives' loops [s]; 0: one runs continuously."""
    drives = cfg.scene.robot.actuators.values()
    return min(0.0 if drive.implicit else drive.drive_dt or control_dt for drive in drives)


def check_loops(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> list[str]:
    """Whether the drives' loops are stable at their steps with the gains of each recording.

    With inertia M and armature, a loop that holds its torque over dt is unstable where an eigenvalue of
    M⁻¹ (kd dt + kp dt² / 2) exceeds 2.

    Returns:
        A note per recording whose loop is unstable with the armature of the configuration; empty if it is not.

    Raises:
        ValueError: It is unstable with the largest armature too.
    """
    names = env.scene["robot"].joint_names
    dt = of_joints(env, "_run_dt")
    surely, likely = (_inverse_inertia(env, upper=upper) for upper in (True, False))
    notes = []
    for recording in recordings:
        kp, kd = acting_gains(drive_in(env, recording), recording)
        pull = _pull(env, recording)
        note = ""
        for inverse, certain in ((surely, True), (likely, False)):
            root = np.sqrt(pull)
            values, vectors = np.linalg.eigh(root[:, None] * inverse * root)
            if values[-1] <= 2 * (1 + 1e-9):
                continue
            j = int(np.abs(vectors[:, -1]).argmax())
            felt = inverse[j, j]
            told = (
                f"the loop of {names[j]} is unstable at its step of {1e3 * dt[j]:g} ms. kd dt / inertia is "
                f"{kd[j] * dt[j] * felt:.3g} and kp dt² / inertia {kp[j] * dt[j] ** 2 * felt:.3g}, with an armature of "
                f"{_armature(env, certain)[j]:.3g}. Expected kd dt + kp dt² / 2 below 2 times the inertia"
            )
            cure = "set drive_dt or implicit=True in its PaceDCMotorCfg, or correct the gains."
            if certain:
                raise ValueError(f"{recording.name}: {told}. A real drive runs its loop faster: {cure}")
            note = f"{told}. A fit seeks larger armatures. If it ends at the least one, the real loop is faster: {cure}"
        notes.append(note)
    return notes


def least_armature(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> np.ndarray:
    """The armature below which a joint's loop, alone, is unstable at its step in a recording, (n,) [kg m²].

    No recording of such a loop exists: with m the joint's inertia where all others are free, it is stable from
    (kd dt + kp dt² / 2) / 2 - m on. A search that strays below finds oscillations.
    """
    alone = 1.0 / np.linalg.inv(_inertia(env, 0.0)).diagonal()
    return np.max([0.5 * _pull(env, recording) - alone for recording in recordings], axis=0).clip(min=0.0)


def _pull(env: ManagerBasedRLEnv, recording: Recording) -> np.ndarray:
    """Inertia that a loop which holds its torque asks for, twice: kd dt + kp dt² / 2, (n,) [kg m²]."""
    dt = of_joints(env, "_run_dt")
    kp, kd = acting_gains(drive_in(env, recording), recording)
    return np.where(dt > 0, kd * dt + 0.5 * kp * dt**2, 0.0)


def loop_gains(env: ManagerBasedEnv, recordings: Sequence[Recording]) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness [N m/rad] and damping [N m s/rad] of each joint's loop, means of the recordings', (n,) each."""
    kp, kd = np.mean([gains(drive_in(env, each)) for each in recordings], axis=0)
    return kp, kd


def _armature(env: ManagerBasedRLEnv, upper: bool) -> np.ndarray:
    """Of the configuration, or the largest that may be identified, (n,) [kg m²]."""
    own = of_joints(env, "armature")
    bounds = env.cfg.sim2real.bounds["armature"].numpy()  # type: ignore[attr-defined]
    return bounds[:, 1] if upper else np.clip(own, bounds[:, 0], bounds[:, 1])


def _inverse_inertia(env: ManagerBasedRLEnv, upper: bool) -> np.ndarray:
    """(M + armature)⁻¹ of the joints at the default posture, (n, n)."""
    return np.linalg.inv(_inertia(env, _armature(env, upper)))


def _inertia(env: ManagerBasedRLEnv, armature: np.ndarray | float) -> np.ndarray:
    """M + armature of the joints at the default posture, (n, n) [kg m²]."""
    robot = env.scene["robot"]
    model, driven = copy.copy(env.sim.model), robot.driven
    columns, turn = robot.dof_columns.numpy(), driven.inverse
    driven.clear(model)
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    posture = driven.to_joints(robot.data.default_joint_pos[0].numpy())
    data.qpos[model.jnt_qposadr[model.dof_jntid[columns]]] = posture
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    own = turn.T @ mass[np.ix_(columns, columns)] @ turn
    own[np.diag_indices(len(columns))] += armature
    return own + 1e-12 * np.eye(len(columns))
