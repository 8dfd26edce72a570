"""Text of the page that ``export --format mjlab_native`` writes: its head holds the values, the rest stands here.

The page needs mjlab alone, so nothing of this project is imported.
"""

# mypy: allow-untyped-defs, allow-incomplete-defs

from __future__ import annotations

from typing import Any

PHYSICS_DT: float = 0.0
ACTUATORS: tuple[Any, ...] = ()
ENCODER_BIAS: dict[str, float] = {}
SOFT_FRICTION: dict[str, tuple[float, float]] = {}
BESIDE: dict[str, dict[str, float]] = {}
EventTermCfg: Any = dict
SceneEntityCfg: Any = dict
dr: Any = type("dr", (), {"encoder_bias": None})

# --- the page starts here

EVENTS = {
    f"encoder_bias_{joint}": EventTermCfg(
        func=dr.encoder_bias,
        mode="startup",
        params={"bias_range": (bias, bias), "asset_cfg": SceneEntityCfg("robot", joint_names=(joint,))},
    )
    for joint, bias in ENCODER_BIAS.items()
}
"""For the environment's events, in place of an encoder_bias of yours; the robot's name in the scene is robot."""


def write_joints(spec):
    """Give the joints what no actuator of mjlab has: springs, and Coulomb friction as hard as it was found.

    The friction's solver parameters are those of the identification.

    Args:
        spec: The mujoco.MjSpec that your spec_fn returns; it is changed.
    """
    import math

    for joint in spec.joints:
        constant, impedance = SOFT_FRICTION.get(joint.name, (2 * PHYSICS_DT, 0.999))
        joint.solref_friction = [constant, 1.0]
        joint.solimp_friction = [impedance, impedance, 0.001, 0.5, 2.0]
        beside = BESIDE.get(joint.name)
        if beside:
            unit = math.degrees(1.0) if spec.compiler.degree and joint.type.name == "mjJNT_HINGE" else 1.0
            before, both = joint.stiffness[0], joint.stiffness[0] + beside["spring"]
            joint.springref = (before * joint.springref + beside["spring"] * beside["rest"] * unit) / (both or 1.0)
            joint.stiffness[0], joint.damping[1] = both, beside["quadratic"]
