"""Slides are measured in m, kg, N and N s/m; what means nothing there is not tried."""

import dataclasses

import pytest
import torch
from models import GANTRY

from pace_actuators.effects import get_effect
from pace_actuators.joint_units import units_for
from pace_envs import ManagerBasedRLEnv
from pace_envs.from_model import cfg_from_model
from pace_envs.tasks.pace import base_parameters, effect_parameters
from pace_optim.problem.parameter_space import ParameterSpace


@pytest.fixture
def gantry(tmp_path):
    path = tmp_path / "gantry.xml"
    path.write_text(GANTRY)
    return cfg_from_model(path)


@pytest.mark.parametrize(
    ("hinge", "slide"),
    [
        ("kg m^2", "kg"),
        ("kg m²", "kg"),
        ("N m", "N"),
        ("N m s/rad", "N s/m"),
        ("N m/rad", "N/m"),
        ("N m s^2/rad^2", "N s^2/m^2"),
        ("rad/s", "m/s"),
        ("0.12 mrad (train), score 1e-9 rad²", "0.12 mm (train), score 1e-9 m²"),
        ("control steps", "control steps"),
        ("a gradient of the radius", "a gradient of the radius"),
    ],
)
def test_units_of_a_hinge_become_those_of_a_slide(hinge, slide):
    assert units_for(hinge, ["slide"]) == slide


def test_each_joint_has_the_units_of_its_kind(gantry):
    units = ParameterSpace(base_parameters(gantry.sim2real)).units
    assert units["armature"] == {"axis": "kg", "swing": "kg m^2"}
    assert units["friction"] == {"axis": "N", "swing": "N m"}
    assert units["delay"] == "control steps"


def test_effects_that_mean_nothing_on_a_slide_are_not_identified_there(gantry):
    cfg = dataclasses.replace(gantry.sim2real, effects=("com_offset", "backlash"))
    keys = {parameter.name: parameter.keys for parameter in effect_parameters(cfg)}
    assert keys["com_offset.angle"] == ("swing",)
    assert keys["backlash.gap"] == ("axis", "swing")
    assert "slide" not in get_effect("torque_ripple").joint_types


def test_a_balanced_links_centre_of_mass_can_be_moved(gantry):
    """MuJoCo compiles a body with its centre of mass in its joint as a simple one, and then refuses to move it."""
    gantry.set_effects(["com_offset", "payload"])
    gantry.scene.num_envs = 2
    env = ManagerBasedRLEnv(gantry)
    robot = env.scene["robot"]
    assert robot.slide_joints == ("axis",)
    robot.write_effect_parameter_to_sim("com_offset", "angle", torch.full((2, 1), 0.2), [1])
    robot.write_effect_parameter_to_sim("payload", "ratio", torch.full((2, 2), 0.5))
    env.sim.forward()
    assert env.sim.expand("body_mass")[0, 1:].tolist() == [3.0, 1.5]
    env.close()
