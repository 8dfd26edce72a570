"""A training task from a model file: its meshes touch the ground as hulls, its bodies name what touches."""

import itertools

import mujoco
import pytest
import torch

from pace_envs import ArticulationCfg, ManagerBasedRLEnv, registration
from pace_envs.from_model import robot_cfg_from_model
from pace_envs.model_file import read_model_file
from pace_envs.rendering import drawn
from pace_envs.robot_spec import find_geoms, load_robot_spec
from pace_envs.robots import go2_cfg
from pace_envs.task_source import model_files
from pace_envs.tasks.reach import reach_env_cfg
from pace_envs.tasks.reach.reach_env_cfg import site_position
from pace_envs.tasks.velocity import add_randomization, energy_rewards, velocity_env_cfg, velocity_rewards

LEGS = tuple(itertools.product((0.2, -0.2), (0.1, -0.1)))
CORNERS = list(itertools.product((-0.5, 0.5), repeat=3))
SIDES = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))


def box(name, size, xyz="0 0 0"):
    return (
        f'<collision><origin xyz="{xyz}"/><geometry><mesh filename="{name}" scale="{size}"/></geometry></collision>'
        f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
    )


def inertial(mass):
    inertia = '<inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/>'
    return f'<inertial><mass value="{mass}"/>{inertia}</inertial>'


def walker(mesh="package://walker/meshes/box.obj"):
    """Four legs of 0.2 m under a trunk; every collision is a mesh, and the trunk has two."""
    trunk = box(mesh, "0.4 0.2 0.1") + box(mesh, "0.1 0.1 0.2")
    text = f'<robot name="walker"><link name="trunk">{inertial(6)}{trunk}</link>'
    for i, (x, y) in enumerate(LEGS):
        text += (
            f'<link name="leg_{i}">{inertial(0.5)}</link><link name="foot_{i}">{box(mesh, "0.04 0.04 0.02")}</link>'
            f'<joint name="hip_{i}" type="revolute"><parent link="trunk"/><child link="leg_{i}"/><axis xyz="0 1 0"/>'
            f'<origin xyz="{x} {y} 0"/><limit lower="-1" upper="1" effort="40" velocity="20"/></joint>'
            f'<joint name="ankle_{i}" type="fixed"><parent link="leg_{i}"/><child link="foot_{i}"/>'
            '<origin xyz="0 0 -0.2"/></joint>'
        )
    return text + "</robot>"


MJCF = """
<mujoco>
  <asset><mesh name="ball" vertex="{}"/></asset>
  <default><default class="seen"><geom contype="0" conaffinity="0"/></default></default>
  <worldbody>
    <body name="trunk"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <geom type="mesh" mesh="ball"/><geom type="mesh" mesh="ball" class="seen"/>
      <body name="leg"><joint name="hip" axis="0 1 0"/><geom name="leg" size="0.01"/><geom size="0.02"/></body>
    </body>
    {}
  </worldbody>
</mujoco>
"""


@pytest.fixture
def folder(tmp_path):
    """``walker/urdf/robot.urdf`` and ``walker/meshes/box.obj``, a cube of 1 m with a hole in its surface."""
    for name in ("urdf", "meshes"):
        (tmp_path / "walker" / name).mkdir(parents=True)
    faces = [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in SIDES]
    vertices = [f"v {x} {y} {z}" for x, y, z in CORNERS]
    (tmp_path / "walker" / "meshes" / "box.obj").write_text("\n".join([*vertices, *faces[:-1]]))
    (tmp_path / "walker" / "urdf" / "robot.urdf").write_text(walker())
    return tmp_path / "walker" / "urdf"


def test_a_urdf_of_meshes_stands_on_its_feet_in_a_velocity_task(folder):
    robot = robot_cfg_from_model(folder / "robot.urdf", {"hip_.": 0.3})
    cfg = velocity_env_cfg(robot, feet="foot_.", base="trunk", knees="trunk", action_scale=0.25)
    cfg.rewards, cfg.scene.num_envs, cfg.events = velocity_rewards(), 2, {}
    add_randomization(cfg, mass_range=(2.0, 2.0))
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    model, data = env.sim.model, env.scene["robot"].data
    feet = env.scene.sensors["feet"]
    assert feet.geom_names == ["foot_0/0", "foot_1/0", "foot_2/0", "foot_3/0"]
    assert env.scene.sensors["base"].geom_names == ["trunk/0", "trunk/1"]
    assert all(model.geom(name).type == mujoco.mjtGeom.mjGEOM_MESH for name in feet.geom_names)
    standing = float(data.root_pos_w[0, 2])
    assert standing == pytest.approx(robot.init_state.pos[2]) and 0.19 < standing < 0.23
    assert cfg.terminations["base_height"].params["minimum_height"] == pytest.approx(0.5 * standing)
    for _ in range(50):
        terminated = env.step(torch.zeros(2, 4, dtype=env.dtype))[2]
        assert not terminated.any()
    weight = (float(model.body_mass.sum()) + 2.0) * 9.81  # of the trunk, 2 kg more
    assert feet.in_contact.all()
    assert feet.net_forces_w[..., 2].sum(dim=1).tolist() == pytest.approx([weight] * 2, rel=0.02)
    env.close()


def test_a_robot_whose_base_does_not_collide_is_trained_by_its_tilt_and_height(folder):
    text = (folder / "robot.urdf").read_text()
    (folder / "robot.urdf").write_text(
        text.replace(text[text.index("<collision>") : text.index('<link name="leg_0">')], "</link>")
    )
    robot = robot_cfg_from_model(folder / "robot.urdf", {"hip_.": 0.3})
    with pytest.raises(ValueError, match=r"'trunk' .*colliding geom or body"):
        ManagerBasedRLEnv(velocity_env_cfg(robot, feet="foot_.", base="trunk", knees="foot_0", action_scale=0.25))
    cfg = velocity_env_cfg(robot, feet="foot_.", base=None, knees="foot_0", action_scale=0.25)
    assert set(cfg.terminations) == {"time_out", "bad_orientation", "base_height", "diverged"}
    cfg.rewards, cfg.scene.num_envs = energy_rewards(0.1, touching=("knees",)), 2
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    env.step(torch.zeros(2, 4, dtype=env.dtype))
    assert set(env.scene.sensors) == {"feet", "knees"}
    env.close()


def test_a_base_that_the_file_has_turned_and_raised_stands_as_it_is_turned(tmp_path):
    text = MJCF.format("0 0 0 0.2 0 0 0 0.2 0 0 0 0.2", "").replace('"trunk"', '"trunk" pos="0 0 3" euler="0 0 90"')
    (tmp_path / "robot.xml").write_text(text)
    state = robot_cfg_from_model(tmp_path / "robot.xml").init_state
    assert state.rot == pytest.approx((0.5**0.5, 0.0, 0.0, 0.5**0.5))
    assert 0.0 < state.pos[2] < 0.1  # of the ball's centre, not 3 m


def test_meshes_are_kept_only_where_something_touches(folder):
    path = folder / "robot.urdf"
    alone, touching = (read_model_file(path, touches=t).spec.compile() for t in (False, True))
    assert (alone.nmesh, alone.ngeom) == (0, 0) and touching.ngeom == 6
    assert [file.name for file in model_files(path, touches=True)] == ["robot.urdf", "box.obj"]
    assert touching.body_mass.tolist() == alone.body_mass.tolist()
    assert touching.body_inertia.tolist() == alone.body_inertia.tolist()


@pytest.mark.parametrize("name", ["../meshes/box.obj", "package://walker/meshes/box.obj", "file://{}"])
def test_a_mesh_is_found_as_the_file_names_it(folder, name):
    name = name.format((folder.parent / "meshes" / "box.obj").resolve())
    (folder / "robot.urdf").write_text(walker(name))
    assert read_model_file(folder / "robot.urdf", touches=True).spec.compile().ngeom == 6


@pytest.mark.parametrize("name", ["package://other/box.obj", "package://walker/meshes/box.dae"])
def test_meshes_that_cannot_touch_are_told(folder, name):
    (folder / "robot.urdf").write_text(walker(name))
    (folder.parent / "meshes" / "box.dae").write_text("<COLLADA/>")
    with pytest.warns(UserWarning, match=rf"Collision meshes without effect: {name}.*\.stl"):
        load_robot_spec(ArticulationCfg(mjcf_path=folder / "robot.urdf"), touches=True)


def test_expressions_name_geoms_or_else_bodies(tmp_path):
    directions = torch.nn.functional.normalize(torch.randn(400, 3, generator=torch.manual_seed(0)), dim=1)
    vertices = " ".join(f"{v:.6f}" for v in (0.1 * directions).flatten().tolist())
    (tmp_path / "robot.xml").write_text(MJCF.format(vertices, ""))
    spec = load_robot_spec(ArticulationCfg(mjcf_path=tmp_path / "robot.xml", fix_base=False), touches=True)
    named = {e: [geom.name for geom in find_geoms(spec, e)] for e in ("leg", "l.g.*", "tr.*", "trunk/0")}
    assert named == {"leg": ["leg"], "l.g.*": ["leg", "leg/0"], "tr.*": ["trunk/0"], "trunk/0": ["trunk/0"]}
    with pytest.raises(
        ValueError, match=r"'hoof' matches no colliding geom or body\. Available: trunk/0, leg, leg/0, tr"
    ):
        find_geoms(spec, "hoof")
    model = spec.compile()
    assert model.nq == 8  # it floats
    assert 4 < int(model.mesh_graph[model.mesh_graphadr[0]]) <= 64  # vertices of the hull


def test_a_file_with_several_bases_is_told_where_one_is_to_float(tmp_path):
    (tmp_path / "robot.xml").write_text(MJCF.format("0 0 0 1 0 0 0 1 0 0 0 1", '<body name="table"/>'))
    with pytest.raises(ValueError, match=r"one body without a joint in the world, found trunk, table\. Give the base"):
        load_robot_spec(ArticulationCfg(mjcf_path=tmp_path / "robot.xml", fix_base=False))


def test_bodies_whose_meshes_are_left_out_show_what_collides():
    """A film of a public robot was of one colour: its collision geoms are in a group that MuJoCo does not draw."""
    text = '<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" group="4"/>{}</worldbody></mujoco>'
    bodies = (
        '<body><geom name="alone" size="1" group="3"/></body><body><geom size="1"/><geom name="b" size="1" group="3"/>'
    )
    model = drawn(mujoco.MjModel.from_xml_string(text.format(bodies + "</body>")))
    assert [int(model.geom(name).group[0]) for name in ("floor", "alone", "b")] == [2, 2, 3]
    shipped = load_robot_spec(go2_cfg()).compile()
    before = shipped.geom_group.tolist()
    assert drawn(shipped).geom_group.tolist() == before


def test_a_body_of_an_arm_reaches(folder):
    robot = robot_cfg_from_model(folder / "robot.urdf")
    cfg = reach_env_cfg(robot, site="foot_0", action_scale=0.5, experiment_name="walker")
    cfg.scene.num_envs, cfg.commands["ee_position"].lowest, cfg.events = 2, -1.0, {}
    env = registration.make_env(lambda: cfg)
    env.reset()
    assert site_position(env, "foot_0")[0].tolist() == pytest.approx([0.2, 0.1, -0.2])
    env.close()
