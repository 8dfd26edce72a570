"""Unitree Go2, twelve quasi-direct drives."""

from pace_actuators import PaceDCMotorCfg
from pace_envs.articulation_cfg import ArticulationCfg, InitialStateCfg
from pace_envs.assets_dir import ASSETS_DIR

GO2_JOINTS = tuple(f"{leg}_{joint}_joint" for leg in ("FL", "FR", "RL", "RR") for joint in ("hip", "thigh", "calf"))


def go2_drive_cfgs() -> dict[str, PaceDCMotorCfg]:
    """The two types of drive, hip and thigh against calf, at the gains of the published recording."""
    return {
        "hip_thigh": PaceDCMotorCfg(
            joint_names_expr=".*_(hip|thigh)_joint",
            stiffness=20.0,
            damping=1.5,
            saturation_effort=23.7,
            effort_limit=23.7,
            velocity_limit=30.1,
        ),
        "calf": PaceDCMotorCfg(
            joint_names_expr=".*_calf_joint",
            stiffness=20.0,
            damping=1.5,
            saturation_effort=45.43,
            effort_limit=45.43,
            velocity_limit=15.7,
        ),
    }


def go2_cfg() -> ArticulationCfg:
    """The robot in its standing posture."""
    return ArticulationCfg(
        mjcf_path=ASSETS_DIR / "go2" / "go2.xml",
        init_state=InitialStateCfg(
            pos=(0.0, 0.0, 0.33),
            joint_pos={
                ".*L_hip_joint": 0.1,
                ".*R_hip_joint": -0.1,
                "F._thigh_joint": 0.8,
                "R._thigh_joint": 1.0,
                ".*_calf_joint": -1.5,
            },
        ),
        actuators=go2_drive_cfgs(),
        joint_order=GO2_JOINTS,
    )
