"""A robot that is not this project's: a model, two files of code, an effect, and a run on it."""

from pathlib import Path

import numpy as np

MODEL = """<mujoco model="swing"><compiler angle="radian"/><include file="arm_defaults.xml"/>
<worldbody><body name="arm" pos="0 0 1"><joint name="{joint}" axis="0 1 0" range="-2 2"/>
<inertial pos="0 0 -0.1" mass="0.6" diaginertia="0.004 0.004 0.001"/><geom size="0.02"/></body></worldbody></mujoco>"""
DEFAULTS = '<mujoco><default><geom rgba="1 0 0 1"/></default></mujoco>'
LIMITS = "KP, KD, DELAY = 8.0, 0.3, 6.0\n"
TASK = """
from pathlib import Path
from pace_actuators import PaceDCMotorCfg
from pace_envs import ArticulationCfg, register_task
from pace_envs.tasks.pace import ExcitationCfg, PaceCfg, PaceSim2realEnvCfg, PaceSim2realSceneCfg
from swing_limits import DELAY, KD, KP

def swing_cfg():
    drive = PaceDCMotorCfg(joint_names_expr=".*", stiffness=KP, damping=KD, saturation_effort=9.0, effort_limit=6.0,
        velocity_limit=20.0, max_delay=DELAY)
    robot = ArticulationCfg(mjcf_path=Path(__file__).parent / "swing.xml", actuators={{"drive": drive}},
        joint_order=({joint!r},))
    bounds = dict(armature=(1e-4, 0.05), viscous_friction=(0.0, 0.5), friction=(0.0, 0.3),
        encoder_bias=(-0.1, 0.1), delay=(0.0, DELAY))
    return PaceSim2realEnvCfg(scene=PaceSim2realSceneCfg(robot=robot), sim2real=PaceCfg(robot_name="swing",
        data_dir="data/swing.csv", joint_order=({joint!r},), bounds=bounds,
        excitation=ExcitationCfg(bias=(0.2,), direction=(1.0,), scale=(0.8,))))

register_task("Pace-Swing-v0", swing_cfg)
"""
EFFECT = """
import torch
from pace_actuators.effects import Effect, EffectParameter

class Sticky(Effect):
    name = "sticky"
    stage = "transmission"
    parameters = (EffectParameter(name="drag", unit="N m", lower=0.0, upper=0.5, null=0.0, start=0.02, meaning="c"),)
    equation = "τ - c tanh(10 q̇)"
    looks = "a drag of constant size"
    source = "a drawing"
    separates = "a slow motion"

    def transmission(self, s):
        s.effort -= self.drag * torch.tanh(10.0 * s.joint_vel)
"""


def write_robot(folder: Path, joint: str = "hinge") -> Path:
    """The files of the robot, and a recording of it, in a folder; returns the folder."""
    (folder / "data").mkdir(parents=True)
    (folder / "swing.xml").write_text(MODEL.format(joint=joint))
    (folder / "arm_defaults.xml").write_text(DEFAULTS)
    (folder / "swing_limits.py").write_text(LIMITS)
    (folder / "swing.py").write_text(TASK.format(joint=joint))
    (folder / "sticky_effect.py").write_text(EFFECT)
    time = np.arange(0, 4.0, 0.0025)
    target = 0.8 * np.sin(2 * np.pi * (0.4 * time + 0.25 * time**2))
    rows = np.column_stack([time, simulated(target), target])
    header = f"time,dof_pos/{joint},des_dof_pos/{joint}"
    np.savetxt(folder / "data" / "swing.csv", rows, delimiter=",", header=header, comments="", fmt="%.9f")
    return folder


def simulated(target: np.ndarray) -> np.ndarray:
    """What the encoder shows of the pendulum, two samples late, semi-implicitly, with noise of 0.1 mrad."""
    inertia, drag, dt = 0.004 + 0.6 * 0.01 + 0.008, 0.06, 0.0025
    q = v = 0.0
    held, seen = np.concatenate([[target[0]] * 2, target])[: len(target)], []
    for goal in held:
        seen.append(q)
        torque = 8.0 * (goal - q) - 0.3 * v - 0.6 * 9.81 * 0.1 * np.sin(q) - 0.05 * np.tanh(v / 0.01)
        v = (inertia * v + dt * torque) / (inertia + dt * drag)
        q += dt * v
    return np.array(seen) + 1e-4 * np.random.default_rng(0).standard_normal(len(seen))
