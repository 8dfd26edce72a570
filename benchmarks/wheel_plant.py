"""A robot of a published model file in plain MuJoCo, with drives of its own: nothing here is this project's code.

A PD loop at 1 kHz holds each joint: τ = clip(kp (q* - q_enc) - kd q̇), q_enc = q - bias. It sees a command a whole
number of milliseconds after it was issued. Physics steps of 1/32 ms; base fixed, nothing touches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

STEP = 0.001 / 32
"""Physics step [s]. MuJoCo's step is of first order: at 0.125 ms, its error is as large as an encoder's noise."""
LOOP_STEPS = 32
"""Physics steps between two runs of the drives' loops."""
NOISE = 1e-4
"""Of the encoders [rad or m]."""
SETTLE = 1.5
"""Time at rest before a log [s]."""
HIDDEN = {
    "stribeck": "stribeck_friction",
    "torque_constant": "torque_gain",
    "spring": "parallel_spring",
    "payload": "payload",
    "backlash": "backlash",
}
"""What can be hidden, and its name in the library."""

_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_GAP = 0.02
"""Of a backlash [rad or, times 0.1, m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Drives:
    """What a robot's drives are, one value for each of its driven joints."""

    joints: tuple[str, ...]
    stiffness: np.ndarray
    damping: np.ndarray
    effort_limit: np.ndarray
    """Infinite where the plant has none."""
    stated_limit: bool
    """Whether the log states the limits, as the file's cannot be."""
    armature: np.ndarray
    viscous_friction: np.ndarray
    friction: np.ndarray
    encoder_bias: np.ndarray
    delay: float
    """[s]."""
    home: np.ndarray
    amplitude: np.ndarray
    rate: float
    """Of the log and its commands [Hz]."""
    hidden: str = ""
    hidden_on: tuple[str, ...] = ()

    def facts(self) -> dict:
        """What the log's owner knows."""
        known = {"joint_names": list(self.joints), "stiffness": _plain(self.stiffness), "damping": _plain(self.damping)}
        return {**known, "effort_limit": _plain(self.effort_limit)} if self.stated_limit else known

    def truth(self) -> dict:
        """What a fit should find."""
        groups = ("armature", "viscous_friction", "friction", "encoder_bias")
        values = {group: dict(zip(self.joints, _plain(getattr(self, group)), strict=True)) for group in groups}
        arrivals = round(self.delay / STEP) + np.arange(LOOP_STEPS) * round(1 / (self.rate * STEP))
        wait = float(np.mean(-arrivals % LOOP_STEPS))  # until the loop takes a command
        delay = self.delay + (wait - 0.5) * STEP  # the integrator applies a torque half a step early
        return {**values, "delay_s": delay, "hidden": self.hidden, "hidden_on": list(self.hidden_on)}


def _plain(values: np.ndarray) -> list[float]:
    return [float(f"{value:.8g}") for value in values]


@dataclass(eq=False)
class Plant:
    """A compiled robot."""

    model: mujoco.MjModel
    joints: tuple[str, ...]
    """The driven ones."""
    file_limits: np.ndarray
    """Largest torques by the file; infinite where it has none."""
    home: np.ndarray
    """Posture, (nq,)."""
    columns: np.ndarray = field(init=False)
    dofs: np.ndarray = field(init=False)
    slide: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        ids = [self.model.joint(name).id for name in self.joints]
        self.columns, self.dofs = self.model.jnt_qposadr[ids], self.model.jnt_dofadr[ids]
        self.slide = self.model.jnt_type[ids] == int(mujoco.mjtJoint.mjJNT_SLIDE)


def load(path: Path, default_friction: bool = False) -> Plant:
    """Compile a robot from its file, base fixed, without its actuators.

    Args:
        path: The file.
        default_friction: Joint friction as MuJoCo has it by default: soft. Otherwise it holds, and gives way at once.
    """
    limits: dict[str, float] = {}
    inertias: dict[str, np.ndarray] = {}
    if path.suffix == ".urdf":
        xml, limits, inertias, mimics = _prepared_urdf(path)
        spec = mujoco.MjSpec.from_string(xml)
        names = {joint.name for joint in spec.joints}
        for joint, leader, multiplier, offset in mimics:
            if leader in names:
                tie = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=joint, name2=leader)
                tie.objtype, tie.data = mujoco.mjtObj.mjOBJ_JOINT, [offset, multiplier, *[0.0] * (len(tie.data) - 2)]
                tie.solref = [0.005, 1.0]
        followers = {joint for joint, leader, *_ in mimics if leader in names}
        driven = [joint.name for joint in spec.joints if int(joint.type) in _SINGLE and joint.name not in followers]
    else:
        spec = mujoco.MjSpec.from_file(str(path))
        _leave_out_missing(spec, path)
        driven = None
    full = spec.compile() if driven is None else None
    for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
        spec.delete(joint)
    keys = _home_key(full)
    for key in list(spec.keys):
        spec.delete(key)
    if full is not None:
        driven, limits = _actuated(full)
        for actuator in list(spec.actuators):
            spec.delete(actuator)
        for sensor in list(spec.sensors):
            spec.delete(sensor)
    model = spec.compile()
    for body, tensor in inertias.items():
        _set_inertia(model, body, tensor)
    model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    constant, impedances = (0.02, (0.9, 0.95)) if default_friction else (2 * STEP, (0.999, 0.999))
    model.dof_solref[:], model.dof_solimp[:] = (constant, 1.0), (*impedances, 0.001, 0.5, 2.0)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    home = model.qpos0.copy()
    for j in range(model.njnt):
        name, (low, high), column = model.joint(j).name, model.jnt_range[j], model.jnt_qposadr[j]
        if int(model.jnt_type[j]) not in _SINGLE:
            continue
        if name in keys:
            home[column] = keys[name]
        elif model.jnt_limited[j] and not low < home[column] < high:
            home[column] = (low + high) / 2
    order = [model.joint(j).name for j in range(model.njnt)]
    joints = tuple(sorted(dict.fromkeys(driven), key=order.index))
    return Plant(model, joints, np.array([limits.get(name, 0.0) or math.inf for name in joints]), home)


def _leave_out_missing(spec: mujoco.MjSpec, path: Path) -> None:
    """Take out geoms whose meshes are not in the wheel; the inertias of their bodies are stated."""
    folder = path.parent / spec.meshdir
    missing = [mesh for mesh in spec.meshes if mesh.file and not (folder / mesh.file).is_file()]
    names = {mesh.name or Path(mesh.file).stem for mesh in missing}
    for geom in [geom for geom in spec.geoms if geom.meshname in names]:
        for sensor in [
            sensor for sensor in spec.sensors if geom.name and geom.name in (sensor.objname, sensor.refname)
        ]:
            spec.delete(sensor)
        spec.delete(geom)
    for mesh in missing:
        spec.delete(mesh)


def _prepared_urdf(path: Path) -> tuple[str, dict[str, float], dict[str, np.ndarray], list]:
    """A URDF without shapes, its effort limits, inertias that MuJoCo refuses, and its mimic joints."""
    text = path.read_text(errors="replace").strip()
    for prefix in {word.split(":")[0].strip("</") for word in text.split() if word.startswith("drake:")}:
        text = text.replace(f"{prefix}:", f"{prefix}_")
    root = ElementTree.fromstring(text)
    for link in root.iter("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(part)
    for old in root.findall("mujoco"):
        root.remove(old)
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", fusestatic="false")
    inertias = {}
    moving = {
        joint.find("child").get("link")
        for joint in root.findall("joint")
        if joint.get("type") in ("revolute", "continuous", "prismatic")
    }
    for link in root.iter("link"):
        if (tensor := _repaired(link, link.get("name") in moving)) is not None:
            inertias[link.get("name")] = tensor
    limits, mimics = {}, []
    for joint in root.findall("joint"):
        if (limit := joint.find("limit")) is not None:
            limits[joint.get("name")] = float(limit.get("effort", 0))
        if (mimic := joint.find("mimic")) is not None:
            factor, offset = float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
            mimics.append((joint.get("name"), mimic.get("joint"), factor, offset))
    return ElementTree.tostring(root, encoding="unicode"), limits, inertias, mimics


def _repaired(link: ElementTree.Element, moves: bool) -> np.ndarray | None:
    """Give a link an inertia that MuJoCo compiles; returns its own, which is to be set afterwards, in the link's frame.

    A link without mass is a point of 1 mg.
    """
    inertial = link.find("inertial")
    mass = 0.0 if inertial is None else float(inertial.find("mass").get("value"))
    if mass <= 0:
        if inertial is not None:
            link.remove(inertial)
        if moves:
            inertial = ElementTree.SubElement(link, "inertial")
            ElementTree.SubElement(inertial, "mass", value="1e-6")
            ElementTree.SubElement(inertial, "inertia", ixx="1e-9", iyy="1e-9", izz="1e-9", ixy="0", ixz="0", iyz="0")
        return None
    stated = inertial.find("inertia")
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    xx, xy, xz, yy, yz, zz = (0.0 if stated is None else float(stated.get(key, 0)) for key in keys)
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] > 1e-12 and moments[0] + moments[1] >= moments[2]:
        return None
    if stated is not None:
        inertial.remove(stated)
    size = str(max(float(np.abs(moments).max()), 1e-9))
    ElementTree.SubElement(inertial, "inertia", ixx=size, iyy=size, izz=size, ixy="0", ixz="0", iyz="0")
    origin = inertial.find("origin")
    angles = [0.0] * 3 if origin is None else [float(word) for word in origin.get("rpy", "0 0 0").split()]
    turn = np.zeros(9)
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, angles, "XYZ")
    mujoco.mju_quat2Mat(turn, quat)
    turn = turn.reshape(3, 3)
    return turn @ tensor @ turn.T


def _set_inertia(model: mujoco.MjModel, body: str, tensor: np.ndarray) -> None:
    """Give a body an inertia [kg m^2] in its own frame, whether a real body can have it or not."""
    names = [model.body(b).name for b in range(model.nbody)]
    if body not in names:
        return
    moments, axes = np.linalg.eigh(tensor)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    b = names.index(body)
    model.body_inertia[b], model.body_iquat[b] = moments, quat


def _home_key(full: mujoco.MjModel | None) -> dict[str, float]:
    """Positions by joint of the keyframe that is the home posture; empty without one."""
    if full is None or not full.nkey:
        return {}
    names = [full.key(k).name for k in range(full.nkey)]
    key = next((names.index(name) for name in ("home", "stand") if name in names), 0)
    single = [j for j in range(full.njnt) if int(full.jnt_type[j]) in _SINGLE]
    return {full.joint(j).name: float(full.key_qpos[key, full.jnt_qposadr[j]]) for j in single}


def _actuated(full: mujoco.MjModel) -> tuple[list[str], dict[str, float]]:
    """Joints that an actuator moves, and their largest torques."""
    joints, limits = [], {}
    for i in range(full.nu):
        moved = int(full.actuator_trnid[i, 0])
        if int(full.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_TENDON):
            moved = int(full.wrap_objid[full.tendon_adr[moved]])
        elif int(full.actuator_trntype[i]) != int(mujoco.mjtTrn.mjTRN_JOINT):
            continue
        name, gear, most = full.joint(moved).name, abs(float(full.actuator_gear[i, 0])), math.inf
        if full.actuator_forcelimited[i]:
            most = float(np.abs(full.actuator_forcerange[i]).max()) * gear
        if full.actuator_ctrllimited[i] and full.actuator_biastype[i] == int(mujoco.mjtBias.mjBIAS_NONE):
            most = min(most, full.actuator_gainprm[i, 0] * float(np.abs(full.actuator_ctrlrange[i]).max()) * gear)
        if full.jnt_actfrclimited[moved]:
            most = min(most, float(np.abs(full.jnt_actfrcrange[moved]).max()))
        joints.append(name)
        limits[name] = 0.0 if math.isinf(most) else most
    return joints, limits


def draw(plant: Plant, seed: int, hidden: str = "") -> Drives:
    """Drives, posture and rates of a robot, drawn from a seed."""
    rng, model, n = np.random.default_rng(seed), plant.model, len(plant.joints)
    unit = np.where(plant.slide, 0.1, 1.0)  # what counts as a radian
    link, gravity = _link_inertia(plant)
    own = model.dof_armature[plant.dofs]
    armature = np.where(own > 0, rng.uniform(0.7, 1.4, n) * own, rng.uniform(0.2, 0.8, n) * np.maximum(link, 1e-6))
    model.dof_armature[plant.dofs] = armature
    inertia = _seen_inertia(plant)
    stiffness = (2 * np.pi * rng.uniform(2.5, 5.0, n)) ** 2 * inertia
    low, high = _ranges(plant)
    amplitude = np.minimum(rng.uniform(0.2, 0.4, n) * unit, 0.2 * (high - low))
    home = np.clip(plant.home[plant.columns], low + 1.5 * amplitude, high - 1.5 * amplitude)
    stiffness = np.maximum(stiffness, 3 * gravity / amplitude)  # hangs by a third of its motion at most
    damping = 2 * rng.uniform(0.4, 0.8, n) * np.sqrt(stiffness * inertia)
    needed = gravity + 1.5 * stiffness * amplitude
    bogus = np.isfinite(plant.file_limits) & (plant.file_limits < needed)
    limit = np.where(bogus, 2 * needed, plant.file_limits)
    viscous = rng.uniform(0.05, 0.3, n) * damping
    friction = rng.uniform(0.03, 0.1, n) * stiffness * amplitude
    bias = rng.uniform(-0.02, 0.02, n) * unit
    delay = 1e-3 * int(rng.integers(2, 9))
    rate = float(rng.choice([200.0, 250.0, 400.0, 500.0]))
    moving = np.argsort(-amplitude / unit + 1e-3 * rng.random(n))
    two = tuple(plant.joints[i] for i in sorted(moving[: min(2, n)]))
    return Drives(
        joints=plant.joints,
        stiffness=np.array(_plain(stiffness)),
        damping=np.array(_plain(damping)),
        effort_limit=np.array(_plain(limit)),
        stated_limit=bool(bogus.any()),
        armature=armature,
        viscous_friction=viscous,
        friction=friction,
        encoder_bias=bias,
        delay=delay,
        home=home,
        amplitude=amplitude,
        rate=rate,
        hidden=hidden,
        hidden_on=() if not hidden else plant.joints[-1:] if hidden == "payload" else two,
    )


def _ranges(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    model, ids = plant.model, plant.model.dof_jntid[plant.dofs]
    wide = np.where(plant.slide, 0.2, 2.0)
    limited = model.jnt_limited[ids].astype(bool) & (model.jnt_range[ids, 1] > model.jnt_range[ids, 0])
    home = plant.home[plant.columns]
    return (
        np.where(limited, model.jnt_range[ids, 0], home - wide),
        np.where(limited, model.jnt_range[ids, 1], home + wide),
    )


def _link_inertia(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Inertia of what a joint moves, without its rotor, and gravity's torque, at home."""
    mass, data = _mass_matrix(plant)
    return np.diag(mass)[plant.dofs] - plant.model.dof_armature[plant.dofs], np.abs(data.qfrc_bias[plant.dofs])


def _seen_inertia(plant: Plant) -> np.ndarray:
    """Inertia that a torque meets, 1 / (M⁻¹)ᵢᵢ: a loop on Mᵢᵢ oscillates where joints share their load."""
    return 1 / np.diag(np.linalg.inv(_mass_matrix(plant)[0]))[plant.dofs]


def _mass_matrix(plant: Plant) -> tuple[np.ndarray, mujoco.MjData]:
    data, mass = mujoco.MjData(plant.model), np.zeros((plant.model.nv, plant.model.nv))
    data.qpos[:] = plant.home
    mujoco.mj_forward(plant.model, data)
    mujoco.mj_fullM(plant.model, data, mass)
    return mass, data


def commands(drives: Drives, seconds: float, seed: int) -> np.ndarray:
    """Targets at the log's rate, (T, n): six sines a joint between 0.15 and 2.5 Hz, which begin at rest."""
    rng, n = np.random.default_rng(seed), len(drives.joints)
    t = np.arange(round(seconds * drives.rate)) / drives.rate
    frequency = np.geomspace(0.15, 2.5, 6)[:, None] * rng.uniform(0.85, 1.15, (6, n))
    weight = frequency**-0.5
    weight /= weight.sum(axis=0)
    phase = rng.uniform(0, 2 * np.pi, (6, n))
    wave = (weight * np.sin(2 * np.pi * frequency * t[:, None, None] + phase)).sum(axis=1)
    ramp = np.clip(t / 0.8, 0, 1)[:, None]
    return drives.home + 1.5 * drives.amplitude * wave * ramp**2 * (3 - 2 * ramp)


def log(plant: Plant, drives: Drives, target: np.ndarray, seed: int, torques: np.ndarray | None = None) -> np.ndarray:
    """Positions that the encoders show at the log's rate, (T, n), with noise.

    Args:
        plant: The robot.
        drives: Its drives.
        target: What they are told, (T, n).
        seed: Of the noise.
        torques: Gets the motors' torques at the same instants, (T, n) [N m].

    Raises:
        ValueError: If the robot does not stay where its commands are: a mistake of the drawing, not of a fit.
    """
    model, columns, dofs = plant.model, plant.columns, plant.dofs
    model.dof_armature[dofs], model.dof_damping[dofs] = drives.armature, drives.viscous_friction
    model.dof_frictionloss[dofs] = drives.friction
    mujoco.mj_setConst(model, mujoco.MjData(model))  # how soft a limit is follows from the armature
    hit = np.array([name in drives.hidden_on for name in drives.joints])
    added = _add_payload(plant, drives)
    data = mujoco.MjData(model)
    data.qpos[:] = plant.home
    data.qpos[columns] = drives.home
    gear = _Backlash(plant, drives, hit) if drives.hidden == "backlash" else None
    per_row = round(1 / (drives.rate * STEP))
    late = round(drives.delay / STEP)
    begin = round(SETTLE / STEP)
    shown, torque = np.zeros_like(target), np.zeros(len(dofs))
    slow = np.where(plant.slide, 0.01, 0.1)
    for i in range(begin + len(target) * per_row):
        now = i - begin
        speed = data.qvel[dofs] + 0.5 * STEP * data.qacc[dofs]  # the integrator's speed is half a step old
        angle = data.qpos[columns].copy()
        if gear is not None:
            angle[hit], speed[hit] = gear.angle, gear.speed
        seen = angle - drives.encoder_bias
        if now >= 0 and now % per_row == 0:
            shown[now // per_row] = seen
        if i % LOOP_STEPS == 0:
            row = min(max((now - late) // per_row, 0), len(target) - 1)
            asked = drives.stiffness * (target[row] - seen) - drives.damping * speed
            torque = np.clip(asked, -drives.effort_limit, drives.effort_limit)
            if drives.hidden == "torque_constant":
                torque = np.where(hit, 0.75, 1.0) * torque
        if torques is not None and now >= 0 and now % per_row == 0:
            torques[now // per_row] = torque
        force = torque.copy()
        if drives.hidden == "stribeck":
            extra = hit * 1.5 * np.exp(-((data.qvel[dofs] / slow) ** 2))
            model.dof_frictionloss[dofs] = drives.friction * (1 + extra)
        elif drives.hidden == "spring":
            force -= hit * 0.2 * drives.stiffness * (data.qpos[columns] - drives.home)
        elif gear is not None:
            force[hit] = gear.step(torque[hit], data.qpos[columns][hit], data.qvel[dofs][hit])
        data.qfrc_applied[dofs] = force
        mujoco.mj_step(model, data)
    if added is not None:
        added()
    if not np.isfinite(shown).all() or np.abs(shown - target).max() > 3 * np.ptp(target, axis=0).max() + 0.2:
        raise ValueError("the plant does not follow its commands")
    return shown + np.random.default_rng(seed).normal(0, NOISE, shown.shape)


def _add_payload(plant: Plant, drives: Drives):
    """Make the last joint's link half as heavy again; returns what takes that off."""
    if drives.hidden != "payload":
        return None
    model = plant.model
    body = int(model.jnt_bodyid[model.dof_jntid[plant.dofs[-1]]])
    before = float(model.body_mass[body]), model.body_inertia[body].copy()
    factor = 1.5
    model.body_mass[body] *= factor
    model.body_inertia[body] *= factor
    mujoco.mj_setConst(model, mujoco.MjData(model))

    def take_off() -> None:
        model.body_mass[body], model.body_inertia[body] = before
        mujoco.mj_setConst(model, mujoco.MjData(model))

    return take_off


class _Backlash:
    """Rotors behind a gap: encoder and friction are the rotor's, the joint feels the teeth."""

    def __init__(self, plant: Plant, drives: Drives, hit: np.ndarray):
        self.inertia, self.viscous = drives.armature[hit], drives.viscous_friction[hit]
        self.friction = drives.friction[hit]
        link = np.maximum(_seen_inertia(plant)[hit] - self.inertia, 0.1 * self.inertia)
        both = self.inertia * link / (self.inertia + link)
        self.stiffness = (2 * np.pi * 60) ** 2 * both
        self.damping = 2 * 0.3 * np.sqrt(self.stiffness * both)
        self.half = 0.5 * _GAP * np.where(plant.slide[hit], 0.1, 1.0)
        self.angle, self.speed = drives.home[hit].copy(), np.zeros(int(hit.sum()))
        dofs = plant.dofs[hit]
        plant.model.dof_armature[dofs] = 0.0
        plant.model.dof_damping[dofs] = 0.0
        plant.model.dof_frictionloss[dofs] = 0.0

    def step(self, torque: np.ndarray, joint: np.ndarray, joint_speed: np.ndarray) -> np.ndarray:
        """Move the rotors by a step; returns what the joints feel."""
        twist = self.angle - joint
        pressed = twist - np.clip(twist, -self.half, self.half)
        teeth = self.stiffness * pressed + np.where(pressed != 0, self.damping * (self.speed - joint_speed), 0.0)
        free = self.speed + STEP / self.inertia * (torque - teeth - self.viscous * self.speed)
        self.speed = np.sign(free) * np.maximum(np.abs(free) - STEP * self.friction / self.inertia, 0.0)
        self.angle = self.angle + STEP * self.speed
        return teeth
