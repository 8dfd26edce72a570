"""Text of the page that ``export --format newton`` writes: its head holds the values, the functions stand here.

The page needs Newton alone, so nothing of this project is imported.
"""

# mypy: allow-untyped-defs, allow-incomplete-defs

from __future__ import annotations

from typing import Any

PHYSICS_DT: float = 0.0
JOINTS: dict[str, dict[str, float]] = {}
DRIVES: dict[str, dict[str, Any]] = {}

# --- the page starts here


def add_actuators(builder, dt=PHYSICS_DT):
    """Give the joints of a newton.ModelBuilder their drives; each is found by the last part of its label.

    Args:
        builder: The model so far; robots that are copied later take their drives along.
        dt: Time between two steps of the actuators [s].
    """
    from newton.actuators import ClampingDCMotor, ClampingMaxEffort, DrivePD

    ends = [*builder.joint_qd_start[1:], len(builder.joint_armature)]
    found = [next((n for n in DRIVES if label == n or label.endswith("/" + n)), None) for label in builder.joint_label]
    refuse_missing(found, "label")
    places = zip(found, builder.joint_label, builder.joint_q_start, builder.joint_qd_start, ends, strict=True)
    for name, label, q, v, end in places:
        if name is None:
            continue
        if end - v != 1:
            raise ValueError(f"The joint {label} has {end - v} degrees of freedom, expected 1.")
        drive, steps = DRIVES[name], delay_steps(name, dt)
        for parameter, value in JOINTS[name].items():
            getattr(builder, "joint_" + parameter)[q if parameter == "rest_q" else v] = value
        builder.joint_target_ke[v] = builder.joint_target_kd[v] = 0.0  # the solver's own drive
        motor = {key: drive[key] for key in ("saturation_effort", "velocity_limit", "max_motor_effort") if key in drive}
        box = {key: drive[key] for key in ("max_effort",) if key in drive}
        clamps = ((ClampingDCMotor, motor), (ClampingMaxEffort, box))
        clamping = [(kind, values) for kind, values in clamps if values]
        law = {key: drive[key] for key in ("kp", "kd", "const_effort")}
        builder.add_actuator(DrivePD, index=v, pos_index=q, clamping=clamping, delay_steps=steps or None, **law)


def author_usd(stage, root="/", dt=PHYSICS_DT):
    """Write the drives into a USD stage: NewtonActuator prims under the robot, NewtonJointAPI on its joints.

    Args:
        stage: The robot's pxr.Usd.Stage; what it had at these joints is replaced.
        root: Path of the robot's prim.
        dt: Time between two steps of the actuators [s].
    """
    import math

    from pxr import Sdf, Usd

    def apply(prim, schemas, values):
        names = prim.GetMetadata("apiSchemas") or Sdf.TokenListOp()
        names.prependedItems = [*(s for s in names.prependedItems if s not in schemas), *schemas]
        prim.SetMetadata("apiSchemas", names)
        for name, value in values.items():
            kind = Sdf.ValueTypeNames.Int if isinstance(value, int) else Sdf.ValueTypeNames.Float
            prim.CreateAttribute("newton:" + name, kind).Set(value)

    joints = ("PhysicsRevoluteJoint", "PhysicsPrismaticJoint")
    prims = list(Usd.PrimRange(stage.GetPrimAtPath(root)))
    found = {p.GetName(): p for p in prims if p.GetTypeName() in joints and p.GetName() in DRIVES}
    refuse_missing(found, "name")
    paths = {prim.GetPath() for prim in found.values()}
    for prim in prims:
        if prim.GetTypeName() == "NewtonActuator" and paths & set(prim.GetRelationship("newton:targets").GetTargets()):
            prim.SetActive(False)
    for name, joint in found.items():
        per = math.radians(1.0) if joint.GetTypeName() == joints[0] else 1.0  # angular attributes of joints: degrees
        own = {k: v for k, v in JOINTS[name].items() if k not in ("stiffness", "rest_q")}
        apply(joint, ["NewtonJointAPI"], {k: v * per if k == "damping" else v for k, v in own.items()})
        drive, steps = DRIVES[name], delay_steps(name, dt)
        schemas = ["NewtonPDControlAPI"]
        values = {"kp": drive["kp"], "kd": drive["kd"], "constEffort": drive["const_effort"]}
        if "saturation_effort" in drive:
            schemas.append("NewtonDCMotorClampingAPI")
            values |= {"saturationEffort": drive["saturation_effort"], "velocityLimit": drive["velocity_limit"]}
            values |= {"maxMotorEffort": drive["max_motor_effort"]} if "max_motor_effort" in drive else {}
        elif "max_effort" in drive:
            schemas.append("NewtonMaxEffortClampingAPI")
            values["maxEffort"] = drive["max_effort"]
        if steps:
            schemas.append("NewtonActuatorDelayAPI")
            values["delaySteps"] = steps
        parent = stage.GetPrimAtPath(root).GetPath()
        actuator = stage.DefinePrim(parent.AppendChild(name + "_drive"), "NewtonActuator")
        actuator.CreateRelationship("newton:targets").SetTargets([joint.GetPath()])
        apply(actuator, schemas, values)


def refuse_missing(found, what):
    """A joint that is not found would move without its drive."""
    missing = [name for name in DRIVES if name not in found]
    if missing:
        raise ValueError(f"No joint of the model has the {what} {', '.join(missing)}. Rename it, or change DRIVES.")


def delay_steps(name, dt):
    """Newton delays by whole steps of the actuators: the nearest number."""
    return round(DRIVES[name]["delay_s"] / dt)
