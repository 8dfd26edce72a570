"""ANYmal D (ANYbotics), twelve series-elastic drives treated as DC motors."""

from pace_actuators import PaceDCMotorCfg
from pace_envs.articulation_cfg import ArticulationCfg, InitialStateCfg
from pace_envs.assets_dir import ASSETS_DIR

ANYMAL_D_JOINTS = tuple(f"{leg}_{joint}" for leg in ("LF", "RF", "LH", "RH") for joint in ("HAA", "HFE", "KFE"))


def anymal_d_drive_cfg() -> PaceDCMotorCfg:
    """The drive of every joint, with the gains and limits of PACE's reference case."""
    return PaceDCMotorCfg(
        joint_names_expr=".*(HAA|HFE|KFE)",
        stiffness=85.0,
        damping=0.6,
        saturation_effort=140.0,
        effort_limit=89.0,
        velocity_limit=8.5,
    )


def anymal_d_cfg() -> ArticulationCfg:
    """The robot in its standing posture."""
    return ArticulationCfg(
        mjcf_path=ASSETS_DIR / "anymal_d" / "anymal_d.xml",
        init_state=InitialStateCfg(
            pos=(0.0, 0.0, 0.6),
            joint_pos={".*HAA": 0.0, ".*F_HFE": 0.4, ".*H_HFE": -0.4, ".*F_KFE": -0.8, ".*H_KFE": 0.8},
        ),
        actuators={"legs": anymal_d_drive_cfg()},
        joint_order=ANYMAL_D_JOINTS,
    )
