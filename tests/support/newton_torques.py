"""Run by the Python of an environment with Newton: the exported page on a model of Newton's, and in a USD stage.

python tests/support/newton_torques.py <drives.py> <output.npz>
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from torque_sequence import DT, ENVS, JOINTS, sequence


def robot():
    """A chain of the joints on a floating base, so that positions and speeds have different places."""
    import newton

    builder = newton.ModelBuilder()
    body = builder.add_link(mass=1.0)
    joints = [builder.add_joint_free(child=body)]
    for name in JOINTS:
        child = builder.add_link(mass=1.0)
        joints.append(builder.add_joint_revolute(parent=body, child=child, axis=(0, 1, 0), label=f"robot/{name}"))
        body = child
    builder.add_articulation(joints)
    return builder


def torques(builder) -> np.ndarray:
    """On the sequence, (steps, envs, joints)."""
    import newton

    whole = newton.ModelBuilder()
    for _ in range(ENVS):
        whole.add_world(builder)
    model = whole.finalize(device="cpu")
    state, control = model.state(), model.control()
    before = [actuator.state() for actuator in model.actuators]
    after = [actuator.state() for actuator in model.actuators]
    data, result = sequence(), []
    nq, nv = len(JOINTS) + 7, len(JOINTS) + 6
    for command, position, velocity in zip(data["command"], data["position"], data["velocity"], strict=True):

        def full(values, width):
            padded = np.zeros((ENVS, width), dtype=np.float32)
            padded[:, -len(JOINTS) :] = values
            return padded.ravel()

        state.joint_q.assign(full(position, nq))
        state.joint_qd.assign(full(velocity, nv))
        control.joint_target_q.assign(full(command, nq))
        control.joint_f.zero_()
        for i, actuator in enumerate(model.actuators):
            actuator.step(state, control, before[i], after[i], dt=DT)
            before[i], after[i] = after[i], before[i]
        result.append(control.joint_f.numpy().reshape(ENVS, nv)[:, -len(JOINTS) :].copy())
    own = slice(-len(JOINTS), None)
    fields = {"armature": model.joint_armature, "friction": model.joint_friction, "damping": model.joint_damping}
    return np.stack(result), {name: value.numpy()[own].copy() for name, value in fields.items()}


def stage(names=JOINTS):
    """The same chain in USD, with an actuator on one joint that has to go."""
    from pxr import Gf, Usd, UsdGeom, UsdPhysics

    made = Usd.Stage.CreateInMemory()
    root = UsdGeom.Xform.Define(made, "/World/robot").GetPrim()
    made.SetDefaultPrim(made.GetPrimAtPath("/World"))
    UsdPhysics.ArticulationRootAPI.Apply(root)

    def body(name):
        prim = UsdGeom.Xform.Define(made, f"/World/robot/{name}").GetPrim()
        UsdPhysics.RigidBodyAPI.Apply(prim)
        mass = UsdPhysics.MassAPI.Apply(prim)
        mass.CreateMassAttr(1.0)
        mass.CreateDiagonalInertiaAttr(Gf.Vec3f(0.1, 0.1, 0.1))
        return prim.GetPath()

    last = body("base")
    for name in names:
        link = body(f"{name}_link")
        joint = UsdPhysics.RevoluteJoint.Define(made, f"/World/robot/{name}")
        joint.CreateBody0Rel().SetTargets([last])
        joint.CreateBody1Rel().SetTargets([link])
        joint.CreateAxisAttr("Y")
        last = link
    old = made.DefinePrim("/World/robot/old", "NewtonActuator")
    old.CreateRelationship("newton:targets").SetTargets([f"/World/robot/{names[0]}"])
    return made


def main(page: str, output: str) -> None:
    import newton
    import warp as wp

    wp.config.enable_backward = False  # less to compile
    space: dict = {}
    exec(Path(page).read_text(), space)
    out = {}
    for name, other in (("add_actuators", newton.ModelBuilder()), ("author_usd", stage(JOINTS[1:]))):
        try:
            space[name](other)
        except ValueError as error:
            out[f"{name}_refused"] = str(error)
    builder = robot()
    space["add_actuators"](builder)
    out["torque"], fields = torques(builder)
    out |= fields
    made = stage()
    space["author_usd"](made, "/World/robot")
    builder = newton.ModelBuilder()
    builder.add_usd(made)
    out["usd_torque"], fields = torques(builder)
    out |= {f"usd_{name}": value for name, value in fields.items()}
    np.savez(output, **out)


if __name__ == "__main__":
    main(*sys.argv[1:])
