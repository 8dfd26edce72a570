"""A robot in the simulation: joint orders, partial writes and resets, groups of drives, models of one's own."""

import numpy as np
import pytest
import torch

from pace_actuators import PaceDCMotor, PaceDCMotorCfg
from pace_envs import Articulation, ArticulationCfg, InitialStateCfg, InteractiveScene, InteractiveSceneCfg
from pace_envs import SimulationCfg as SimCfg

# a base with a chain a-b-c; an actuator, a sensor on it and a keyframe, as models found in the wild have them
MJCF = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint name="root"/>
      <geom size="0.1" mass="3"/>
      <body name="upper" pos="0.1 0 0">
        <joint name="a" axis="0 1 0" range="-2 2" damping="0.7" armature="0.02" frictionloss="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.5"/>
        <body name="middle" pos="0 0 -0.2">
          <joint name="b" axis="0 1 0" armature="0.02"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.4"/>
          <body name="lower" pos="0 0 -0.2">
            <joint name="c" axis="1 0 0" armature="0.02"/>
            <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><position name="a" joint="a" kp="1000"/></actuator>
  <sensor><actuatorfrc actuator="a"/><jointpos joint="b"/></sensor>
  <keyframe><key name="home" qpos="0 0 1 1 0 0 0 .1 .2 .3" ctrl="0.5"/></keyframe>
</mujoco>
"""
START = {"a": 0.3, "b": -0.2, "c": 0.1}
TARGET = {"a": 0.5, "b": 0.4, "c": -0.6}


def drive(joints=".*", **fields) -> PaceDCMotorCfg:
    return PaceDCMotorCfg(**({"joint_names_expr": joints, "stiffness": 8.0, "damping": 0.3, "delay": 1.5} | fields))


@pytest.fixture
def build(tmp_path):
    """A function that builds the scene of the model above."""
    path = tmp_path / "robot.xml"
    path.write_text(MJCF)

    def build_scene(num_envs=3, fix_base=True, actuators=None, **fields) -> InteractiveScene:
        fields.setdefault("init_state", InitialStateCfg(joint_pos=START, pos=(0.0, 0.0, 1.0)))
        fields.setdefault("mjcf_path", path)
        robot = ArticulationCfg(
            fix_base=fix_base,
            actuators={"all": drive()} if actuators is None else actuators,
            **fields,
        )
        return InteractiveScene(InteractiveSceneCfg(num_envs=num_envs, robot=robot), SimCfg())

    return build_scene


def step(scene: InteractiveScene, steps: int) -> torch.Tensor:
    """Positions along the way, (steps, num_envs, num_joints)."""
    positions = []
    for _ in range(steps):
        scene.write_data_to_sim()
        scene.sim.step()
        scene.update()
        positions.append(scene["robot"].data.joint_pos.clone())
    return torch.stack(positions)


def aim(robot: Articulation) -> None:
    """Targets by joint name, one tenth further in each environment."""
    target = torch.tensor([TARGET[name] for name in robot.joint_names], dtype=torch.float64)
    robot.set_joint_position_target(target + 0.1 * torch.arange(robot.num_envs)[:, None])


# ---- order of the joints


@pytest.mark.parametrize("fix_base", [True, False])
@pytest.mark.parametrize("order", [("c", "a", "b"), ("b", "a", "c")])
def test_a_permuted_joint_order_gives_the_same_motion(build, order, fix_base):
    plain, permuted = build(fix_base=fix_base), build(fix_base=fix_base, joint_order=order)
    for scene in (plain, permuted):
        aim(scene["robot"])
        scene["robot"].write_joint_armature_to_sim(0.05, [scene["robot"].joint_names.index("b")])
    columns = [plain["robot"].joint_names.index(name) for name in order]
    moved = step(plain, 80)
    assert torch.equal(moved[..., columns], step(permuted, 80))
    assert (moved[-1] - moved[0]).abs().max() > 0.5
    a, b = plain["robot"].data, permuted["robot"].data
    for name in ("joint_vel", "applied_torque", "computed_torque", "joint_pos_target", "default_joint_pos"):
        assert torch.equal(getattr(a, name)[:, columns], getattr(b, name)), name
    assert torch.equal(a.joint_pos_limits[columns], b.joint_pos_limits)


@pytest.mark.parametrize("order", [None, ("c", "a", "b")])
def test_the_state_is_fresh_after_every_write_and_reset(build, order):
    scene = build(joint_order=order)
    robot, ones = scene["robot"], torch.ones(3, 3, dtype=torch.float64)
    robot.write_joint_state_to_sim(0.4 * ones, 0.5 * ones)
    assert torch.equal(robot.data.joint_pos, 0.4 * ones) and torch.equal(robot.data.joint_vel, 0.5 * ones)
    step(scene, 3)
    scene.reset([1])
    assert torch.equal(robot.data.joint_pos[1], robot.data.default_joint_pos[1])
    assert robot.data.joint_vel[1].tolist() == [0.0, 0.0, 0.0]
    assert (robot.data.joint_pos[[0, 2]] != robot.data.default_joint_pos[[0, 2]]).all()


def test_joints_left_out_of_the_order_move_freely_without_torque(build):
    scene = build(joint_order=("c", "a"), init_state=InitialStateCfg(joint_pos={"a": 0.3}))
    robot = scene["robot"]
    assert robot.num_joints == 2 and robot.data.joint_pos.shape == (3, 2)
    robot.set_joint_position_target(torch.tensor([0.7, 0.2]).expand(3, 2))
    step(scene, 20)
    applied = scene.sim.qfrc_applied  # a, b, c
    assert torch.equal(applied[:, [2, 0]], robot.data.applied_torque) and (applied[:, [0, 2]] != 0).all()
    assert (applied[:, 1] == 0).all() and (scene.sim.qvel[:, 1] != 0).all()


def test_joints_without_a_drive_get_no_torque(build):
    scene = build(actuators={"one": drive("b")})
    step(scene, 5)
    assert (scene["robot"].data.applied_torque[:, [0, 2]] == 0).all()
    assert (scene["robot"].data.applied_torque[:, 1] != 0).all()


def test_without_any_drive_the_model_falls(build):
    scene = build(actuators={})
    step(scene, 5)
    assert (scene.sim.qfrc_applied == 0).all() and (scene.sim.qvel != 0).all()


@pytest.mark.parametrize(
    ("order", "message"),
    [(("a", "x"), "joint_order names unknown joints: x. Joints of the model .*: a, b, c"), (("a", "a"), "joint twice")],
)
def test_an_impossible_joint_order_is_refused(build, order, message):
    with pytest.raises(ValueError, match=message):
        build(joint_order=order, init_state=InitialStateCfg())


# ---- drives


@pytest.mark.parametrize("order", [None, ("c", "a", "b")])
def test_several_groups_do_what_one_group_does(build, order):
    one = build(joint_order=order, actuators={"all": drive(stiffness={"[ac]": 8.0, "b": 5.0})})
    groups = {"ac": drive("[ac]", stiffness=8.0), "b": drive("b", stiffness=5.0)}
    several = build(joint_order=order, actuators=groups)
    for scene in (one, several):
        aim(scene["robot"])
    assert torch.equal(step(one, 30), step(several, 30))
    assert torch.equal(one["robot"].data.applied_torque, several["robot"].data.applied_torque)


def test_a_joint_of_two_groups_is_refused(build):
    with pytest.raises(ValueError, match="'b' belongs to the actuator groups 'x' and 'y'"):
        build(actuators={"x": drive("[ab]"), "y": drive("[bc]")})


def test_a_group_without_joints_is_refused(build):
    with pytest.raises(ValueError, match="'knee' matches no joint"):
        build(actuators={"x": drive("knee")})


def test_joint_parameters_come_from_the_drive_or_else_from_the_model(build):
    scene = build(actuators={"all": drive(friction=0.2, armature={"a": 0.3, "[bc]": 0.1})})
    sim = scene.sim
    assert sim.expand("dof_frictionloss")[0].tolist() == [0.2, 0.2, 0.2]
    assert sim.expand("dof_armature")[2].tolist() == [0.3, 0.1, 0.1]
    assert sim.expand("dof_damping")[1].tolist() == [0.7, 0.0, 0.0]
    assert scene["robot"].actuators["all"].viscous_friction[0].tolist() == [0.7, 0.0, 0.0]


def test_a_motor_of_ones_own_is_named_in_the_configuration(build):
    class WeakMotor(PaceDCMotor):
        def drive_effort(self, effort_command, joint_pos, joint_vel):
            return 0.5 * super().drive_effort(effort_command, joint_pos, joint_vel)

    scene = build(actuators={"all": drive(class_type=WeakMotor)})
    aim(scene["robot"])
    step(scene, 3)
    data = scene["robot"].data
    assert torch.equal(data.applied_torque, 0.5 * data.computed_torque) and (data.applied_torque != 0).all()


def test_without_targets_the_robot_holds_its_initial_posture(build):
    scene = build(actuators={"all": drive(stiffness=300.0, damping=3.0, delay=0.0)})
    assert (step(scene, 200)[-1] - scene["robot"].data.default_joint_pos).abs().max() < 0.01


def test_feed_forward_holds_what_gravity_asks(build):
    scene = build(actuators={"all": drive(stiffness=0.0, damping=0.5, delay=0.0)})
    scene.sim.bind("qfrc_bias")
    scene.sim.forward()
    scene["robot"].set_joint_effort_target(scene.sim.bind("qfrc_bias").clone())
    moved = step(scene, 50)
    assert (moved[-1] - scene["robot"].data.default_joint_pos).abs().max() < 1e-6


# ---- partial writes and resets


@pytest.mark.parametrize("order", [None, ("c", "a", "b")])
@pytest.mark.parametrize("joint_ids", [[2, 0], torch.tensor([2, 0])], ids=repr)
@pytest.mark.parametrize("env_ids", [[3, 1], torch.tensor([3, 1]), np.array([3, 1])], ids=repr)
def test_values_belong_to_environments_and_joints_in_the_order_given(build, order, joint_ids, env_ids):
    scene = build(4, joint_order=order)
    robot, values = scene["robot"], torch.tensor([[0.34, 0.33], [0.14, 0.13]], dtype=torch.float64)
    for write in (
        robot.write_joint_armature_to_sim,
        robot.write_joint_friction_coefficient_to_sim,
        robot.write_joint_viscous_friction_coefficient_to_sim,
        robot.set_joint_position_target,
        robot.set_joint_velocity_target,
        robot.set_joint_effort_target,
    ):
        write(values, joint_ids, env_ids)
    robot.write_joint_state_to_sim(values, -values, joint_ids, env_ids)
    fields = {name: scene.sim.expand(name) for name in ("dof_armature", "dof_frictionloss", "dof_damping")}
    written = {name: field[:, robot.dof_columns] for name, field in fields.items()}
    for name in ("joint_pos", "joint_pos_target", "joint_vel_target", "joint_effort_target"):
        written[name] = getattr(robot.data, name)
    written["-joint_vel"] = -robot.data.joint_vel
    for name, tensor in written.items():
        assert tensor[3][[2, 0]].tolist() == [0.34, 0.33], name
        assert tensor[1][[2, 0]].tolist() == [0.14, 0.13], name
        assert not set(tensor[[0, 2]].flatten().tolist()) & {0.34, 0.33, 0.14, 0.13}, name


def test_masks_and_single_numbers_are_taken_too(build):
    scene = build(4)
    mask = torch.tensor([False, True, False, True])
    scene["robot"].write_joint_armature_to_sim(0.9, torch.tensor([True, False, False]), mask)
    scene["robot"].write_joint_friction_coefficient_to_sim(0.8, slice(1, None), slice(0, 2))
    assert (scene.sim.expand("dof_armature") == 0.9).nonzero().tolist() == [[1, 0], [3, 0]]
    assert (scene.sim.expand("dof_frictionloss") == 0.8).nonzero().tolist() == [[0, 1], [0, 2], [1, 1], [1, 2]]


def test_a_written_parameter_is_as_good_as_one_in_the_model(build, tmp_path):
    written, other = build(actuators={}), tmp_path / "other.xml"
    values = {"armature": 0.07, "damping": 0.4, "frictionloss": 0.3}
    given = "".join(f' {name}="{value}"' for name, value in values.items())
    text = MJCF.replace(' armature="0.02"', "").replace(' damping="0.7"', "").replace(' frictionloss="0.01"', "")
    other.write_text(text.replace('axis="', given[1:] + ' axis="'))
    compiled = build(actuators={}, mjcf_path=other)
    written["robot"].write_joint_armature_to_sim(0.07)
    written["robot"].write_joint_viscous_friction_coefficient_to_sim(0.4)
    written["robot"].write_joint_friction_coefficient_to_sim(0.3)
    assert torch.equal(step(written, 100), step(compiled, 100))


@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
def test_parameters_that_are_no_physics_are_refused(build, value):
    with pytest.raises(ValueError, match=r"armature is .*, expected a finite number >= 0"):
        build()["robot"].write_joint_armature_to_sim(torch.tensor([0.1, value, 0.1]))


@pytest.mark.parametrize("order", [None, ("c", "a", "b")])
@pytest.mark.parametrize("fix_base", [True, False])
@pytest.mark.parametrize("env_ids", [[2, 0], torch.tensor([True, False, True]), np.array([0, 2])], ids=repr)
def test_a_partial_reset_starts_anew_and_leaves_the_others_alone(build, env_ids, fix_base, order):
    fresh, reset, never = (build(fix_base=fix_base, joint_order=order) for _ in range(3))
    for scene in (reset, never):
        aim(scene["robot"])
        scene["robot"].set_joint_velocity_target(torch.full((3, 3), 0.1))
        step(scene, 20)
    reset.reset(env_ids)
    reset.sim.forward(env_ids)
    assert torch.equal(step(reset, 20)[:, 1], step(never, 20)[:, 1])
    assert torch.equal(reset["robot"].data.joint_pos_target[1], never["robot"].data.joint_pos_target[1])
    assert torch.equal(reset.sim.qpos[[0, 2]], _after(fresh, 20).qpos[[0, 2]])


def _after(scene: InteractiveScene, steps: int):
    scene["robot"].set_joint_velocity_target(torch.zeros(3, 3))
    step(scene, steps)
    return scene.sim


def test_resetting_no_environment_changes_nothing(build):
    scene = build()
    before = step(scene, 3)[-1]
    scene.reset([])
    assert torch.equal(scene["robot"].data.joint_pos, before)


def test_what_inference_mode_created_can_be_written_outside_of_it(build):
    scene = build(joint_order=("c", "a", "b"))
    with torch.inference_mode():
        scene["robot"].set_joint_velocity_target(torch.zeros(3, 3))
        step(scene, 2)
    scene["robot"].set_joint_velocity_target(torch.ones(3, 3))
    step(scene, 2)
    scene.reset([0])


# ---- base


def test_a_fixed_base_stands_where_the_configuration_says(build):
    init = InitialStateCfg(pos=(1.0, 2.0, 3.0), rot=(0.0, 0.0, 0.0, 1.0))
    scene = build(init_state=init)
    xpos, xquat = scene.sim.bind("xpos"), scene.sim.bind("xquat")
    scene.sim.forward()
    assert scene["robot"].is_fixed_base and scene["robot"].data.root_pos_w is None
    assert xpos[0, 1].tolist() == [1.0, 2.0, 3.0] and xquat[0, 1].tolist() == [0.0, 0.0, 0.0, 1.0]
    with pytest.raises(ValueError, match="no root state"):
        scene["robot"].write_root_state_to_sim(torch.zeros(13))


def test_a_floating_base_falls(build):
    scene = build(fix_base=False)
    data = scene["robot"].data
    step(scene, 40)
    assert not scene["robot"].is_fixed_base
    assert data.root_lin_vel_w[0, 2].item() == pytest.approx(-0.981, rel=0.1)
    state = torch.zeros(2, 13, dtype=torch.float64)
    state[:, 0], state[:, 3], state[:, 7] = torch.tensor([5.0, 6.0]), 1.0, 7.0
    scene["robot"].write_root_state_to_sim(state, [2, 0])
    assert data.root_pos_w[:, 0].tolist()[0::2] == [6.0, 5.0] and data.root_lin_vel_w[2, 0] == 7.0


# ---- names and files


def test_joints_and_bodies_are_found_by_expression(build):
    robot = build(joint_order=("c", "a", "b"))["robot"]
    assert robot.find_joints("[ab]") == ([1, 2], ["a", "b"])
    assert robot.find_joints(["b", "c"]) == ([0, 2], ["c", "b"])
    assert robot.find_joints(["b", "c"], preserve_order=True) == ([2, 0], ["b", "c"])
    assert robot.find_bodies(".*er") == ([2, 4], ["upper", "lower"])
    with pytest.raises(ValueError, match=r"'z' matches no joint\. Available: c, a, b"):
        robot.find_joints("z")


def test_soft_limits_shrink_about_the_middle_of_the_range(build):
    data = build(soft_joint_pos_limit_factor=0.5)["robot"].data
    assert data.joint_pos_limits.tolist() == [[-2.0, 2.0], [-np.inf, np.inf], [-np.inf, np.inf]]
    assert data.soft_joint_pos_limits.tolist() == [[-1.0, 1.0], [-np.inf, np.inf], [-np.inf, np.inf]]


@pytest.mark.parametrize(("text", "message"), [(None, "does not exist"), ("<mujoco>", "cannot read")])
def test_a_model_that_cannot_be_read_is_refused(tmp_path, text, message):
    path = tmp_path / "broken.xml"
    if text is not None:
        path.write_text(text)
    cfg = InteractiveSceneCfg(robot=ArticulationCfg(mjcf_path=path))
    with pytest.raises(ValueError, match=message):
        InteractiveScene(cfg, SimCfg())
