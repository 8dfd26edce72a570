"""Configurations as PACE's and Isaac Lab's users write them: defaults, checks at use, and the delay they deploy."""

import dataclasses

import gymnasium as gym
import pytest
import torch

from pace_actuators import ActuatorActions, PaceDCMotor, PaceDCMotorCfg, configclass
from pace_envs import ArticulationCfg, InitialStateCfg, ManagerBasedRLEnv, load_env_cfg
from pace_envs.assets_dir import ASSETS_DIR
from pace_envs.robots import anymal_d_cfg, go2_cfg
from pace_envs.tasks.pace import PaceCfg, PaceSim2realEnvCfg, PaceSim2realSceneCfg, base_parameters
from pace_envs.tasks.velocity import set_drives
from pace_optim.estimate.cmaes_optimizer import CMAESOptimizerCfg

GAINS = {"stiffness": 10.0, "damping": 0.0}


# ---- max_delay, as in PACE


def lag_of(dt: float = 0.005, **fields) -> float:
    """Control steps until a step of the target is felt."""
    motor = PaceDCMotor(PaceDCMotorCfg(joint_names_expr=".*", **GAINS, **fields), ["j"], slice(None), 1, physics_dt=dt)
    zero, one = torch.zeros(1, 1), torch.ones(1, 1)
    motor.compute(ActuatorActions(zero), zero, zero)
    for k in range(30):
        if float(motor.compute(ActuatorActions(one), zero, zero).joint_efforts) > 9.99:
            return k
    return 30


@pytest.mark.parametrize("mode", ["command", "effort"])
def test_a_drive_with_a_max_delay_alone_acts_with_that_delay(mode):
    assert lag_of(max_delay=4, delay_mode=mode) == 4
    assert lag_of(max_delay=4.0, delay=1.0, delay_mode=mode) == 1
    assert lag_of(max_delay=4.0, delay=0.0, delay_mode=mode) == 0
    assert lag_of(max_delay=4.0, delay_s=0.01, delay_mode=mode) == 2
    assert lag_of(delay_mode=mode) == 0


def test_the_largest_delay_can_still_be_set_later():
    motor = PaceDCMotor(PaceDCMotorCfg(joint_names_expr=".*", **GAINS), ["j"], slice(None), 1)
    motor.update_time_lags(10.0)
    with pytest.raises(ValueError, match="expected 0 to max_delay = 10"):
        motor.update_time_lags(11.0)


def walking_torques(**fields) -> torch.Tensor:
    cfg = load_env_cfg("Pace-Go2-Velocity-v0")
    cfg.scene.num_envs, cfg.sim.num_threads, cfg.seed = 1, 1, 0
    drives = {name: dataclasses.replace(drive, **fields) for name, drive in go2_cfg().actuators.items()}
    set_drives(cfg, drives)
    env = ManagerBasedRLEnv(cfg)
    env.reset()
    torques = []
    for action in (0.5, -0.5, 0.5):
        env.step(torch.full((1, 12), action))
        torques.append(env.scene["robot"].data.applied_torque.clone())
    env.close()
    return torch.cat(torques)


def test_a_training_task_acts_with_the_max_delay_that_is_deployed():
    deployed = walking_torques(max_delay=6)
    assert torch.equal(deployed, walking_torques(delay=6.0))
    assert not torch.allclose(deployed, walking_torques(delay=0.0, max_delay=6), atol=0.1)


def test_an_identification_sets_the_delay_itself_up_to_its_bound():
    cfg = load_env_cfg("Pace-SO101-v0")
    drive = cfg.scene.robot.actuators["servos"]
    assert (drive.delay, drive.max_delay) == (0.0, 80.0)
    cfg.scene.robot.actuators["servos"] = dataclasses.replace(drive, delay=None, max_delay=90.0)
    env = ManagerBasedRLEnv(cfg)
    assert float(env.scene["robot"].actuators["servos"].time_lags.max()) == 0.0
    env.close()


# ---- friction at rest and while sliding


def test_static_friction_is_friction_and_sliding_friction_an_effect():
    cfg = PaceDCMotorCfg(joint_names_expr=".*", **GAINS, static_friction=0.5, dynamic_friction=0.2)
    assert cfg.friction == 0.5 and cfg.effects[0].effect == "dynamic_friction"
    assert cfg.effects[0].values == {"ratio": pytest.approx(0.4)}
    assert cfg.replace(stiffness=3.0).effects == cfg.effects
    by_joint = PaceDCMotorCfg(
        joint_names_expr=".*", friction={"a": 0.4, "b": 0.2}, dynamic_friction={"a": 0.1, "b": 0.1}
    )
    assert by_joint.effects[0].values["ratio"] == {"a": pytest.approx(0.25), "b": pytest.approx(0.5)}
    assert PaceDCMotorCfg(joint_names_expr=".*", friction=0.3, dynamic_friction=0.3).effects == ()


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"friction": 0.1, "static_friction": 0.2}, "Give one of them"),
        ({"dynamic_friction": 0.2}, "Give friction"),
        ({"friction": 0.1, "dynamic_friction": 0.2}, "expected 0 to the friction at rest, 0.1 N m"),
        ({"friction": {"a": 0.1}, "dynamic_friction": {"b": 0.1}}, "values of the same joints"),
    ],
)
def test_frictions_that_contradict_each_other_are_refused(fields, said):
    with pytest.raises(ValueError, match=said):
        PaceDCMotorCfg(joint_names_expr=".*", **fields)


# ---- classes in PACE's form


@configclass
class BenchPaceCfg(PaceCfg):
    """The form of the tutorial: defaults that can change, and a __post_init__ without super()."""

    robot_name: str = "bench_sim"
    data_dir: str = "bench_sim/chirp_data.pt"
    bounds_params: torch.Tensor = torch.zeros((5, 2))
    joint_order: list[str] = ["servo"]  # noqa: RUF012  # as in PACE

    def __post_init__(self):
        self.bounds_params[:3, 1] = 1.0
        self.bounds_params[3, :] = torch.tensor([-0.1, 0.1])
        self.bounds_params[4, 1] = 20.0


@configclass
class BenchSceneCfg(PaceSim2realSceneCfg):
    """A scene in that form."""

    robot: ArticulationCfg = ArticulationCfg(
        mjcf_path=ASSETS_DIR / "test_bench" / "test_bench.xml",
        init_state=ArticulationCfg.InitialStateCfg(pos=(0.0, 0.0, 1.0)),
        actuators={"drive": PaceDCMotorCfg(joint_names_expr=["servo"], stiffness={".*": 85.0}, damping={".*": 0.6})},
    )


@configclass
class BenchEnvCfg(PaceSim2realEnvCfg):
    """An environment in that form."""

    scene: BenchSceneCfg = BenchSceneCfg()
    sim2real: PaceCfg = BenchPaceCfg()

    def __post_init__(self):
        super().__post_init__()
        self.sim.dt = 0.0025
        self.decimation = 1


def test_a_configuration_in_paces_form_builds_its_environment():
    gym.register(
        id="Isaac-Pace-Bench-v0",
        entry_point="isaaclab.envs:ManagerBasedRLEnv",
        disable_env_checker=True,
        kwargs={"env_cfg_entry_point": f"{__name__}:BenchEnvCfg"},
    )
    try:
        cfg = load_env_cfg("Isaac-Pace-Bench-v0")
    finally:
        del gym.registry["Isaac-Pace-Bench-v0"]
    assert cfg.sim2real.joint_order == ("servo",) == cfg.scene.robot.joint_order
    assert cfg.scene.robot.fix_base and cfg.scene.robot.actuators["drive"].max_delay == 20.0
    env = ManagerBasedRLEnv(cfg)
    assert env.scene["robot"].joint_names == ["servo"]
    env.close()


def test_instances_share_no_default_that_can_change():
    first, second = BenchEnvCfg(), BenchEnvCfg()
    first.sim2real.bounds_params[0, 1] = 9.0
    second.prepare()
    first.sim2real.joint_order.append("more")
    first.scene.robot.actuators["drive"].max_delay = 3
    assert float(second.sim2real.bounds["armature"][0, 1]) == 1.0 and second.sim2real.joint_order == ("servo",)
    assert second.scene.robot.actuators["drive"].max_delay == 20.0


def test_bounds_of_other_joints_are_refused_at_use_whatever_post_init_does():
    @configclass
    class Wrong(BenchPaceCfg):
        bounds_params: torch.Tensor = torch.zeros((36, 2))
        joint_order: list[str] = [f"joint{i}" for i in range(1, 8)]  # noqa: RUF012

        def __post_init__(self):
            self.bounds_params[:, 1] = 1.0

    wrong = Wrong()
    with pytest.raises(ValueError, match=r"shape \(36, 2\), expected \(29, 2\)"):
        base_parameters(wrong)
    with pytest.raises(ValueError, match=r"shape \(36, 2\), expected \(29, 2\)"):
        ManagerBasedRLEnv(BenchEnvCfg(sim2real=wrong))


def test_a_default_of_a_base_class_needs_no_annotation():
    @configclass
    class Longer(CMAESOptimizerCfg):
        max_iteration = 500
        save_optimization_process = True

    assert (Longer().max_iteration, Longer().save_optimization_process, Longer().sigma) == (500, True, 0.5)


def test_a_class_without_a_decorator_is_refused_instead_of_ignored():
    class Forgotten(CMAESOptimizerCfg):
        max_iteration = 500

    with pytest.raises(TypeError, match=r"Forgotten sets max_iteration.*Write @configclass above it"):
        Forgotten()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: anymal_d_cfg().replace(prim_path="{ENV_REGEX_NS}/Robot"), "no prim_path: MuJoCo has no stage"),
        (lambda: ArticulationCfg(spawn=None), "write mjcf_path='robot.xml'"),
        (lambda: PaceSim2realSceneCfg(robot=anymal_d_cfg(), env_spacing=2.5), "a world each"),
        (lambda: PaceDCMotorCfg(joint_names_expr=".*", min_delay=1), "write delay"),
        (lambda: PaceDCMotorCfg(joint_names_expr=".*", stifness=1), "Did you mean 'stiffness'"),
    ],
)
def test_a_name_that_is_no_field_is_answered_with_the_line_to_write(make, said):
    with pytest.raises(TypeError, match=said):
        make()


def test_replace_changes_a_copy():
    robot = anymal_d_cfg()
    other = robot.replace(init_state=InitialStateCfg(pos=(0.0, 0.0, 1.0)))
    assert (other.init_state.pos[2], robot.init_state.pos[2]) == (1.0, 0.6)
    assert ArticulationCfg.InitialStateCfg is InitialStateCfg


def test_an_entry_point_that_returns_no_configuration_is_refused():
    gym.register(id="Pace-Nothing-v0", kwargs={"env_cfg_entry_point": lambda: None}, entry_point="x:y")
    try:
        with pytest.raises(ValueError, match="expected the configuration of an environment"):
            load_env_cfg("Pace-Nothing-v0")
    finally:
        del gym.registry["Pace-Nothing-v0"]


def test_a_relative_recording_that_is_not_there_is_one_under_data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cfg = BenchPaceCfg()
    assert cfg.recording.as_posix() == "data/bench_sim/chirp_data.pt"
    (tmp_path / "bench_sim").mkdir()
    (tmp_path / "bench_sim" / "chirp_data.pt").touch()
    assert cfg.recording.as_posix() == "bench_sim/chirp_data.pt"
    assert dataclasses.replace(cfg, data_dir="data/x.npz").recording.as_posix() == "data/x.npz"
