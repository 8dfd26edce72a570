"""Where a fit of a model file begins: by the torques that the log's drives asked for, not by a placeholder's limit."""

import numpy as np
import pytest

from pace_optim.problem.problem import load_problem
from pace_optim.recording import Drive, Recording, save_recording

PENDULUM = """
<robot name="pendulum">
  <link name="base"/>
  <link name="rod"><inertial><origin xyz="0 0 -0.1"/><mass value="0.1"/>
    <inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-5"/></inertial></link>
  <joint name="swing" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="{effort}" velocity="100"/></joint>
</robot>
"""
KP, KD = 2.0, 0.05


def start_of(tmp_path, effort: float) -> dict[str, float]:
    """The start of a fit of a joint that swings by 0.3 rad at 1 Hz and lags behind by 0.1 rad (amplitudes)."""
    file, log = tmp_path / "pendulum.urdf", tmp_path / "log.npz"
    file.write_text(PENDULUM.format(effort=effort))
    time = np.arange(2000) * 0.0025
    swing = 0.3 * np.sin(2 * np.pi * time)[:, None]
    target = swing + 0.1 * np.sin(2 * np.pi * time)[:, None]
    drive = Drive(stiffness=np.array([KP]), damping=np.array([KD]))
    recording = Recording(name="log", time=time, dof_pos=swing, des_dof_pos=target, joint_names=("swing",), drive=drive)
    save_recording(log, recording)
    space = load_problem(str(file), data=[log]).space
    values = space.to_dict(space.to_physical(space.start))
    return {name: values[name]["swing"] for name in ("armature", "viscous_friction", "friction")}


def test_no_parameter_takes_more_than_a_tenth_of_the_torque_that_is_asked_for(tmp_path):
    omega = 2 * np.pi
    speed, torque = 0.3 * omega, np.hypot(KP * 0.1, KD * 0.3 * omega)  # amplitudes
    right = {
        "armature": 0.1 * torque / (omega * speed),
        "viscous_friction": 0.1 * torque / speed,
        "friction": 0.1 * torque / np.sqrt(2),
    }
    assert start_of(tmp_path, effort=1000.0) == pytest.approx(right, rel=0.01)


def test_a_start_by_limits_that_are_small_is_kept(tmp_path):
    least = start_of(tmp_path, effort=0.4)
    assert least["friction"] == pytest.approx(0.1 * 0.2 * 0.4)  # a tenth of the bound, which is a fifth of the limit
