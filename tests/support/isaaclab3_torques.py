"""Run in a process of its own: our Isaac Lab adapter in the actuator collection of Isaac Lab 3.0's wheel.

    python tests/support/isaaclab3_torques.py <unpacked wheel> <output.npz> <result.json> <configuration.py>

The result's drive, and the configuration that ``export --format isaaclab`` writes.

The collection, its control bridge and its Warp kernels are the wheel's; the articulation that they act on is a fake.
"""

from __future__ import annotations

import functools
import re
import sys
import types
import warnings
from pathlib import Path

import numpy as np
import torch
from places import ROOT
from torque_sequence import DT, ENVS, JOINTS, sequence

ORDER = tuple(sorted(JOINTS))
"""The fake articulation's joints, in another order than the result's."""


def load_isaaclab(wheel: Path) -> None:
    """Make ``isaaclab`` importable without what its ``__init__`` starts."""
    made = types.ModuleType("isaaclab")
    made.__path__ = [str(wheel / "isaaclab")]
    sys.modules["isaaclab"] = made


class Articulation:
    """What the wheel's ``ArticulationActuatorControl`` asks of an articulation, as far as actuators see it."""

    num_instances, num_joints, num_fixed_tendons, device = ENVS, len(ORDER), 0, "cpu"

    def __init__(self):
        import warp as wp
        from isaaclab.utils.warp import ProxyArray

        def array(value=0.0, extra=0):
            return ProxyArray(wp.full((ENVS, len(ORDER) + extra), value, dtype=wp.float32, device="cpu"))

        names = ("pos", "vel", "stiffness", "damping", "armature", "friction_coeff")
        self.data = types.SimpleNamespace(**{f"joint_{name}": array() for name in names})
        self.data.default_joint_pos = array()
        self.data.joint_effort_limits, self.data.joint_vel_limits = array(10.0), array(20.0)  # the asset's own
        self.data.gravity_compensation_forces = array(2.0, extra=6)
        self.written: dict[str, torch.Tensor] = {}

    def find_joints(self, expressions, as_proxy=True):
        import warp as wp
        from isaaclab.utils.warp import ProxyArray

        expressions = [expressions] if isinstance(expressions, str) else expressions
        found = [i for i, name in enumerate(ORDER) if any(re.fullmatch(e, name) for e in expressions)]
        return ProxyArray(wp.array(found, dtype=wp.int32)), [ORDER[i] for i in found]

    def _resolve_env_ids(self, ids):
        import warp as wp

        return wp.array(list(range(ENVS)) if ids is None else ids, dtype=wp.int32)

    def _resolve_joint_ids(self, ids):
        import warp as wp

        return wp.array(list(range(len(ORDER))) if ids is None else ids, dtype=wp.int32)

    def assert_shape_and_dtype(self, *args):
        pass

    def __getattr__(self, name):
        if not (name.startswith("write_joint_") and name.endswith("_to_sim_index")):
            raise AttributeError(name)
        return functools.partial(self._write, name.removeprefix("write_joint_").removesuffix("_to_sim_index"))

    def _write(self, field, joint_ids=None, **values):
        for name, value in values.items():
            name = field if name == "limits" else name
            value = torch.as_tensor(value).expand(ENVS, len(ORDER))  # one group of all joints
            self.written[name] = value.clone()

    def write_data_to_sim(self):
        """The part of Isaac Lab's own that runs actuators."""
        self.actuators.compute(DT)
        self.actuators.submit_commands()


def build(cfgs, *bases):
    """An articulation whose actuators are built as Isaac Lab's own builds them."""
    from isaaclab.actuators import ActuatorCollection
    from isaaclab.actuators.actuator_control import ArticulationActuatorControl

    class Control(ArticulationActuatorControl):
        def submit_commands(self, collection):
            self._articulation.effort = collection.output_command.effort.torch.clone()

    robot = type("Robot", (*bases, Articulation), {})()
    robot.actuators = ActuatorCollection(cfgs, Control(robot))
    return robot


def efforts(robot, data, offset=0.0) -> np.ndarray:
    """(steps, envs, joints), in the order of JOINTS."""
    there = [JOINTS.index(name) for name in ORDER]
    back = [ORDER.index(name) for name in JOINTS]
    robot.actuators.reset()
    result = []
    for command, position, velocity in zip(data["command"], data["position"], data["velocity"], strict=True):
        for array, value in ((robot.data.joint_pos, position), (robot.data.joint_vel, velocity)):
            array.torch.copy_(torch.tensor(value[:, there], dtype=torch.float32))
        value = torch.tensor(command[:, there] + offset, dtype=torch.float32)
        robot.actuators.target_command.set_position_index(value=value)
        robot.write_data_to_sim()
        result.append(robot.effort.numpy()[:, back].copy())
    return np.stack(result)


def written(robot, name) -> np.ndarray:
    return robot.written[name].numpy()[:, [ORDER.index(joint) for joint in JOINTS]]


def adapter(cfgs, data) -> dict:
    """Our drive in Isaac Lab."""
    from isaaclab.sim.schemas.schemas_actuators import validate_newton_native_actuator_cfgs
    from isaaclab.utils import configclass

    from pace_actuators.isaaclab import DriveFrictionMixin, encoder_pos_rel

    @configclass
    class SceneCfg:  # Isaac Lab copies configurations that lie in others
        actuators: dict = cfgs

    copied = SceneCfg()
    copied.validate()
    robot = build(copied.actuators, DriveFrictionMixin)
    names = {"limit": "effort_limit", "armature": "armature", "viscous": "joint_viscous_friction_coeff"}
    out: dict = {name: written(robot, field) for name, field in names.items()}
    out["friction_at_rest"] = written(robot, "joint_friction_coeff")
    out["torque"] = efforts(robot, data)
    out["friction"] = written(robot, "joint_friction_coeff")
    env = types.SimpleNamespace(scene={"robot": robot})
    shown = encoder_pos_rel(env).numpy()[:, [ORDER.index(joint) for joint in JOINTS]]
    out["shown"] = shown - data["position"][-1]
    try:
        validate_newton_native_actuator_cfgs(copied.actuators)
        out["native"] = ""
    except ValueError as error:
        out["native"] = str(error)
    return out


def main(wheel: str, output: str, result: str, configuration: str) -> None:
    load_isaaclab(Path(wheel))
    warnings.simplefilter("error", DeprecationWarning)
    from isaaclab.actuators import DCMotorCfg, DelayedPDActuatorCfg

    from pace_actuators import PaceDCMotorCfg
    from pace_actuators.isaaclab import DriveFrictionMixin, PaceDCMotorActuatorCfg

    data, space = sequence(), {}
    exec(Path(configuration).read_text(), space)
    found = {
        "command": adapter({"legs": PaceDCMotorActuatorCfg.from_result(result, physics_dt=DT)}, data),
        "effort": adapter(space["ACTUATORS"], data),
    }
    out: dict = {f"{mode}_{name}": value for mode, values in found.items() for name, value in values.items()}
    motor = PaceDCMotorCfg(joint_names_expr=".*", physics_dt=DT, effects=("load_dependent_friction",))
    loaded = build({"legs": PaceDCMotorActuatorCfg(motor=motor)}, DriveFrictionMixin)
    loaded.write_data_to_sim()
    out["load"] = loaded.actuators["legs"].motor.effects.state.load_effort.numpy()

    # against Isaac Lab's own actuators, with what they have too
    warnings.simplefilter("ignore", DeprecationWarning)  # "Isaac Lab execution of explicit actuator models"
    plain = {"stiffness": 85.0, "damping": 0.6}
    ours = PaceDCMotorCfg(joint_names_expr=".*", **plain, effort_limit=89.0, delay=4.0)
    out["ours_delayed"] = efforts(build({"legs": PaceDCMotorActuatorCfg(motor=ours)}), data)
    theirs = DelayedPDActuatorCfg(
        joint_names_expr=[".*"], **plain, actuator_effort_limit=89.0, min_delay=4, max_delay=4
    )
    out["theirs_delayed"] = efforts(build({"legs": theirs}), data)
    bias = 0.07
    curve = {"saturation_effort": 140.0}
    ours = PaceDCMotorCfg(
        joint_names_expr=".*", **plain, **curve, effort_limit=89.0, velocity_limit=8.5, encoder_bias=bias
    )
    out["ours_biased"] = efforts(build({"legs": PaceDCMotorActuatorCfg(motor=ours)}), data)
    theirs = DCMotorCfg(
        joint_names_expr=[".*"], **plain, **curve, actuator_effort_limit=89.0, actuator_velocity_limit=8.5
    )
    out["theirs_biased"] = efforts(build({"legs": theirs}), data, offset=bias)  # a target of the encoder is q* + bias
    refused = []
    for beside in ({"armature": 0.1}, {"stiffness": 1.0}):
        try:
            build({"legs": PaceDCMotorActuatorCfg(motor=PaceDCMotorCfg(joint_names_expr=".*", armature=0.2), **beside)})
        except ValueError as error:
            refused.append(str(error))
    out["refused"] = " | ".join(refused)
    np.savez(output, **out)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    main(*sys.argv[1:])
