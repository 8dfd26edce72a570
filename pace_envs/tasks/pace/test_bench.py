"""Identification of one drive on a bench."""

from pace_envs.assets_dir import ASSETS_DIR
from pace_envs.robots import TEST_BENCH_JOINTS, apply_test_bench_load, test_bench_cfg
from pace_envs.tasks.pace.pace_cfg import ExcitationCfg, PaceCfg
from pace_envs.tasks.pace.pace_sim2real_env_cfg import PaceSim2realEnvCfg, PaceSim2realSceneCfg


def test_bench_pace_env_cfg() -> PaceSim2realEnvCfg:
    """A drive that swings a pendulum."""
    return PaceSim2realEnvCfg(
        scene=PaceSim2realSceneCfg(robot=test_bench_cfg()),
        sim2real=PaceCfg(
            robot_name="test_bench",
            data_dir=ASSETS_DIR / "test_bench" / "chirp.npz",
            joint_order=TEST_BENCH_JOINTS,
            bounds={
                "armature": (1e-5, 1.0),
                "viscous_friction": (0.0, 7.0),
                "friction": (0.0, 2.0),
                "encoder_bias": (-0.1, 0.1),
                "delay": (0.0, 10.0),
            },
            excitation=ExcitationCfg(bias=(0.0,), direction=(1.0,), scale=(0.5,)),
            sample_params={
                "armature": 0.1,
                "viscous_friction": 4.5,
                "friction": 0.3,
                "encoder_bias": 0.02,
                "delay": 3.0,
            },
            apply_load=apply_test_bench_load,
        ),
    )
