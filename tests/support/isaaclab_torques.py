"""Run in a process of its own: our Isaac Lab adapter under the actuator base classes of Isaac Lab's wheel.

    python tests/support/isaaclab_torques.py <unpacked wheel> <output.npz> <result.json> <configuration.py>

Isaac Sim is not needed for those; ``omni`` and what else they import of it are empty modules.
"""

from __future__ import annotations

import sys
import types
from pathlib import Path

import numpy as np
import torch
from places import ROOT
from torque_sequence import DT, ENVS, JOINTS, sequence


def load_isaaclab(wheel: Path) -> None:
    """Make ``isaaclab.actuators`` and ``isaaclab.utils`` importable without what starts the simulator."""
    source = wheel / "isaaclab" / "source" / "isaaclab" / "isaaclab"

    def module(name: str, path: Path | None = None) -> types.ModuleType:
        made = types.ModuleType(name)
        if path is not None:
            made.__path__ = [str(path)]
        sys.modules[name] = made
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, made)
        return made

    module("isaaclab", source)
    module("warp").array = type("array", (), {})  # type: ignore[attr-defined]
    omni = module("omni")
    log = module("omni.log")
    log.warn = log.info = print  # type: ignore[attr-defined]
    omni.log = log  # type: ignore[attr-defined]
    utils = module("isaaclab.utils", source / "utils")
    module("isaaclab.utils.assets").read_file = None  # type: ignore[attr-defined]
    from isaaclab.utils import buffers, interpolation, string
    from isaaclab.utils import types as action_types
    from isaaclab.utils.configclass import configclass

    utils.configclass = configclass  # type: ignore[attr-defined]
    utils.DelayBuffer = buffers.DelayBuffer  # type: ignore[attr-defined]
    utils.LinearInterpolation = interpolation.LinearInterpolation  # type: ignore[attr-defined]
    utils.string, utils.types = string, action_types  # type: ignore[attr-defined]


def build(cfg, **changes):
    """As ``Articulation._process_actuators_cfg`` builds an actuator."""
    zeros = torch.zeros(ENVS, len(JOINTS))
    given = {
        "stiffness": zeros,
        "damping": zeros,
        "armature": zeros,
        "friction": zeros,
        "dynamic_friction": zeros,
        "viscous_friction": zeros,
        "effort_limit": zeros + 200.0,
        "velocity_limit": zeros + 20.0,
    }
    return cfg.class_type(
        cfg=cfg, joint_names=list(JOINTS), joint_ids=slice(None), num_envs=ENVS, device="cpu", **given | changes
    )


def efforts(actuator, data, offset=0.0) -> np.ndarray:
    """As ``Articulation._apply_actuator_model`` runs it; (steps, envs, joints)."""
    from isaaclab.utils.types import ArticulationActions

    actuator.reset(slice(None))
    result = []
    for command, position, velocity in zip(data["command"], data["position"], data["velocity"], strict=True):
        tensors = [torch.tensor(x, dtype=torch.float32) for x in (command + offset, position, velocity)]
        zeros = torch.zeros_like(tensors[0])
        action = ArticulationActions(tensors[0], zeros.clone(), zeros.clone(), slice(None))
        result.append(actuator.compute(action, joint_pos=tensors[1], joint_vel=tensors[2]).joint_efforts.numpy().copy())
    return np.stack(result)


class FakeArticulation:
    """What ``DriveFrictionMixin`` finds in Isaac Lab's articulation, as far as the drives see it."""

    def __init__(self, actuator):
        self.actuators = {"legs": actuator}
        self.num_joints = len(JOINTS)
        self.root_physx_view = self
        self.applied, self.friction = 0, None

    def get_gravity_compensation_forces(self):
        return torch.ones(ENVS, 6 + len(JOINTS))

    def get_coriolis_and_centrifugal_compensation_forces(self):
        return torch.ones(ENVS, 6 + len(JOINTS))

    def _apply_actuator_model(self):
        self.applied += 1

    def write_joint_friction_coefficient_to_sim(
        self, joint_friction_coeff, joint_dynamic_friction_coeff=None, joint_viscous_friction_coeff=None, joint_ids=None
    ):
        self.friction = (joint_friction_coeff, joint_dynamic_friction_coeff, joint_viscous_friction_coeff, joint_ids)


def adapter(cfg, data) -> dict[str, np.ndarray]:
    """Our drive in Isaac Lab."""
    from pace_actuators.isaaclab import DriveFrictionMixin

    cfg.validate()
    actuator = build(cfg.copy())
    robot = type("Articulation", (DriveFrictionMixin, FakeArticulation), {})(actuator)
    robot._apply_actuator_model()
    out = {"torque": efforts(actuator, data), "friction": actuator.motor.joint_friction.numpy().copy()}
    out["armature"], out["viscous"] = actuator.armature.numpy(), actuator.viscous_friction.numpy()
    assert actuator.stiffness is actuator.motor.stiffness
    robot._write_friction()
    return out | {"written_friction": robot.friction[0].numpy(), "applied": robot.applied}


def main(wheel: str, output: str, result: str, configuration: str) -> None:
    load_isaaclab(Path(wheel))
    from isaaclab.actuators import DCMotorCfg, DelayedPDActuatorCfg

    from pace_actuators import PaceDCMotorCfg
    from pace_actuators.isaaclab import DriveFrictionMixin, PaceDCMotorActuatorCfg

    data, space = sequence(), {}
    exec(Path(configuration).read_text(), space)
    found = {
        "command": adapter(PaceDCMotorActuatorCfg.from_result(result, physics_dt=DT), data),
        "effort": adapter(space["ACTUATORS"]["legs"], data),
    }
    out: dict = {f"{mode}_{name}": value for mode, values in found.items() for name, value in values.items()}
    motor = PaceDCMotorCfg(joint_names_expr=".*", physics_dt=DT, effects=("load_dependent_friction",))
    loaded = build(PaceDCMotorActuatorCfg(motor=motor))
    type("Articulation", (DriveFrictionMixin, FakeArticulation), {})(loaded)._apply_actuator_model()
    out["load"] = loaded.motor.effects.state.load_effort.numpy()

    # against Isaac Lab's own actuators, with what they have too
    plain = {"stiffness": 85.0, "damping": 0.6, "effort_limit": 89.0}
    ours = PaceDCMotorCfg(joint_names_expr=".*", **plain, max_delay=4.0)
    out["ours_delayed"] = efforts(build(PaceDCMotorActuatorCfg(motor=ours)), data)
    theirs = DelayedPDActuatorCfg(joint_names_expr=[".*"], **plain, min_delay=4, max_delay=4)
    out["theirs_delayed"] = efforts(build(theirs), data)
    curve = {"saturation_effort": 140.0, "velocity_limit": 8.5}
    bias = 0.07
    ours = PaceDCMotorCfg(joint_names_expr=".*", **plain, **curve, encoder_bias=bias)
    out["ours_biased"] = efforts(build(PaceDCMotorActuatorCfg(motor=ours)), data)
    theirs = DCMotorCfg(joint_names_expr=[".*"], **plain, **curve)
    out["theirs_biased"] = efforts(build(theirs), data, offset=bias)  # a target of the encoder is q* + bias
    continuous = build(PaceDCMotorActuatorCfg(motor=PaceDCMotorCfg(joint_names_expr=".*", **plain, implicit=True)))
    try:
        efforts(continuous, data)
        out["unwritten"] = ""
    except ValueError as error:
        out["unwritten"] = str(error)
    try:
        build(PaceDCMotorActuatorCfg(motor=ours, stiffness=1.0))
        out["refused"] = ""
    except ValueError as error:
        out["refused"] = str(error)
    np.savez(output, **out)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    main(*sys.argv[1:])
