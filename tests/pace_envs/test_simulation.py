"""The physics: written parameters have their textbook effect, and results do not depend on how they are computed."""

import math
import os
from functools import cache

import mujoco
import numpy as np
import pytest
import torch

from pace_envs import ManagerBasedRLEnv, load_env_cfg, set_physics_dt
from pace_envs.mujoco_warnings import collected
from pace_envs.robots import apply_test_bench_load
from pace_envs.simulation import SimulationCfg, available_processors, make_simulation

MASS, LENGTH, GRAVITY = 1.0, 0.2, 9.81
INERTIA = MASS * LENGTH**2


def bench(num_envs=1, *, gravity=True, physics_dt=None, **drive) -> ManagerBasedRLEnv:
    """The test bench with a drive that does only what it is told here."""
    cfg = load_env_cfg("Pace-TestBench-v0")
    cfg.scene.num_envs, cfg.seed = num_envs, 0
    values = {"stiffness": 0.0, "damping": 0.0, "effort_limit": None, "saturation_effort": None} | drive
    for name, value in values.items():
        setattr(cfg.scene.robot.actuators["servo"], name, value)
    if not gravity:
        cfg.sim.gravity = (0.0, 0.0, 0.0)
    if physics_dt is not None:
        set_physics_dt(cfg, physics_dt)
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    return env


def start(env, position=0.0, velocity=0.0, effort=None) -> None:
    robot, ones = env.scene["robot"], torch.ones(env.num_envs, 1, dtype=torch.float64)
    robot.write_joint_state_to_sim(position * ones, velocity * ones)
    if effort is not None:
        robot.set_joint_effort_target(effort * ones)


def roll(env, duration: float, target=0.0) -> torch.Tensor:
    """Positions (steps + 1, num_envs) under a constant target."""
    action = torch.full((env.num_envs, 1), target, dtype=torch.float64)
    data, positions = env.scene["robot"].data, [env.scene["robot"].data.joint_pos[:, 0].clone()]
    for _ in range(round(duration / env.step_dt)):
        env.simulate(action)
        positions.append(data.joint_pos[:, 0].clone())
    return torch.stack(positions)


# ---- closed forms on the test bench: a point mass of 1 kg at 0.2 m


@pytest.mark.slow
@pytest.mark.parametrize("armature", [0.0, 0.02, 0.1])
def test_armature_slows_the_pendulum(armature):
    env = bench(armature=armature)
    start(env, position=0.02)
    q = roll(env, 4.0)[:, 0].numpy()
    down = np.flatnonzero((q[:-1] > 0) & (q[1:] <= 0))
    crossings = (down + q[down] / (q[down] - q[down + 1])) * env.step_dt
    period = np.diff(crossings).mean()
    expected = 2 * math.pi * math.sqrt((INERTIA + armature) / (MASS * GRAVITY * LENGTH))
    assert period == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("viscous_friction", [0.5, 4.5])
def test_viscous_friction_sets_the_terminal_velocity(viscous_friction):
    env = bench(gravity=False, viscous_friction=viscous_friction, armature=0.01)
    start(env, effort=3.0)
    roll(env, 2.0)
    assert env.scene["robot"].data.joint_vel.item() == pytest.approx(3.0 / viscous_friction, rel=1e-6)


@pytest.mark.parametrize("effort", [0.45, -0.45])
def test_a_joint_sticks_below_coulomb_friction(effort):
    env = bench(gravity=False, friction=0.5, armature=0.1)
    start(env, effort=effort)
    assert roll(env, 1.0).abs().max() < 2e-5


def test_stiction_carries_the_load():
    env = bench(friction=0.5, armature=0.1)
    angle = math.asin(0.4 / (MASS * GRAVITY * LENGTH))
    start(env, position=angle)
    assert (roll(env, 1.0) - angle).abs().max() < 1e-3


@pytest.mark.parametrize("effort", [0.7, -0.7])
def test_above_coulomb_friction_it_slides_with_the_rest(effort):
    env = bench(gravity=False, friction=0.5, armature=0.1)
    start(env, effort=effort)
    roll(env, 0.2)
    acceleration = math.copysign(0.7 - 0.5, effort) / (INERTIA + 0.1)
    assert env.scene["robot"].data.joint_vel.item() == pytest.approx(acceleration * 0.2, rel=1e-3)


def test_coulomb_friction_stops_a_coasting_joint():
    env = bench(gravity=False, friction=0.5, armature=0.1)
    start(env, velocity=1.0)
    q = roll(env, 1.0)
    # v^2 / 2a with a = 0.5 / 0.14
    assert q[-1].item() == pytest.approx((INERTIA + 0.1) / (2 * 0.5), rel=2e-2)
    assert env.scene["robot"].data.joint_vel.abs().item() < 1e-3


def test_the_load_sets_the_static_torque():
    env = bench(4, stiffness=200.0, damping=20.0)
    apply_test_bench_load(env, [2], {"load_mass": 3.0})
    apply_test_bench_load(env, [1, 3], {"load_mass": 0.5, "load_length": 0.4, "arm_mass": 0.6})
    q = roll(env, 3.0, target=0.6)[-1]
    held = env.scene["robot"].data.applied_torque[:, 0]
    expected = GRAVITY * torch.tensor([1.0 * 0.2, (0.5 + 0.3) * 0.4, 3.0 * 0.2, (0.5 + 0.3) * 0.4]) * q.sin()
    assert held.tolist() == pytest.approx(expected.tolist(), rel=1e-6)


def test_the_load_sets_the_inertia():
    env = bench(2, gravity=False)
    apply_test_bench_load(env, [1], {"load_mass": 0.5, "load_length": 0.4, "arm_mass": 0.6})
    start(env, effort=1.0)
    roll(env, 0.1)
    inertia = torch.tensor([INERTIA, 0.5 * 0.4**2 + 0.6 * 0.4**2 / 3])
    assert env.scene["robot"].data.joint_vel[:, 0].tolist() == pytest.approx((0.1 / inertia).tolist(), rel=1e-5)


@pytest.mark.parametrize("load", [{"load_mass": -1.0}, {"load_length": 0.0}, {"arm_mass": math.nan}])
def test_an_impossible_load_is_refused(load):
    with pytest.raises(ValueError, match="expected masses >= 0 and a length > 0"):
        apply_test_bench_load(bench(), None, load)


# ---- time step


@pytest.mark.slow
def test_a_finer_physics_step_keeps_the_control_rate():
    drive = {"stiffness": 85.0, "damping": 0.6, "armature": 0.1, "viscous_friction": 4.5, "delay": 2.5}
    coarse, fine = bench(**drive), bench(**drive, physics_dt=0.0005)
    assert fine.cfg.decimation == 5
    assert coarse.step_dt == pytest.approx(fine.step_dt) and fine.physics_dt == pytest.approx(0.0005)
    for env in (coarse, fine):
        start(env, position=0.2)
    a, b = roll(coarse, 1.0, target=0.5), roll(fine, 1.0, target=0.5)
    assert 1e-7 < (a - b).abs().max() < 5e-3


def test_finer_steps_are_of_second_order_with_fast_dynamics_of_a_drive_too():
    cfg = load_env_cfg("Pace-TestBench-v0")
    cfg.set_effects(["joint_elasticity"])
    set_physics_dt(cfg, 0.0005)
    assert cfg.sim.integrator == "leapfrog" and cfg.decimation == 5
    assert cfg.scene.robot.actuators["servo"].control_decimation == 5


@cache
def swung(dt, timeconst=None, amplitude=0.6, friction=0.2):
    """Positions every 10 ms of a joint that a slow torque swings against friction, by steps of second order."""
    cfg = load_env_cfg("Pace-TestBench-v0")
    cfg.sim.dt, cfg.sim.integrator, cfg.sim.gravity = dt, "leapfrog", (0.0, 0.0, 0.0)
    cfg.sim.friction_timeconst = timeconst
    env = ManagerBasedRLEnv(cfg)
    start(env)
    every, seen = round(0.01 / dt), []
    armature, coulomb = (torch.full((1, 1), value, dtype=torch.float64) for value in (0.01, friction))
    env.sim.write_passive(slice(None), armature, coulomb, torch.zeros(1, 1, dtype=torch.float64), None)
    for step in range(200 * every):
        env.sim.qfrc_applied[:] = amplitude * math.sin(2 * math.pi * (step + 0.5) * dt)
        env.sim.step()
        if (step + 1) % every == 0:
            seen.append(env.sim.qpos.item())
    return np.array(seen)


@pytest.mark.slow
def test_friction_of_second_order_steps_gives_way_at_once():
    """What MuJoCo's default of 20 ms smooths where the joint turns is twenty times that of two steps."""
    exact, own, default = swung(0.0001), swung(0.0025), swung(0.0025, timeconst=0.02)
    assert np.abs(own - exact).max() < 0.05 * np.abs(default - exact).max()


def test_friction_of_second_order_steps_turns_within_a_step():
    """At the end of one, it would be 0.4 mrad off."""
    assert np.abs(swung(0.0025) - swung(0.0001)).max() < 3e-5


CHAIN = """
<mujoco><default><joint axis="0 1 0" frictionloss="0.5"/><geom type="capsule" size="0.03" mass="1"/></default>
<worldbody><body><joint/><geom fromto="0 0 0 0.3 0 0"/>
  <body pos="0.3 0 0"><joint/><geom fromto="0 0 0 0.3 0 0"/>
    <body pos="0.3 0 0"><joint/><geom fromto="0 0 0 0.3 0 0"/></body>
</body></body></worldbody></mujoco>
"""


def chains_pushed(steps):
    """Speeds of 200 folded chains of three links, (200, 3), after 2.5 ms of torques against friction."""
    cfg = SimulationCfg(dt=0.0025 / steps, integrator="leapfrog", gravity=(0.0, 0.0, 0.0))
    sim, generator = make_simulation(cfg, mujoco.MjSpec.from_string(CHAIN), 200), torch.Generator().manual_seed(0)
    sim.qpos[:] = torch.tensor([[0.0, 2.4, -2.4]])
    sim.qvel[:] = 0.03 * torch.randn(200, 3, generator=generator, dtype=torch.float64)
    sim.qfrc_applied[:] = torch.randn(200, 3, generator=generator, dtype=torch.float64)
    for _ in range(steps):
        sim.step()
    return sim.qvel.clone()


@pytest.mark.slow
def test_friction_of_joints_that_push_each_other_turns_within_a_step():
    """At the end of a step, the speeds would be 8 % off; by what each joint feels in the model's posture, 5 %."""
    exact = chains_pushed(200)
    assert float((chains_pushed(1) - exact).square().mean().sqrt()) < 0.03 * float(exact.square().mean().sqrt())


def chain_whirled(steps):
    """Angles of a chain of three links without friction, (3,), after it has turned fast for 0.2 s."""
    cfg = SimulationCfg(dt=0.0025 / steps, integrator="leapfrog", gravity=(0.0, 0.0, 0.0))
    sim = make_simulation(cfg, mujoco.MjSpec.from_string(CHAIN.replace('frictionloss="0.5"', "")), 1)
    sim.qpos[:], sim.qvel[:] = torch.tensor([[0.0, 0.8, -1.2]]), torch.tensor([[3.0, -2.0, 4.0]])
    for _ in range(80 * steps):
        sim.step()
    return sim.qpos[0].clone()


@pytest.mark.slow
def test_coriolis_forces_are_of_second_order():
    """At the speed before a step, half of the step would leave half of the error."""
    exact = chain_whirled(50)
    coarse, fine = (float((chain_whirled(steps) - exact).norm()) for steps in (2, 4))
    assert coarse < 1e-3 and fine < 0.3 * coarse


def test_a_reset_forgets_what_speeds_gained():
    cfg = SimulationCfg(dt=0.0025, integrator="leapfrog", gravity=(0.0, 0.0, 0.0))
    sim, ends = make_simulation(cfg, mujoco.MjSpec.from_string(CHAIN), 2), []
    for _ in range(2):
        sim.qvel[:] = torch.tensor([[3.0, -2.0, 4.0]])
        for _ in range(3):
            sim.step()
        ends.append(sim.qpos.clone())
        sim.reset([1])
        sim.qpos[0], sim.qfrc_applied[:] = sim.qpos[1], 0.0
    assert torch.equal(ends[0][1], ends[1][1]) and not torch.equal(ends[0][0], ends[1][0])


def test_friction_of_second_order_steps_holds():
    assert np.abs(swung(0.0025, amplitude=0.19)).max() < 1e-4


@pytest.mark.parametrize("integrator", ["implicitfast", "leapfrog"])
def test_implicit_damping_acts_on_the_speed_after_the_step(integrator):
    """(M + J) (v₊ - v) = h (τ - D v₊), whatever D is."""
    cfg = load_env_cfg("Pace-TestBench-v0")
    cfg.sim.integrator, cfg.sim.gravity = integrator, (0.0, 0.0, 0.0)
    env = ManagerBasedRLEnv(cfg)
    start(env, velocity=2.0)
    sim, h = env.sim, env.physics_dt
    armature, damping, effort = 0.05, 500.0, 3.0

    def of(value):
        return torch.full((1, 1), value, dtype=torch.float64)

    sim.qfrc_applied[:] = effort
    sim.write_passive(slice(None), of(armature), of(0.0), of(0.0), of(damping))
    sim.step()
    expected = ((INERTIA + armature) * 2.0 + h * effort) / (INERTIA + armature + h * damping)
    assert float(sim.qvel) == pytest.approx(expected, rel=1e-9)


def test_finer_steps_bear_any_torque_speed_line():
    """An explicit damping would diverge beyond 2 M / h. The first step moves with the mean of its speeds."""
    speed, step, damping = 2.0, 0.00125, 2000.0
    env = bench(gravity=False, physics_dt=step, damping=0.0, armature=0.01, viscous_friction=damping)
    start(env, velocity=speed)
    q = roll(env, 0.2)[:, 0]
    assert float(q.max()) < speed * (0.5 * step + 2 * (INERTIA + 0.01) / damping) and float(q.min()) >= -1e-9


@pytest.mark.parametrize("integrator", ["implicitfast", "leapfrog"])
def test_between_control_steps_the_torque_is_held(integrator):
    cfg = load_env_cfg("Pace-TestBench-v0")
    cfg.set_effects(["backlash"])
    set_physics_dt(cfg, 0.0005)
    cfg.sim.integrator = integrator
    env = ManagerBasedRLEnv(cfg)
    start(env, position=0.2)
    robot, seen = env.scene["robot"], []
    env.action_manager.process_action(torch.full((1, 1), 0.5, dtype=torch.float64))
    for _ in range(10):
        env.action_manager.apply_action()
        env.scene.write_data_to_sim()
        env.sim.step()
        env.scene.update()
        seen.append(robot.data.applied_torque.item())
    assert len(set(seen[:5])) == 1 and len(set(seen[6:])) == 1 and seen[0] != seen[6]
    assert seen[5] == pytest.approx(seen[6])


@pytest.mark.parametrize("physics_dt", [0.001, 0.005, 0.0, -0.0025, math.nan, math.inf])
def test_a_physics_step_that_does_not_divide_the_control_step_is_refused(physics_dt):
    with pytest.raises(ValueError, match="expected a whole fraction of the time step"):
        set_physics_dt(load_env_cfg("Pace-TestBench-v0"), physics_dt)


# ---- reproducibility


def anymal_trajectory(num_threads: int, seed: int = 0) -> torch.Tensor:
    cfg = load_env_cfg("Pace-AnymalD-v0")
    cfg.scene.num_envs, cfg.sim.num_threads, cfg.seed = 9, num_threads, seed
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    robot = env.scene["robot"]
    robot.write_joint_friction_coefficient_to_sim(env.uniform((9, 12), 0.0, 0.5))
    robot.write_joint_armature_to_sim(env.uniform((9, 12), 0.01, 0.1))
    positions = []
    for _ in range(60):
        env.simulate(robot.data.default_joint_pos + env.uniform((9, 12), -0.3, 0.3))
        positions.append(robot.data.joint_pos.clone())
    return torch.stack(positions)


def test_results_are_the_same_bit_for_bit_on_any_number_of_threads():
    one = anymal_trajectory(1)
    assert torch.equal(one, anymal_trajectory(2))
    assert torch.equal(one, anymal_trajectory(3))


def test_a_seed_gives_the_same_bits_and_another_seed_others():
    assert torch.equal(anymal_trajectory(0, seed=5), anymal_trajectory(0, seed=5))
    assert not torch.equal(anymal_trajectory(0, seed=5), anymal_trajectory(0, seed=6))


def test_building_an_environment_leaves_torchs_own_random_numbers_alone():
    torch.manual_seed(7)
    expected = torch.rand(3)
    torch.manual_seed(7)
    ManagerBasedRLEnv(load_env_cfg("Pace-TestBench-v0"))
    assert torch.equal(torch.rand(3), expected)


DIVERGE = """
import torch
from pace_envs import ManagerBasedRLEnv, load_env_cfg

def run(effort):
    cfg = load_env_cfg("Pace-TestBench-v0")
    cfg.scene.num_envs, cfg.seed = 5, 0
    cfg.scene.robot.actuators["servo"].effort_limit = cfg.scene.robot.actuators["servo"].saturation_effort = None
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    env.scene["robot"].set_joint_effort_target(torch.tensor([[effort]]), env_ids=[2])
    for _ in range(50):
        obs, *_ = env.step(torch.full((5, 1), 0.4))
    return obs["policy"]

calm, wild = run(0.0), run(1e300)
others = [0, 1, 3, 4]
assert not bool((wild[2].abs() < 1e6).all()), wild[2]
assert torch.equal(calm[others], wild[others])
"""


@pytest.mark.slow
def test_a_diverged_simulation_disturbs_no_other_and_is_quiet(warm, tmp_path):
    done = warm.run("-c", DIVERGE, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert os.listdir(tmp_path) == []


# ---- env_ids


@pytest.mark.parametrize(
    "env_ids",
    [
        [3, 1],
        (1, 3),
        np.array([3, 1, 3]),
        torch.tensor([3, 1]),
        [False, True, False, True],
        np.array([False, True, False, True]),
        torch.tensor([False, True, False, True]),
        slice(1, None, 2),
        slice(3, None, -2),
    ],
    ids=repr,
)
def test_environments_are_named_by_lists_masks_tensors_and_slices(env_ids):
    ids = bench(4).sim.resolve_env_ids(env_ids)
    assert ids.tolist() == [1, 3] and ids.dtype == np.int32


@pytest.mark.parametrize(("env_ids", "message"), [([4], "0 to 3"), ([-1], "0 to 3"), ([True, False], r"\(4,\)")])
def test_environments_that_do_not_exist_are_refused(env_ids, message):
    with pytest.raises(ValueError, match=f"env_ids.*expected {message}"):
        bench(4).sim.resolve_env_ids(env_ids)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": 0.0}, "sim.dt is 0.0 s"),
        ({"dt": 1.0}, "sim.dt is 1.0 s"),
        ({"integrator": "rk45"}, "Unknown integrator 'rk45'. Available: implicitfast"),
        ({"integrator": "rk4"}, 'Write "leapfrog"'),
    ],
)
def test_an_impossible_simulation_is_refused(change, message):
    cfg = load_env_cfg("Pace-TestBench-v0")
    for name, value in change.items():
        setattr(cfg.sim, name, value)
    with pytest.raises(ValueError, match=message):
        ManagerBasedRLEnv(cfg)


def test_no_environments_are_refused():
    with pytest.raises(ValueError, match="num_envs is 0"):
        bench(0)


def test_after_closing_what_was_read_stays_readable():
    env = bench(2)
    position = env.scene["robot"].data.joint_pos
    env.close()
    env.close()
    assert position.tolist() == [[0.0], [0.0]]


def test_threads_are_those_that_the_process_may_use(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3}, raising=False)
    assert available_processors() == 1
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert available_processors() == 5


def test_mujocos_warnings_leave_no_file_in_the_users_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mujoco.set_mju_user_warning(None)
    with collected():  # as a report does, with a run's model
        pass
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qpos[:] = np.nan
    mujoco.mj_step(model, data)
    assert data.warning.number.any() and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("sensors", "textures"), [(True, 1), (False, 0)])
def test_a_model_that_nothing_looks_at_has_no_textures(sensors, textures):
    spec = mujoco.MjSpec.from_string(
        '<mujoco><asset><texture name="t" type="2d" builtin="flat" rgb1="1 0 0" width="64" height="64"/>'
        '<material name="m" texture="t" rgba="0 1 0 1"/></asset>'
        '<worldbody><body><joint/><geom size="0.1" material="m"/></body></worldbody></mujoco>'
    )
    model = make_simulation(SimulationCfg(sensors=sensors), spec, 1).model
    assert model.ntex == textures and model.mat_rgba.tolist() == [[0, 1, 0, 1]]
