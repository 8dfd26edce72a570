"""A published robot in plain MuJoCo: its file's own actuators, known drives, late commands, a hidden effect."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from pace_envs.model_file import read_model_file
from pace_optim.recording import Drive, Recording

CONTROL_DT = 0.0025
"""Between two commands [s]."""
NOISE = 1e-4
"""Of the encoders [rad or m]."""
LATE = 0.004
"""Of the command [s]; a PD loop at the control rate sees it at its next call."""
ROTOR = 0.004
"""Where the file has no armature: at least this at the joint [kg m²], as a humanoid's smallest geared drives."""
SETTLE = 1.0
"""Time at rest before the recording [s]."""
HIDDEN = ("stribeck", "quadratic", "offset")


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """What the recording's robot is, one value for each of its driven joints."""

    joints: tuple[str, ...]
    armature: np.ndarray
    viscous_friction: np.ndarray
    friction: np.ndarray
    encoder_bias: np.ndarray
    delay: float = LATE
    """Of the command, as the drives see it [s]."""
    hidden: str | None = None
    """The effect that the model lacks."""
    hidden_on: tuple[str, ...] = ()
    size: np.ndarray | float = 0.0
    """Torque of the motion's amplitude on kp [N m]."""


class Plant:
    """The robot of a file in plain MuJoCo: base held, nothing touches, the file's own actuators."""

    def __init__(self, path: Path, joints: tuple[str, ...], step: float | None):
        """Compile it.

        Args:
            path: The model file.
            joints: Its driven joints, in the order of the commands.
            step: Physics step [s]; ``None``: the file's own step and integrator.
        """
        spec = read_model_file(path).spec  # without meshes, which are not in every package
        for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
            spec.delete(joint)
        for key in list(spec.keys):
            spec.delete(key)
        full = read_model_file(path).spec.compile()
        self.model = model = spec.compile()
        self.data = mujoco.MjData(model)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        if step is not None:
            model.opt.timestep, model.opt.integrator = step, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        # friction that holds and gives way at once
        model.dof_solref[:], model.dof_solimp[:] = (2 * model.opt.timestep, 1.0), (0.999, 0.999, 0.001, 0.5, 2.0)
        self.home = home_of(full, model)
        self.columns = np.array([model.jnt_qposadr[model.joint(name).id] for name in joints])
        self.dofs = np.array([model.jnt_dofadr[model.joint(name).id] for name in joints])
        self.inertia = self._inertia()

    def _inertia(self) -> np.ndarray:
        data, full = mujoco.MjData(self.model), np.zeros((self.model.nv, self.model.nv))
        data.qpos[:] = self.home
        mujoco.mj_forward(self.model, data)
        mujoco.mj_fullM(self.model, data, full)
        return 1 / np.diag(np.linalg.inv(full))[self.dofs]  # that a torque meets; a loop on more oscillates

    def transmission(self, i: int) -> tuple[int, float]:
        """The joint that an actuator moves, of a tendon the first, and its length per radian."""
        model = self.model
        joint, ratio = int(model.actuator_trnid[i, 0]), float(model.actuator_gear[i, 0])
        if int(model.actuator_trntype[i]) == mujoco.mjtTrn.mjTRN_TENDON:
            first = int(model.tendon_adr[joint])
            wraps = range(first, first + int(model.tendon_num[joint]))
            joint, ratio = int(model.wrap_objid[first]), ratio * float(sum(model.wrap_prm[w] for w in wraps))
        return joint, ratio  # a tendon's joints follow one to one

    def actuators_of(self) -> list[tuple[int, float, float, float]]:
        """Of each driven joint its actuator, the length per radian, kp and kd at the joint."""
        model, result = self.model, []
        moved = [self.transmission(i) for i in range(model.nu)]
        for dof in self.dofs:
            for i, (joint, ratio) in enumerate(moved):
                if joint == int(model.dof_jntid[dof]):
                    gains = -model.actuator_biasprm[i, 1:3] * ratio**2
                    result.append((i, ratio, float(gains[0]), float(gains[1])))
                    break
        return result if all(kp > 0 for *_, kp, _ in result) else []  # motors: the loop is somebody else's


def effort_limits(plant: Plant) -> np.ndarray:
    """Largest torque of each driven joint by its own range, its motor's or its servo's force, (n,) [N m]."""
    model = plant.model
    joints = model.dof_jntid[plant.dofs]
    limits = np.where(model.jnt_actfrclimited[joints], model.jnt_actfrcrange[joints, 1], np.inf)
    for i in range(model.nu):
        most = np.inf
        if model.actuator_ctrllimited[i] and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE:
            most = model.actuator_gainprm[i, 0] * model.actuator_ctrlrange[i, 1]
        if model.actuator_forcelimited[i]:
            most = min(most, model.actuator_forcerange[i, 1])
        first, ratio = plant.transmission(i)
        if np.isfinite(most):
            limits[joints == first] = most * abs(ratio)
    return limits


def home_of(full: mujoco.MjModel, model: mujoco.MjModel) -> np.ndarray:
    """The home keyframe's posture (or the first one's, or the middle of ranges without 0) in the model without base."""
    names = [full.key(k).name for k in range(full.nkey)]
    key = next((names.index(name) for name in ("home", "stand") if name in names), 0 if names else None)
    home = model.qpos0.copy()
    for j in range(model.njnt):
        other, (low, high) = full.joint(model.joint(j).name), model.jnt_range[j]
        column = model.jnt_qposadr[j]
        if key is not None:
            home[column] = full.key_qpos[key, full.jnt_qposadr[other.id]]
        elif model.jnt_limited[j] and not low < home[column] < high:
            home[column] = (low + high) / 2
    return home


def draw_truth(
    plant: Plant, joints: tuple[str, ...], kp: np.ndarray, kd: np.ndarray, amplitude: np.ndarray, seed: int
) -> Truth:
    """Armature and damping near the file's, friction that the motion overcomes, biases."""
    rng, n, model = np.random.default_rng(seed), len(joints), plant.model
    armature, damping = model.dof_armature[plant.dofs], model.dof_damping[plant.dofs]
    slide = np.array([model.jnt_type[model.dof_jntid[dof]] == mujoco.mjtJoint.mjJNT_SLIDE for dof in plant.dofs])
    critical = 2 * np.sqrt(np.maximum(kp, 1e-3) * plant.inertia)
    undamped = np.where(kd > 0, 0.1, 0.5)  # of the critical damping, where the file gives the joint none
    return Truth(
        joints=joints,
        armature=rng.uniform(0.7, 1.5, n) * np.where(armature > 0, armature, rotor(plant)),
        viscous_friction=rng.uniform(0.7, 1.5, n) * np.where(damping > 0, damping, undamped * critical),
        friction=rng.uniform(0.05, 0.15, n) * np.minimum(kp * amplitude, effort_limits(plant)),
        encoder_bias=rng.uniform(-1, 1, n) * np.where(slide, 0.001, 0.02),
    )


def record(
    path: Path,
    command: Path,
    step: float | None,
    seed: int,
    hidden: str | None = None,
    hidden_on: tuple[str, ...] = (),
    truth: Truth | None = None,
) -> tuple[Recording, Truth]:
    """Play the commands on the robot.

    Args:
        path: The model file.
        command: CSV of the commands, as ``data_collection.py --export_command`` writes it.
        step: Physics step [s]; ``None``: the file's own.
        seed: Of the truth and the noise.
        hidden: An effect of some joints that the model lacks.
        hidden_on: Those joints; none: the two with the largest torques.
        truth: A robot that was drawn for another motion; ``None``: it is drawn.
    """
    with command.open() as file:
        header = file.readline().strip().split(",")
    joints = tuple(name.removeprefix("des_dof_pos/") for name in header[1:])
    table = np.loadtxt(command, delimiter=",", skiprows=1)
    target = table[:, 1:]
    plant = Plant(path, joints, step)
    amplitude = np.ptp(target, axis=0) / 2
    own = plant.actuators_of()
    kp, kd = np.array([pair[2:] for pair in own]).T if own else stated_gains(plant)
    noise_seed = seed + (1000 if truth is None else 2000)
    if truth is None:
        truth = draw_truth(plant, joints, kp, kd, amplitude, seed)
        if not own:
            truth = replace(truth, delay=float(np.ceil(LATE / CONTROL_DT - 1e-6) * CONTROL_DT))
        if hidden:
            two = hidden_on or tuple(joints[i] for i in np.argsort(-amplitude * kp)[:2])
            truth = replace(truth, hidden=hidden, hidden_on=two, size=kp * amplitude)
    position = simulate(plant, target, truth, own, kp, kd)
    noise = np.random.default_rng(noise_seed).normal(0, NOISE, position.shape)
    drive = Drive() if own else Drive(stiffness=kp, damping=kd)
    time_base = np.arange(len(target)) * CONTROL_DT
    recording = Recording(
        time=time_base,
        dof_pos=position + noise,
        des_dof_pos=target,
        joint_names=joints,
        name=command.stem,
        drive=drive,
    )
    return recording, truth


def rotor(plant: Plant) -> np.ndarray:
    """Armature where the file has none, (n,) [kg m²]."""
    return np.maximum(ROTOR, 0.3 * plant.inertia)


def stated_gains(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Gains where the file has none: 3 Hz and critical damping for the inertia at the joint: it stays in its range."""
    inertia = plant.inertia + rotor(plant)
    kp = (2 * np.pi * 3) ** 2 * inertia
    return kp, 2 * np.sqrt(kp * inertia)


def simulate(
    plant: Plant,
    target: np.ndarray,
    truth: Truth,
    own: list[tuple[int, float, float, float]],
    kp: np.ndarray,
    kd: np.ndarray,
) -> np.ndarray:
    """Positions that the encoders show, (T, n), without noise.

    A command of the file's actuators acts LATE after it was issued; a PD loop at the control rate sees the newest
    command that has arrived.
    """
    model, data, columns, dofs = plant.model, plant.data, plant.columns, plant.dofs
    model.dof_armature[dofs] = truth.armature
    model.dof_damping[dofs] = truth.viscous_friction
    model.dof_frictionloss[dofs] = truth.friction
    hit = np.array([name in truth.hidden_on for name in truth.joints])
    dt, limit = model.opt.timestep, effort_limits(plant)
    data.qpos[:] = plant.home
    positions = np.zeros_like(target)
    total = round((SETTLE + len(target) * CONTROL_DT) / dt)
    k, torque = -round(SETTLE / CONTROL_DT), np.zeros(len(dofs))  # a loop holds the robot while it settles
    for i in range(total):
        now = i * dt - SETTLE
        while k < len(target) and k * CONTROL_DT <= now + 1e-9:
            shown = data.qpos[columns] - truth.encoder_bias
            if k * CONTROL_DT > now - dt + 1e-9:  # between two steps: the state of its instant
                shown = shown - (now - k * CONTROL_DT) * data.qvel[dofs]
            if k >= 0:
                positions[k] = shown
            if not own:
                late = max(0, int(np.floor((k * CONTROL_DT - LATE) / CONTROL_DT + 1e-6)))
                torque = np.clip(kp * (target[late] - shown) - kd * data.qvel[dofs], -limit, limit)
            k += 1
        arrived = min(len(target) - 1, max(0, int(np.floor((now - LATE) / CONTROL_DT + 1e-6))))
        extra = hidden_torque(truth, hit, data.qvel[dofs])
        data.qfrc_applied[dofs] = extra
        if truth.hidden == "stribeck":
            slow = np.exp(-((data.qvel[dofs] / 0.1) ** 2))
            model.dof_frictionloss[dofs] = truth.friction * (1 + hit * 1.5 * slow)
        if own:
            for (a, ratio, *_), goal in zip(own, target[arrived] + truth.encoder_bias, strict=True):
                data.ctrl[a] = control_of(model, a, ratio * goal)
        else:
            data.qfrc_applied[dofs] += torque
        mujoco.mj_step(model, data)
    return positions


def control_of(model: mujoco.MjModel, a: int, length: float) -> float:
    """The control with which an actuator rests at a length, 0 = gain u + b0 + b1 L."""
    gain, bias = model.actuator_gainprm[a, 0], model.actuator_biasprm[a]
    return float((-bias[1] * length - bias[0]) / gain)


def hidden_torque(truth: Truth, hit: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """What the hidden effect adds."""
    if truth.hidden == "quadratic":
        return -hit * truth.viscous_friction * 0.5 * speed * np.abs(speed)
    if truth.hidden == "offset":
        return hit * 0.15 * truth.size
    return np.zeros_like(speed)
