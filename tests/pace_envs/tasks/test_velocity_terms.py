"""Terms of the velocity tasks have the values that their formulas give by hand."""

import math

import pytest
import torch

from pace_envs import ManagerBasedRLEnv, load_env_cfg, mdp, quaternions
from pace_envs.managers import CurriculumTermCfg, RewardTermCfg, SceneEntityCfg, TerminationTermCfg
from pace_envs.rl import RunSettings
from pace_envs.rl.training import load_cfg
from pace_envs.tasks.velocity import set_drives

ANYMAL = "Pace-AnymalD-Velocity-v0"


def make(num_envs=2, task=ANYMAL, **fields) -> ManagerBasedRLEnv:
    cfg = load_env_cfg(task)
    cfg.scene.num_envs, cfg.seed = num_envs, 0
    for name, value in fields.items():
        setattr(cfg, name, value)
    return ManagerBasedRLEnv(cfg)


@pytest.fixture(scope="module")
def env():
    env = make(events={}, curriculum={})
    yield env
    env.close()


def put(env, roll=0.0, pitch=0.0, yaw=0.0, velocity=(0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0), height=0.6) -> None:
    quat = quaternions.from_euler(torch.tensor([[roll, pitch, yaw]], dtype=torch.float64))
    state = torch.cat([torch.tensor([[0.0, 0.0, height]]), quat, torch.tensor([[*velocity, *rates]])], dim=1)
    env.scene["robot"].write_root_state_to_sim(state)


def command(env, *values) -> None:
    env.command_manager.get_command("base_velocity")[:] = torch.tensor(values, dtype=torch.float64)


def test_quaternions_rotate_as_by_hand():
    yaw = quaternions.from_euler(torch.tensor([[0.0, 0.0, math.pi / 2]], dtype=torch.float64))
    ahead = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    assert quaternions.rotate_inverse(yaw, ahead)[0].tolist() == pytest.approx([0.0, -1.0, 0.0])
    twice = quaternions.multiply(yaw, yaw)
    assert quaternions.rotate_inverse(twice, ahead)[0].tolist() == pytest.approx([-1.0, 0.0, 0.0])


def test_down_is_what_rotating_gravity_gives():
    quat = quaternions.from_euler(torch.randn(50, 3, dtype=torch.float64))
    gravity = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(50, 3)
    torch.testing.assert_close(quaternions.down(quat), quaternions.rotate_inverse(quat, gravity))


def test_the_base_speaks_in_its_own_frame(env):
    put(env, yaw=math.pi / 2, velocity=(1.0, 2.0, 3.0), rates=(0.1, 0.2, 0.3))
    assert mdp.base_lin_vel(env)[0].tolist() == pytest.approx([2.0, -1.0, 3.0])
    assert mdp.base_ang_vel(env)[0].tolist() == pytest.approx([0.1, 0.2, 0.3])
    put(env, pitch=0.3)
    assert mdp.projected_gravity(env)[0].tolist() == pytest.approx([math.sin(0.3), 0.0, -math.cos(0.3)])
    assert mdp.flat_orientation_l2(env)[0] == pytest.approx(math.sin(0.3) ** 2)


def test_tracking_is_one_on_the_command_and_falls_with_the_error(env):
    put(env, velocity=(0.5, 0.0, 0.0), rates=(0.0, 0.0, 0.2))
    command(env, 0.5, 0.0, 0.2)
    assert mdp.track_lin_vel_xy_exp(env, 0.5, "base_velocity")[0] == pytest.approx(1.0)
    assert mdp.track_velocity_exp(env, 0.5, "base_velocity")[0] == pytest.approx(1.0)
    command(env, 0.5, 0.5, 0.7)
    assert mdp.track_lin_vel_xy_exp(env, 0.5, "base_velocity")[0] == pytest.approx(math.exp(-1))
    assert mdp.track_ang_vel_z_exp(env, 0.5, "base_velocity")[0] == pytest.approx(math.exp(-1))


def test_unwanted_motion_is_squared(env):
    put(env, velocity=(1.0, 1.0, 0.5), rates=(0.3, 0.4, 5.0))
    assert mdp.lin_vel_z_l2(env)[0] == pytest.approx(0.25)
    assert mdp.ang_vel_xy_l2(env)[0] == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("roll", "height", "tilted", "low"), [(0.0, 0.6, False, False), (1.1, 0.6, True, False), (0.0, 0.2, False, True)]
)
def test_a_tilted_or_low_base_has_fallen(env, roll, height, tilted, low):
    put(env, roll=roll, height=height)
    assert mdp.bad_orientation(env, limit_angle=1.0).tolist() == [tilted] * 2
    assert mdp.root_height_below_minimum(env, minimum_height=0.3).tolist() == [low] * 2


def test_a_simulation_that_is_no_number_ends():
    env = make()
    env.reset()
    env.sim.qvel[1, 3] = float("nan")
    assert mdp.diverged(env).tolist() == [False, True]
    *_, terminated, _, _ = env.step(torch.zeros(2, 12))
    assert terminated.tolist() == [False, True]
    obs, *_ = env.step(torch.zeros(2, 12))
    assert obs["policy"].isfinite().all()


def test_motor_power_is_heat_and_mechanical_power():
    torque = torch.tensor([[2.0, -3.0]], dtype=torch.float64)
    velocity = torch.tensor([[4.0, 5.0]], dtype=torch.float64)
    copper = torch.tensor([0.5, 0.1], dtype=torch.float64)
    heat = 0.5 * 4 + 0.1 * 9
    assert mdp.motor_power(torque, velocity, copper).item() == pytest.approx(heat + 8 - 15)
    assert mdp.motor_power(torque, velocity, copper, regeneration=0.0).item() == pytest.approx(heat + 8)


def test_the_power_term_sees_the_drives_constants_by_joint():
    term = RewardTermCfg(
        func=mdp.electrical_power, weight=1.0, params={"copper_loss": {".*HAA": 1.0, ".*(HFE|KFE)": 0.0}}
    )
    env = make(rewards={"energy": term}, events={}, curriculum={})
    data = env.scene["robot"].data
    data.applied_torque = torch.full((2, 12), 3.0, dtype=torch.float64)
    data.joint_vel[:] = 0.0
    assert env.reward_manager.compute(1.0).tolist() == pytest.approx([4 * 9.0] * 2)


def test_the_encoder_shows_its_bias():
    env = make()
    env.reset()
    plain = mdp.encoder_pos_rel(env)
    assert torch.equal(plain, mdp.joint_pos_rel(env))
    env.scene["robot"].actuators["legs"].update_encoder_bias(0.1)
    torch.testing.assert_close(mdp.encoder_pos_rel(env), plain - 0.1)


def test_long_steps_are_paid_at_landing_and_not_when_standing(env):
    feet = env.scene.sensors["feet"]
    feet.first_contact[:] = torch.tensor([[True, False, True, False]])
    feet.last_air_time[:] = torch.tensor([[0.7, 9.0, 0.4, 9.0]], dtype=torch.float64)
    command(env, 0.5, 0.0, 0.0)
    assert mdp.feet_air_time(env, "feet", "base_velocity", 0.5)[0] == pytest.approx(0.2 - 0.1)
    command(env, 0.05, 0.0, 1.0)
    assert mdp.feet_air_time(env, "feet", "base_velocity", 0.5)[0] == 0.0


# ---- contacts


def test_standing_feet_carry_the_weight_and_nothing_else_touches():
    env = make(events={})
    env.reset()
    for _ in range(100):
        env.step(torch.zeros(2, 12))
    feet = env.scene.sensors["feet"]
    assert feet.geom_names == ["LF_foot", "RF_foot", "LH_foot", "RH_foot"]
    weight = 9.81 * float(env.sim.model.body_mass.sum())
    assert feet.net_forces_w.sum(dim=1)[0].tolist() == pytest.approx([0.0, 0.0, weight], abs=0.02 * weight)
    assert feet.in_contact.all() and (feet.current_contact_time > 1.0).all() and (feet.current_air_time == 0).all()
    assert mdp.undesired_contacts(env, ("knees", "base")).tolist() == [0.0, 0.0]
    assert (mdp.feet_slide(env, "feet") < 0.05).all()


def test_flight_is_timed_from_the_last_touch_to_landing():
    env = make(1, events={}, terminations={}, curriculum={})
    env.reset()
    feet = env.scene.sensors["feet"]
    steps = 0
    while not feet.first_contact.any():
        env.step(torch.zeros(1, 12))
        steps += 1
    landed = feet.first_contact
    assert 2 < steps < 50
    torch.testing.assert_close(feet.last_air_time[landed], torch.full_like(feet.last_air_time[landed], steps * 0.02))


def test_only_named_geoms_collide():
    env = make()
    model = env.sim.model
    colliding = {model.geom(i).name for i in range(model.ngeom) if model.geom_conaffinity[i]}
    legs = ("LF", "RF", "LH", "RH")
    feet, knees = {f"{leg}_foot" for leg in legs}, {f"{leg}_shank_knee" for leg in legs}
    assert colliding - {"terrain"} == feet | knees | {"base_trunk"}


def test_a_misspelt_collision_geom_is_named():
    cfg = load_env_cfg(ANYMAL)
    cfg.scene.terrain.collision_geoms = ".*_hoof"
    with pytest.raises(ValueError, match=r"'\.\*_hoof' matches no colliding geom or body\. Available: .*LF_foot"):
        ManagerBasedRLEnv(cfg)


def test_velocities_must_have_been_asked_for():
    env = make()
    with pytest.raises(ValueError, match="track_velocity=True"):
        env.scene.sensors["base"].lin_vel_w  # noqa: B018


# ---- randomisation, curriculum


def test_friction_and_mass_are_drawn_for_each_environment():
    cfg = load_cfg(RunSettings(task=ANYMAL, num_envs=16, randomize=True))
    env = ManagerBasedRLEnv(cfg)
    friction = env.sim.expand("geom_friction")[:, env.scene.sensors["feet"].geom_ids, 0]
    assert (friction >= 0.4).all() and (friction <= 1.0).all()
    assert (friction == friction[:, :1]).all() and friction[:, 0].unique().numel() == 16
    base = env.sim.model.body("base").id
    nominal = float(env.sim.model.body_mass[base])
    added = env.sim.expand("body_mass")[:, base] - nominal
    assert (added >= -1.0).all() and (added <= 2.0).all() and added.unique().numel() == 16
    ratio = env.sim.expand("body_inertia")[:, base] / torch.as_tensor(env.sim.model.body_inertia[base])
    torch.testing.assert_close(ratio, (1 + added / nominal)[:, None].expand(-1, 3))
    assert env.event_manager.active_terms["interval"] == ["push"]


def test_a_mass_that_could_vanish_is_refused():
    env = make()
    with pytest.raises(ValueError, match=r"mass_range starts at -50 kg .* 26\.3"):
        mdp.randomize_body_mass(env, torch.arange(2), SceneEntityCfg(body_names="base").resolve(env), (-50.0, 1.0))


def test_the_command_grows_when_it_is_tracked_and_only_then():
    env = make(8)
    term = env.command_manager.get_term("base_velocity")
    assert term.scale == 0.5
    ids = torch.arange(8)
    full = env.max_episode_length_s * 1.0
    env.reward_manager.episode_sums["track_velocity"][:] = 0.5 * full
    env.curriculum_manager.compute(ids)
    assert term.scale == 0.5
    for expected in (0.6, 0.7, 0.8, 0.9, 1.0, 1.0):
        env.reward_manager.episode_sums["track_velocity"][:] = 0.9 * full
        env.curriculum_manager.compute(ids)
        assert term.scale == pytest.approx(expected)
    assert env.curriculum_manager.reset(ids) == {"Curriculum/command_range": pytest.approx(1.0)}


def test_commands_keep_to_the_scale():
    env = make(512)
    env.reset()
    term = env.command_manager.get_term("base_velocity")
    assert 0.45 < term.command.abs().max() <= 0.5
    term.scale = 1.0
    term.reset(torch.arange(512))
    assert 0.9 < term.command.abs().max() <= 1.0


def test_the_error_of_an_episode_is_logged_with_its_end(env):
    term = env.command_manager.get_term("base_velocity")
    term.reset(torch.arange(2))
    term.time_left[:] = 9.0
    for speed in (0.2, 0.4):
        put(env, velocity=(speed, 0.0, 0.0))
        command(env, 0.0, 0.0, 0.5)
        term.compute(0.02)
    log = env.command_manager.reset(torch.tensor([1]))
    assert log == {
        "Metrics/base_velocity/error_vel_xy": pytest.approx(0.3),
        "Metrics/base_velocity/error_vel_yaw": pytest.approx(0.5),
    }
    assert env.command_manager.reset(torch.tensor([1])) == {}


def says(env, env_ids):
    return {"ended": len(env_ids)}


def test_curriculum_terms_see_the_environments_that_end_and_are_logged():
    env = make(
        3,
        curriculum={"size": CurriculumTermCfg(func=says)},
        terminations={"time_out": TerminationTermCfg(func=mdp.time_out, time_out=True)},
    )
    env.reset()
    env.episode_length_buf[1] = env.max_episode_length - 1
    *_, terminated, truncated, extras = env.step(torch.zeros(3, 12))
    assert truncated.tolist() == [False, True, False] and not terminated.any()
    assert extras["log"]["Curriculum/size/ended"] == 1.0


def test_other_drives_are_one_call():
    cfg = load_env_cfg(ANYMAL)
    drive = cfg.scene.robot.actuators["legs"]
    drive.armature, drive.stiffness = 0.07, 60.0
    set_drives(cfg, {"identified": drive})
    cfg.scene.num_envs = 1
    env = ManagerBasedRLEnv(cfg)
    assert (env.scene["robot"].actuators["identified"].stiffness == 60.0).all()
    assert (env.sim.expand("dof_armature")[0, 6:] == 0.07).all()
