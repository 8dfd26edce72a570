"""Logs of robots whose base moves, made in plain MuJoCo: nothing of this project is imported.

A walking robot has a free base and feet on the ground. A robot in ropes has a base that swings on a pendulum, and
touches nothing. Both log encoders, commands, an IMU and, where there are feet, contacts.

    python benchmarks/walking_plant.py assets/anymal_d/anymal_d.xml --swing --output swing.npz
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

STEP, CONTROL = 0.000125, 0.0025
"""Of the physics, and of the drives and the log [s]."""
QUADRUPED = """
<mujoco model="crawler">
  <compiler angle="radian"/>
  <option cone="elliptic" impratio="10"/>
  <default>
    <joint type="hinge" range="-2.5 2.5"/>
    <geom contype="0" conaffinity="1" friction="0.9 0.02 0.01"/>
  </default>
  <worldbody>
    <body name="trunk" pos="0 0 0.30">
      <freejoint name="root"/>
      <site name="imu" pos="0.05 0.01 0.02"/>
      <geom type="box" size="0.2 0.1 0.04" mass="6"/>
      {legs}
    </body>
  </worldbody>
</mujoco>
"""
_LEG = """
      <body name="{leg}_thigh" pos="{x} {y} 0">
        <joint name="{leg}_hip" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.16" size="0.02" mass="0.7"/>
        <body name="{leg}_shank" pos="0 0 -0.16">
          <joint name="{leg}_knee" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.16" size="0.015" mass="0.25"/>
          <geom name="{leg}_foot" type="sphere" pos="0 0 -0.16" size="0.02" mass="0.05"/>
        </body>
      </body>"""
LEGS = ("fl", "fr", "rl", "rr")


def quadruped() -> str:
    """The MJCF of a small robot with four legs of two joints each."""
    places = zip(LEGS, (0.18, 0.18, -0.18, -0.18), (0.12, -0.12, 0.12, -0.12), strict=True)
    return QUADRUPED.format(legs="".join(_LEG.format(leg=leg, x=x, y=y) for leg, x, y in places))


def trot(time: float, legs: int = 4, rate: float = 1.4, lift: float = 0.45, stride: float = 0.15) -> np.ndarray:
    """Targets of the small robot's joints in a trot, (2 legs,) [rad]: diagonal legs lift together.

    Args:
        time: [s].
        legs: How many.
        rate: Strides per second [Hz].
        lift: Bend of a lifted leg [rad].
        stride: Amplitude of the hips [rad].
    """
    result, grown = [], min(1.0, time)
    for leg in range(legs):
        phase = 2 * np.pi * (rate * time + (0.5 if leg in (1, 2) else 0.0))
        bend = 0.55 + lift * max(0.0, np.sin(phase)) * grown + 0.03 * np.sin(2 * np.pi * 0.37 * time + leg)
        result += [bend + stride * np.cos(phase) * grown, -2 * bend]
    return np.array(result)


def gait(seed: int) -> Callable[[float], np.ndarray]:
    """Targets of a trot of drawn rate, lift and stride."""
    rate, lift, stride = np.random.default_rng(seed).uniform((1.2, 0.35, 0.1), (1.8, 0.5, 0.2))
    return partial(trot, rate=rate, lift=lift, stride=stride)


@dataclass(kw_only=True)
class Hidden:
    """What drives have beside friction and inertia: a number, or one for each joint."""

    gain: np.ndarray | float = 1.0
    """Of the torque."""
    lag: np.ndarray | float = 0.0
    """Time constant of the torque [s]."""
    ripple: np.ndarray | float = 0.0
    """Amplitude of a torque that repeats over the joint's turn [N m]."""
    periods: np.ndarray | float = 1.0
    """How often it does so in a turn."""
    spring: np.ndarray | float = 0.0
    """Stiffness of a spring [N m/rad] ..."""
    rest: np.ndarray | float = 0.0
    """... and where it rests [rad]."""
    gap: np.ndarray | float = 0.0
    """Of a gear [rad]."""


_GEAR = 3000.0, 2.0
"""Stiffness [N m/rad] and damping [N m s/rad] of teeth that touch."""


@dataclass(kw_only=True)
class Plant:
    """A robot, its drives as they are, and how its base moves."""

    xml: str
    joints: tuple[str, ...]
    truth: Mapping[str, np.ndarray]
    """``armature`` [kg m²], ``viscous_friction`` [N m s/rad] and ``friction`` [N m] of each joint."""
    targets: Callable[[float], np.ndarray]
    """Positions that joints are told at a time, (n,) [rad]; of a policy, at the beginning alone."""
    policy: Callable[[float, mujoco.MjData], np.ndarray] | None = None
    """The same of a policy, which sees the simulation."""
    feet: Mapping[str, str] = field(default_factory=dict)
    """Geom of each foot, by the foot's name; none: nothing touches the ground."""
    swing: float | None = None
    """Length of the pendulum on which the base swings [m]; 0: the base is fixed; ``None``: it is free."""
    kp: float = 85.0
    kd: float = 0.6
    delay: int = 2
    """Of commands [control steps]."""
    effort_limit: float = 89.0
    hidden: Hidden = field(default_factory=Hidden)
    """What no fit knows of."""
    imu: tuple[str, tuple[float, float, float]] | None = None
    """Body and place of the IMU [m]; ``None``: the site ``imu``."""
    tilt: float = np.radians(5)
    """Of the pendulum at the beginning [rad]."""
    noise: tuple[float, float, float] = (1e-4, 2e-3, 0.03)
    """Of encoders [rad], gyroscope [rad/s] and accelerometer [m/s²]."""
    seed: int = 0

    def model(self) -> mujoco.MjModel:
        """Compile it."""
        spec = (
            mujoco.MjSpec.from_string(self.xml)
            if self.xml.lstrip().startswith("<")
            else mujoco.MjSpec.from_file(self.xml)
        )
        spec.option.timestep = STEP
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        for element in [*spec.actuators, *spec.keys, *spec.sensors]:
            spec.delete(element)
        if self.swing is not None:
            root = next(joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE)
            base = root.parent
            spec.delete(root)
            if self.swing:
                base.add_joint(name="rope", type=mujoco.mjtJoint.mjJNT_BALL, pos=[0, 0, self.swing], range=[0, 0])
        if self.imu is not None:
            spec.body(self.imu[0]).add_site(name="imu", pos=self.imu[1])
        for geom in spec.geoms:
            geom.contype, geom.conaffinity = 0, int(geom.name in self.feet.values())
        if self.feet:
            spec.worldbody.add_geom(
                name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], contype=1, conaffinity=1
            )
        else:
            spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        gaps = np.broadcast_to(self.hidden.gap, len(self.joints))
        for i, name in enumerate(self.joints):
            joint = spec.joint(name)
            joint.armature, joint.frictionloss = self.truth["armature"][i], self.truth["friction"][i]
            joint.damping[0] = self.truth["viscous_friction"][i]
            joint.solref_friction = [2 * STEP, 1.0]
            joint.solimp_friction = [0.999, 0.999, 0.001, 0.5, 2.0]
            if gaps[i]:
                loose = joint.parent.add_joint(name=f"{name}_gap", axis=joint.axis, pos=joint.pos)
                loose.armature, loose.frictionloss, loose.damping[0] = 0.0, 0.0, 0.0  # the file's default is another's
        for name, kind in (("gyro", mujoco.mjtSensor.mjSENS_GYRO), ("acc", mujoco.mjtSensor.mjSENS_ACCELEROMETER)):
            spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu")
        return spec.compile()

    def simulate(self, duration: float) -> dict[str, Any]:
        """A recording's fields."""
        model, rng = self.model(), np.random.default_rng(self.seed)
        data = mujoco.MjData(model)
        q = np.array([model.joint(name).qposadr[0] for name in self.joints])
        v = np.array([model.joint(name).dofadr[0] for name in self.joints])
        loose = np.flatnonzero(np.broadcast_to(self.hidden.gap, len(self.joints)))
        gap = np.array([model.joint(f"{self.joints[i]}_gap").id for i in loose], dtype=int)
        half = 0.5 * np.broadcast_to(self.hidden.gap, len(self.joints))[loose]
        data.qpos[q] = self.targets(0.0)
        if self.swing:
            at = model.joint("rope").qposadr[0]
            data.qpos[at : at + 4] = [
                np.cos(self.tilt / 2),
                0.6 * np.sin(self.tilt / 2),
                0.8 * np.sin(self.tilt / 2),
                0,
            ]
        elif self.swing is None:
            mujoco.mj_kinematics(model, data)
            lowest = min(data.geom(geom).xpos[2] - model.geom(geom).size[0] for geom in self.feet.values())
            data.qpos[2] -= lowest
        count, parts, n = round(duration / CONTROL), round(CONTROL / STEP), len(self.joints)
        feet = [model.geom(geom).id for geom in self.feet.values()]
        log: dict[str, Any] = {"time": np.arange(count) * CONTROL}
        for key, size in (("dof_pos", n), ("des_dof_pos", n), ("base_ang_vel", 3), ("base_lin_acc", 3)):
            log[key] = np.zeros((count, size))
        if feet:
            log["contact"], log["feet"] = np.zeros((count, len(feet)), dtype=bool), list(self.feet)
        targets, given = [self.targets(0.0)] * self.delay, np.zeros(n)
        lag = np.broadcast_to(self.hidden.lag, n)
        follows = np.where(lag > 0, -np.expm1(-STEP / np.maximum(lag, 1e-9)), 1.0)
        for k in range(count):
            mujoco.mj_forward(model, data)
            sigma = self.noise
            log["dof_pos"][k] = data.qpos[q] + sigma[0] * rng.standard_normal(n)
            log["base_ang_vel"][k] = data.sensor("gyro").data + sigma[1] * rng.standard_normal(3)
            log["base_lin_acc"][k] = data.sensor("acc").data + sigma[2] * rng.standard_normal(3)
            if feet:
                pairs = data.contact.geom[: data.ncon] if data.ncon else np.zeros((0, 2), dtype=int)
                log["contact"][k] = np.isin(feet, pairs)
            now = k * CONTROL
            log["des_dof_pos"][k] = self.targets(now) if self.policy is None else self.policy(now, data)
            targets.append(log["des_dof_pos"][k])
            torque = self.kp * (targets[k] - data.qpos[q]) - self.kd * data.qvel[v]
            held = np.clip(torque, -self.effort_limit, self.effort_limit)
            for _ in range(parts):
                given += follows * (held - given)
                data.qfrc_applied[v] = self._torque(given, data.qpos[q])
                at, dof = model.jnt_qposadr[gap], model.jnt_dofadr[gap]
                data.qfrc_applied[dof] = _teeth(data.qpos[at], data.qvel[dof], half)
                mujoco.mj_step(model, data)
        if self.imu is not None:
            log["imu"] = json.dumps({"body": self.imu[0], "pos": self.imu[1]})
        return {
            **log,
            "joint_names": list(self.joints),
            "stiffness": self.kp,
            "damping": self.kd,
            "effort_limit": self.effort_limit,
            "saturation_effort": np.inf,  # no torque-speed line
            "velocity_limit": np.inf,
        }

    def _torque(self, given: np.ndarray, position: np.ndarray) -> np.ndarray:
        """What the drives give, with what is hidden, (n,) [N m]."""
        own = self.hidden
        return own.gain * given + own.ripple * np.sin(own.periods * position) - own.spring * (position - own.rest)


def _teeth(turn: np.ndarray, speed: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Torque on links that are turned against their motors, (n,) [N m]: teeth push, and nothing acts in a gap."""
    pressed = turn - np.clip(turn, -half, half)
    torque = -_GEAR[0] * pressed - _GEAR[1] * speed
    return np.where(torque * pressed < 0, torque, 0.0)


def drawn(n: int, seed: int, scale: float = 1.0) -> dict[str, np.ndarray]:
    """Parameters of n drives, drawn; ``scale`` is that of the torques."""
    rng = np.random.default_rng(seed)
    ranges = {"armature": (0.05, 0.1), "viscous_friction": (1.2, 3.0), "friction": (0.1, 0.4)}
    return {name: scale * rng.uniform(low, high, n) for name, (low, high) in ranges.items()}


def crawler(seed: int = 0, **changes: Any) -> Plant:
    """The small robot, trotting."""
    joints = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "knee"))
    feet = {leg: f"{leg}_foot" for leg in LEGS}
    options = {"kp": 40.0, "kd": 0.5, "effort_limit": 40.0, "truth": drawn(len(joints), seed, 0.2), "feet": feet}
    return Plant(**{"xml": quadruped(), "joints": joints, "targets": trot, "seed": seed, **options, **changes})


def chirps(joints: int, top: float, duration: float) -> Callable[[float], np.ndarray]:
    """Chirps to a frequency [Hz] of legs of three joints each, as a recording in the air has them."""
    bias, scale = np.array([0.0, 0.4, 0.8]), np.array([0.25, 0.5, -2.0])

    def targets(time: float) -> np.ndarray:
        phase = 2 * np.pi * (0.1 * time + (top - 0.1) / (2 * duration) * time**2)
        legs = joints // 3
        signs = np.ones((legs, 3))
        return ((np.sin(phase) * min(1.0, 2 * time) * 0.4 + bias) * scale * signs).reshape(-1)

    return targets


def main() -> None:
    """Write a log and its truth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path, help="MJCF of ANYmal D")
    parser.add_argument("--swing", action="store_true", help="swing on a pendulum of 2 m; else the base is fixed")
    parser.add_argument("--duration", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args()
    joints = tuple(f"{leg}_{joint}" for leg in ("LF", "RF", "LH", "RH") for joint in ("HAA", "HFE", "KFE"))
    plant = Plant(
        xml=args.model.read_text(),
        joints=joints,
        truth=drawn(len(joints), args.seed),
        targets=chirps(len(joints), 10.0, args.duration),
        swing=2.0 if args.swing else 0.0,
        seed=args.seed,
    )
    fields = plant.simulate(args.duration)
    np.savez_compressed(args.output, **fields)
    truth = {name: values.tolist() for name, values in plant.truth.items()} | {"delay": plant.delay * CONTROL}
    args.output.with_suffix(".truth.json").write_text(json.dumps(truth))


if __name__ == "__main__":
    main()
