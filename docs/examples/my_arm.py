"""A desk arm with two servos: the example of docs/your_own_robot.md.

Importing this module registers ``Pace-MyArm-v0``; the scripts import it with ``--task my_arm:Pace-MyArm-v0``.
"""

from pathlib import Path

from pace_actuators import PaceDCMotorCfg
from pace_envs import (
    ArticulationCfg,
    ExcitationCfg,
    InitialStateCfg,
    PaceCfg,
    PaceSim2realEnvCfg,
    PaceSim2realSceneCfg,
    register_task,
)

HERE = Path(__file__).parent
MY_ARM_JOINTS = ("shoulder", "elbow")


def servo_cfg(
    duty_per_rad: float, volts: float, torque_per_amp: float, ohms: float, largest_amps: float | None = None
) -> PaceDCMotorCfg:
    """The drive of a servo that turns a position error into a duty cycle.

    Args:
        duty_per_rad: Gain of the firmware, duty (1 is the full voltage) per radian of error.
        volts: Supply voltage V.
        torque_per_amp: kt at the output shaft, gear included [N m/A].
        ohms: Resistance of the winding R.
        largest_amps: Current limit of the driver [A]; ``None`` if there is none.
    """
    stall = volts * torque_per_amp / ohms
    return PaceDCMotorCfg(
        joint_names_expr=".*",
        stiffness=duty_per_rad * volts * torque_per_amp / ohms,
        damping=torque_per_amp**2 / ohms,
        saturation_effort=stall,
        effort_limit=2 * stall if largest_amps is None else torque_per_amp * largest_amps,
        velocity_limit=volts / torque_per_amp,
        delay=0.0,  # until a fit knows it; with max_delay alone a drive acts with that delay, as in PACE
        max_delay=10.0,
    )


def my_arm_cfg() -> ArticulationCfg:
    """Model, initial state and drives."""
    return ArticulationCfg(
        mjcf_path=HERE / "my_arm.xml",
        init_state=InitialStateCfg(joint_pos={"shoulder": 0.3, "elbow": 0.7}),
        actuators={"servos": servo_cfg(duty_per_rad=3.0, volts=12.0, torque_per_amp=1.5, ohms=4.0)},
        joint_order=MY_ARM_JOINTS,
    )


def my_arm_env_cfg() -> PaceSim2realEnvCfg:
    """The identification environment."""
    return PaceSim2realEnvCfg(
        scene=PaceSim2realSceneCfg(robot=my_arm_cfg()),
        sim2real=PaceCfg(
            robot_name="my_arm",
            data_dir="data/my_arm/chirp.npz",
            joint_order=MY_ARM_JOINTS,
            bounds={
                "armature": (1e-5, 0.1),
                "viscous_friction": (0.0, 1.0),
                "friction": (0.0, 0.5),
                "encoder_bias": (-0.1, 0.1),
                "delay": (0.0, 10.0),
            },
            excitation=ExcitationCfg(bias=(0.6, 1.0), direction=(1.0, 1.0), scale=(0.5, 0.7)),
            sample_params={
                "armature": {"shoulder": 0.012, "elbow": 0.008},
                "viscous_friction": {"shoulder": 0.06, "elbow": 0.04},
                "friction": {"shoulder": 0.09, "elbow": 0.06},
                "encoder_bias": {"shoulder": 0.02, "elbow": -0.03},
                "delay": 3.4,
            },
        ),
    )


register_task("Pace-MyArm-v0", my_arm_env_cfg)
