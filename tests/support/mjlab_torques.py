"""Run by the Python of mjlab's own environment: our adapter in an entity of mjlab, stepped by hand.

    python tests/support/mjlab_torques.py <robot.xml> <output.npz> <result.json> <configuration.py> <native.py>

The result's drive, the configuration that ``export --format mjlab`` writes, and that of ``mjlab_native``.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import mujoco
import numpy as np
import torch
from places import ROOT
from torque_sequence import DT, ENVS, JOINTS, sequence


class World:
    """One mjlab entity and its simulation, and mjlab's own position action on it."""

    def __init__(self, robot: str, *actuators, expand: bool = True, change=lambda spec: None):
        from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
        from mjlab.envs.mdp.actions import JointPositionActionCfg
        from mjlab.sim import MujocoCfg, Simulation, SimulationCfg

        def spec() -> mujoco.MjSpec:
            made = mujoco.MjSpec.from_file(robot)
            for element in [*made.actuators, *made.keys, *made.sensors]:
                made.delete(element)
            for joint in made.joints:
                if joint.type == mujoco.mjtJoint.mjJNT_FREE:
                    made.delete(joint)
            change(made)
            return made

        self.entity = EntityCfg(spec_fn=spec, articulation=EntityArticulationInfoCfg(actuators=actuators)).build()
        self.model = self.entity.compile()
        self.sim = Simulation(
            ENVS, SimulationCfg(mujoco=MujocoCfg(timestep=DT, disableflags=("contact",))), self.model, device="cpu"
        )
        self.entity.initialize(self.sim.mj_model, self.sim.model, self.sim.data, "cpu")
        if expand:
            self.sim.expand_model_fields(("dof_frictionloss", "dof_damping"))
        self.scene = {"robot": self.entity}
        self.num_envs, self.device = ENVS, "cpu"
        cfg = JointPositionActionCfg(
            entity_name="robot", actuator_names=(".*",), scale=1.0, use_default_offset=False, preserve_order=True
        )
        self.action = cfg.build(self)
        self.order = [JOINTS.index(name) for name in self.entity.joint_names]

    def run(self, data, spurious: bool = False) -> np.ndarray:
        """Torques on the sequence, (steps, envs, joints)."""
        self.entity.reset()
        result = []
        for k in range(len(data["command"])):
            command, position, velocity = (
                torch.tensor(data[name][k], dtype=torch.float32) for name in ("command", "position", "velocity")
            )
            self.entity.write_joint_state_to_sim(position[:, self.order], velocity[:, self.order])
            names = self.action.target_names
            self.action.process_actions(command[:, [JOINTS.index(name) for name in names]])
            if spurious and (k == 0 or k % 7 == 3):  # as mjlab's environments do when they reset some robots
                self.entity.reset(torch.arange(ENVS) if k == 0 else torch.tensor([], dtype=torch.long))
                self.entity.write_data_to_sim()
            self.action.apply_actions()
            self.entity.write_data_to_sim()
            ctrl = self.sim.data.ctrl[:].clone()
            torque = torch.zeros(ENVS, len(JOINTS))
            for i in range(self.model.nu):
                torque[:, JOINTS.index(self.model.actuator(i).name)] = ctrl[:, i]
            result.append(torque.numpy())
            self.entity.update(DT)
        return np.stack(result)

    def dofs(self, field: str) -> np.ndarray:
        """A field of the model in the order of JOINTS, (envs or 1, joints)."""
        columns = [int(self.model.joint(name).dofadr[0]) for name in JOINTS]
        return np.asarray(getattr(self.sim.model, field)[:])[:, columns]


def page(path: str) -> dict:
    """Names of an exported page."""
    space: dict = {}
    exec(Path(path).read_text(), space)
    return space


def joints_of(world: World) -> dict[str, np.ndarray]:
    """What the model's joints hold."""
    fields = {"friction": "frictionloss", "armature": "armature", "viscous": "damping", "solref": "solref"}
    found = {name: world.dofs(f"dof_{field}") for name, field in fields.items()}
    return found | {"bias": world.entity.data.encoder_bias.numpy()[:, np.argsort(world.order)]}


def adapter(robot: str, cfgs, data) -> dict[str, np.ndarray]:
    """Our drive in mjlab."""
    world = World(robot, *cfgs)
    out = {"torque": world.run(data)} | joints_of(world)
    out["spurious"] = World(robot, *cfgs).run(data, spurious=True)
    world.sim.forward()
    columns = [int(world.model.joint(name).dofadr[0]) for name in JOINTS]
    return out | {"applied": np.asarray(world.sim.data.qfrc_actuator[:])[:, columns]}


def native(robot: str, space: dict, data) -> dict[str, np.ndarray]:
    """mjlab's own drive, with the values that were identified."""
    world = World(robot, *space["ARTICULATION"].actuators, change=space["write_joints"])
    for event in space["EVENTS"].values():
        event.params["asset_cfg"].resolve(world.scene)
        event.func(world, None, **event.params)
    return {"torque": world.run(data)} | joints_of(world)


def main(robot: str, output: str, result: str, configuration: str, native_page: str) -> None:
    from mjlab.actuator import DcMotorActuatorCfg

    from pace_actuators import PaceDCMotorCfg
    from pace_actuators.mjlab import PaceDCMotorActuatorCfg, drive_friction_event

    data = sequence()
    drives = (PaceDCMotorActuatorCfg.from_result(result),)
    found = {
        "command": adapter(robot, drives, data),
        "effort": adapter(robot, page(configuration)["ARTICULATION"].actuators, data),
        "native": native(robot, page(native_page), data),
    }
    out: dict = {f"{which}_{name}": value for which, values in found.items() for name, value in values.items()}
    assert drive_friction_event().func.model_fields == ("dof_frictionloss", "dof_damping")
    try:
        World(robot, *drives, expand=False).run(data)
        out["unexpanded"] = ""
    except ValueError as error:
        out["unexpanded"] = str(error)

    # against mjlab's own DC motor, with what it has too: a whole delay of the command, and its encoder bias
    plain = {"stiffness": 85.0, "damping": 0.6, "effort_limit": 89.0, "saturation_effort": 140.0, "velocity_limit": 8.5}
    bias = 0.07
    ours = PaceDCMotorCfg(joint_names_expr=".*", **plain, max_delay=4.0, encoder_bias=bias, drive_dt=DT)
    out["ours"] = World(robot, PaceDCMotorActuatorCfg(motor=ours)).run(data)
    theirs = World(robot, DcMotorActuatorCfg(target_names_expr=(".*",), **plain, delay_min_lag=4, delay_max_lag=4))
    theirs.entity.data.encoder_bias[:] = -bias
    out["theirs"] = theirs.run(data)
    try:
        PaceDCMotorActuatorCfg(motor=ours, armature=0.1)
        out["refused"] = ""
    except ValueError as error:
        out["refused"] = str(error)
    try:
        World(robot, PaceDCMotorActuatorCfg(motor=dataclasses.replace(ours, encoder_bias=float("nan"))))
        out["no_bias"] = ""
    except ValueError as error:
        out["no_bias"] = str(error)
    np.savez(output, **out)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    main(*sys.argv[1:])
