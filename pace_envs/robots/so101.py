"""SO-101 (TheRobotStudio), an arm of six STS3215 servos that turn a position error into a duty cycle."""

from pace_actuators import PaceDCMotorCfg
from pace_envs.articulation_cfg import ArticulationCfg, InitialStateCfg
from pace_envs.assets_dir import ASSETS_DIR

SO101_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")

# Measured by others: 0.164 duty per rad and unit of the firmware's P (STS3250; 0.165 on an STS3215), and 5.51 N m at
# full duty and 12 V (a public fit of an STS3215 after BAM's method: 29 N m/rad at P 32, armature 0.026 kg m²,
# Coulomb friction 0.11 N m; the same method gave 3.35 N m at 7.4 V). From the data sheet: 45 rpm without load at 12 V.
# Assumed: a supply of 12 V (it scales torque and speed alike), and that the firmware's D adds nothing: its unit is
# not published, and what it does goes into the identified viscous friction.
_DUTY_PER_RAD_AND_P = 0.164
_FIRMWARE_P = 16
_STALL_TORQUE = 5.51  # [N m]
_NO_LOAD_SPEED = 4.71  # [rad/s]


def so101_drive_cfg() -> PaceDCMotorCfg:
    """The servo of every joint: a PD drive with a torque-speed line, as docs/your_own_robot.md derives it.

    With u = k (q* - q) the duty and τ = kt/R (V u - kt q̇), stiffness is k τ_s and damping τ_s / v_0, the back-EMF.
    """
    return PaceDCMotorCfg(
        joint_names_expr=SO101_JOINTS,
        stiffness=_DUTY_PER_RAD_AND_P * _FIRMWARE_P * _STALL_TORQUE,  # 14.5 N m/rad
        damping=_STALL_TORQUE / _NO_LOAD_SPEED,  # 1.17 N m s/rad
        saturation_effort=_STALL_TORQUE,
        effort_limit=2 * _STALL_TORQUE,  # braking from no-load speed; the motoring limit is the line above
        velocity_limit=_NO_LOAD_SPEED,
    )


def so101_cfg() -> ArticulationCfg:
    """The arm on its table, joints in the middle of their ranges, jaw half open."""
    return ArticulationCfg(
        mjcf_path=ASSETS_DIR / "so101" / "so101.xml",
        init_state=InitialStateCfg(joint_pos={"elbow_flex": 0.5, "gripper": 0.8}),
        actuators={"servos": so101_drive_cfg()},
        joint_order=SO101_JOINTS,
        fix_base=True,
    )
