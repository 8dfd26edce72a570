"""A robot's model file is read once, and again where it or what it names may have changed."""

import mujoco
import numpy as np
import pytest
from problems import ANYMAL, BENCH

from pace_envs import ArticulationCfg, load_env_cfg, robot_spec
from pace_envs.robot_spec import load_robot_spec

ARM = '<mujoco>{0}<worldbody><body><joint name="j"/><geom size=".1" mass="{1}"/></body></worldbody></mujoco>'


@pytest.fixture(autouse=True)
def forgotten(monkeypatch):
    monkeypatch.setattr(robot_spec, "_specs", {})


def saved(cfg, **options):
    """The compiled model's bytes."""
    model = load_robot_spec(cfg, **options).compile()
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return content.tobytes()


@pytest.mark.parametrize("touches", [False, True])
@pytest.mark.parametrize("task", [BENCH, ANYMAL, "Pace-Go2-v0", "Pace-SO101-v0", "Pace-AnymalD-Velocity-v0"])
def test_a_robot_that_is_built_again_is_the_same_to_the_bit(task, touches, monkeypatch):
    cfg = load_env_cfg(task).scene.robot
    first = saved(cfg, touches=touches)
    monkeypatch.setattr(robot_spec, "read_model_file", None)  # a second reading would fail
    spec = load_robot_spec(cfg, touches=touches)
    spec.bodies[1].mass = 77.0
    assert saved(cfg, touches=touches) == first


def test_a_file_that_has_changed_is_read_again_and_one_that_names_others_always(tmp_path):
    path, part = tmp_path / "arm.xml", tmp_path / "part.xml"
    cfg = ArticulationCfg(mjcf_path=str(path), actuators={})
    masses = []
    for mass in (1, 2):
        path.write_text(ARM.format("", mass))
        masses.append(load_robot_spec(cfg).compile().body_mass[1])
    for gravity in (3, 4):
        part.write_text(f'<mujoco><option gravity="0 0 -{gravity}"/></mujoco>')
        path.write_text(ARM.format('<include file="part.xml"/>', 1))
        masses.append(-load_robot_spec(cfg).compile().opt.gravity[2])
    assert masses == pytest.approx([1, 2, 3, 4])


@pytest.mark.slow
def test_only_the_last_robots_are_kept(tmp_path):
    path = tmp_path / "arm.xml"
    for mass in range(1, 12):
        path.write_text(ARM.format("", mass))
        load_robot_spec(ArticulationCfg(mjcf_path=str(path), actuators={}))
    assert len(robot_spec._specs) == 8
    held = ArticulationCfg(mjcf_path=str(path), actuators={}, held_joints={"j": 0.5})
    assert load_robot_spec(held).compile().njnt == 0
