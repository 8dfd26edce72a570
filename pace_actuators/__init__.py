"""The drive of a robot's joints, as identified: one torque law for identification and training.

Needs torch alone.
"""

from typing import TYPE_CHECKING

from pace_actuators.public_names import public_names

if TYPE_CHECKING:
    from pace_actuators.actions import ActuatorActions
    from pace_actuators.config import configclass
    from pace_actuators.dc_motor import clip_effort, pd_effort
    from pace_actuators.delay_buffer import DelayBuffer
    from pace_actuators.effects import (
        DriveState,
        Effect,
        EffectCfg,
        EffectParameter,
        available_effects,
        get_effect,
        register_effect,
    )
    from pace_actuators.identified import IdentifiedAt, IdentifiedDrives
    from pace_actuators.joint_values import JointValue, match_names, resolve_joint_values
    from pace_actuators.pace_dc_motor import PaceDCMotor
    from pace_actuators.pace_dc_motor_cfg import PaceDCMotorCfg
    from pace_actuators.public_names import deprecated

__all__ = [
    "ActuatorActions",
    "DelayBuffer",
    "DriveState",
    "Effect",
    "EffectCfg",
    "EffectParameter",
    "IdentifiedAt",
    "IdentifiedDrives",
    "JointValue",
    "PaceDCMotor",
    "PaceDCMotorCfg",
    "available_effects",
    "clip_effort",
    "configclass",
    "deprecated",
    "get_effect",
    "match_names",
    "pd_effort",
    "register_effect",
    "resolve_joint_values",
]

__getattr__ = public_names(__file__)
