"""Identification of the SO-101 arm."""

from pace_envs.assets_dir import ASSETS_DIR
from pace_envs.robots import SO101_JOINTS, so101_cfg
from pace_envs.tasks.pace.pace_cfg import ExcitationCfg, PaceCfg
from pace_envs.tasks.pace.pace_sim2real_env_cfg import PaceSim2realEnvCfg, PaceSim2realSceneCfg


def so101_pace_env_cfg() -> PaceSim2realEnvCfg:
    """SO-101 with its base bolted down.

    The bounds are those of hobby servos on a slow bus: a lag of 100 to 130 ms, of which back-EMF over stiffness is
    80 ms, and friction that leaves a hysteresis of 0.03 to 0.05 rad (0.2 to 0.4 N m). The armature stays above
    5e-3 kg m²: below, the back-EMF of the light jaw is too stiff for a step of 2.5 ms.
    """
    return PaceSim2realEnvCfg(
        scene=PaceSim2realSceneCfg(robot=so101_cfg()),
        sim2real=PaceCfg(
            robot_name="so101",
            data_dir=ASSETS_DIR / "so101" / "chirp.npz",
            joint_order=SO101_JOINTS,
            bounds={
                "armature": (5e-3, 0.2),
                "viscous_friction": (0.0, 3.0),
                "friction": (0.0, 1.0),
                "encoder_bias": (-0.2, 0.2),
                "delay": (0.0, 80.0),  # 0.2 s
            },
            excitation=ExcitationCfg(
                bias=(0.0, -1.0, 1.0, 0.0, 0.0, 2.0),
                direction=(1.0,) * 6,
                scale=(0.6, 0.5, 0.5, 0.6, 0.8, 0.4),
            ),
            sample_params={
                "armature": 0.028,
                "viscous_friction": 0.15,
                "friction": 0.1,
                "encoder_bias": 0.03,
                "delay": 12.0,
            },
        ),
    )
