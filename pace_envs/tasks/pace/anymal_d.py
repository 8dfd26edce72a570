"""Identification of ANYmal D: PACE's reference case."""

from pace_envs.assets_dir import ASSETS_DIR
from pace_envs.robots import ANYMAL_D_JOINTS, anymal_d_cfg
from pace_envs.tasks.pace.pace_cfg import ExcitationCfg, PaceCfg
from pace_envs.tasks.pace.pace_sim2real_env_cfg import PaceSim2realEnvCfg, PaceSim2realSceneCfg


def anymal_d_pace_env_cfg() -> PaceSim2realEnvCfg:
    """ANYmal D in the air."""
    robot = anymal_d_cfg()
    robot.init_state.pos = (0.0, 0.0, 1.0)
    return PaceSim2realEnvCfg(
        scene=PaceSim2realSceneCfg(robot=robot),
        sim2real=PaceCfg(
            robot_name="anymal_d",
            data_dir=ASSETS_DIR / "anymal_d" / "chirp.npz",
            joint_order=ANYMAL_D_JOINTS,
            bounds={
                "armature": (1e-5, 1.0),
                "viscous_friction": (0.0, 7.0),
                "friction": (0.0, 0.5),
                "encoder_bias": (-0.1, 0.1),
                "delay": (0.0, 10.0),
            },
            excitation=ExcitationCfg(
                bias=(0.0, 0.4, 0.8) * 4,
                direction=(1, 1, 1, -1, 1, 1, 1, -1, -1, -1, -1, -1),
                scale=(0.25, 0.5, -2.0) * 4,
            ),
            sample_params={
                "armature": 0.1,
                "viscous_friction": 4.5,
                "friction": 0.05,
                "encoder_bias": 0.05,
                "delay": 5.0,
            },
        ),
    )
