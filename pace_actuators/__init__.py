"""The drive of a robot's joints, as identified: one torque law for identification and training.

Needs torch alone.
"""

from pace_actuators.actions import ActuatorActions
from pace_actuators.config import configclass
from pace_actuators.dc_motor import clip_effort, pd_effort
from pace_actuators.delay_buffer import DelayBuffer
from pace_actuators.identified import IdentifiedAt, IdentifiedDrives
from pace_actuators.joint_values import JointValue, match_names, resolve_joint_values
from pace_actuators.pace_dc_motor import PaceDCMotor
from pace_actuators.pace_dc_motor_cfg import PaceDCMotorCfg

__all__ = [
    "ActuatorActions",
    "DelayBuffer",
    "IdentifiedAt",
    "IdentifiedDrives",
    "JointValue",
    "PaceDCMotor",
    "PaceDCMotorCfg",
    "clip_effort",
    "configclass",
    "match_names",
    "pd_effort",
    "resolve_joint_values",
]
