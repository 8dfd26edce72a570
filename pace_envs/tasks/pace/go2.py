"""Identification of the Unitree Go2."""

from pace_envs.assets_dir import ASSETS_DIR
from pace_envs.robots import GO2_JOINTS, go2_cfg
from pace_envs.tasks.pace.pace_cfg import ExcitationCfg, PaceCfg
from pace_envs.tasks.pace.pace_sim2real_env_cfg import PaceSim2realEnvCfg, PaceSim2realSceneCfg


def go2_pace_env_cfg() -> PaceSim2realEnvCfg:
    """Go2 in the air."""
    robot = go2_cfg()
    robot.init_state.pos = (0.0, 0.0, 1.0)
    return PaceSim2realEnvCfg(
        scene=PaceSim2realSceneCfg(robot=robot),
        sim2real=PaceCfg(
            robot_name="go2",
            data_dir=ASSETS_DIR / "go2" / "chirp.npz",
            joint_order=GO2_JOINTS,
            bounds={
                "armature": (1e-5, 0.2),
                "viscous_friction": (0.0, 3.0),
                "friction": (0.0, 2.0),
                "encoder_bias": (-0.15, 0.15),
                "delay": (0.0, 20.0),
            },
            excitation=ExcitationCfg(
                bias=(0.0, 1.8, -2.9) * 4,
                direction=(1, 1, 1, -1, 1, 1) * 2,
                scale=(0.25, 0.5, 0.6) * 4,
            ),
            sample_params={
                "armature": 0.02,
                "viscous_friction": 0.25,
                "friction": 0.2,
                "encoder_bias": 0.02,
                "delay": 3.0,
            },
        ),
    )
