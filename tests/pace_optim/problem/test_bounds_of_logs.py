"""How far a fit of a model file seeks: as its log's drives allow, not by a placeholder's limit."""

import numpy as np
import pytest
import torch

from pace_actuators.effects import get_effect
from pace_optim.joints.fits.model import JointModel
from pace_optim.problem.problem import load_problem
from pace_optim.recording import Drive, Recording, save_recording

KP, KD = 2.0, 0.05

LIGHT = """
<robot name="light">
  <link name="base"/>
  <link name="arm"><inertial><origin xyz="0 0 -0.05"/><mass value="0.02"/>
    <inertia ixx="1e-5" iyy="1e-5" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="swing" type="{type}"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>{limit}</joint>
</robot>
"""


def bounds_of(tmp_path, limit: str = "", **drive: float) -> dict[str, float]:
    """Upper bounds and start of Coulomb friction of a light link, whose recording states a drive."""
    file, log = tmp_path / "light.urdf", tmp_path / "log.npz"
    file.write_text(LIGHT.format(type="revolute" if limit else "continuous", limit=limit))
    time = np.arange(2000) * 0.0025
    swing = 0.3 * np.sin(2 * np.pi * time)[:, None]
    stated = Drive(**{name: np.array([value]) for name, value in drive.items()})
    recording = Recording(
        name="log", time=time, dof_pos=swing, des_dof_pos=1.1 * swing, joint_names=("swing",), drive=stated
    )
    save_recording(log, recording)
    space = load_problem(str(file), data=[log]).space
    upper = {name: float(space.upper[space[name]][0]) for name in ("armature", "viscous_friction", "friction")}
    return upper | {"start": space.to_dict(space.to_physical(space.start))["friction"]["swing"]}


def test_a_strong_drive_of_a_light_link_may_have_friction_as_its_recording_allows(tmp_path):
    nothing = bounds_of(tmp_path)
    assert nothing["friction"] < 0.1  # the link alone
    by_limit = bounds_of(tmp_path, stiffness=KP, damping=KD, effort_limit=20.0)
    assert by_limit["friction"] == pytest.approx(4.0) and by_limit["armature"] == pytest.approx(0.8)
    assert by_limit["viscous_friction"] == pytest.approx(2.0)
    by_gains = bounds_of(tmp_path, stiffness=KP, damping=KD)
    assert by_gains["friction"] == pytest.approx(0.2 * 0.5 * KP)
    assert by_gains["start"] > nothing["start"]


def test_a_limit_that_the_file_states_bounds_what_a_recording_without_one_may_have(tmp_path):
    limit = '<limit lower="-2" upper="2" effort="3" velocity="10"/>'
    assert bounds_of(tmp_path, limit, stiffness=KP, damping=KD)["friction"] == pytest.approx(0.6)


def test_a_limit_far_above_what_a_recording_asked_for_is_a_placeholder(tmp_path):
    """A humanoid's wrists were sought up to a million times their armature, where no derivative is right."""
    limit = '<limit lower="-2" upper="2" effort="4000" velocity="1000"/>'
    assert bounds_of(tmp_path, limit, stiffness=KP, damping=KD)["friction"] == pytest.approx(10 * 0.2 * 0.5 * KP)


def test_a_springs_rest_is_sought_in_all_of_its_joints_range(tmp_path):
    limit = '<limit lower="-0.4" upper="2.6" effort="3" velocity="10"/>'
    bounds_of(tmp_path, limit, stiffness=KP, damping=KD)
    problem = load_problem(str(tmp_path / "light.urdf"), data=[tmp_path / "log.npz"], effects=["parallel_spring"])
    rest = problem.space["parallel_spring.rest"]
    assert problem.space.lower[rest].tolist() == [-6.3] and problem.space.upper[rest].tolist() == [6.3]
    model = JointModel.base(problem).with_effect(get_effect("parallel_spring"), torch.tensor([True]))
    assert model.upper[0, -1] == pytest.approx(6.3) and not model.is_wide(get_effect("parallel_spring")).any()


def test_other_recordings_of_a_run_leave_its_values_within_the_bounds(tmp_path):
    bounds_of(tmp_path)
    problem = load_problem(str(tmp_path / "light.urdf"), data=[tmp_path / "log.npz"])
    friction, delay = problem.space["friction"], problem.space["delay"]
    wider = problem.reaching({"friction/swing": (0.0, 4.0), "delay/all": (1.0, 2.0)})
    assert wider.space.upper[friction].tolist() == [4.0] and problem.space.upper[friction] < 0.1
    assert wider.space.upper[delay] == problem.space.upper[delay]
    assert wider.with_effects(["torque_gain"]).space.upper[wider.space["friction"]].tolist() == [4.0]
