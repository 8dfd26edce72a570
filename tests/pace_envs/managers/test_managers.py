"""Managers: terms are resolved once, checked, and see only the environments that they are called for."""

import pytest
import torch

from pace_envs import ManagerBasedRLEnv, load_env_cfg, mdp
from pace_envs.managers import (
    EventTermCfg,
    ManagerTermBase,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
    UniformNoiseCfg,
)


def make(num_envs=4, task="Pace-TestBench-v0", **fields) -> ManagerBasedRLEnv:
    cfg = load_env_cfg(task)
    cfg.scene.num_envs, cfg.seed = num_envs, 0
    for name, value in fields.items():
        setattr(cfg, name, value)
    return ManagerBasedRLEnv(cfg)


def act(env, value=0.0) -> torch.Tensor:
    return torch.full((env.num_envs, env.action_manager.total_action_dim), value)


# ---- terms


def number(env, value):
    return torch.full((env.num_envs,), value, dtype=torch.float64)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"valeu": 1.0}, "'x' got unknown params valeu. Params of its function: value"),
        ({}, "'x' lacks value"),
        ({"env": 1.0}, "unknown params env"),
    ],
)
def test_params_that_do_not_fit_the_function_are_refused(params, message):
    with pytest.raises(ValueError, match=message):
        make(rewards={"x": RewardTermCfg(func=number, params=params, weight=1.0)})


def test_an_entity_is_resolved_once_and_the_configuration_left_alone():
    knees = SceneEntityCfg(joint_names=".*KFE")
    term = ObservationTermCfg(func=mdp.joint_pos, params={"asset_cfg": knees})
    env = make(task="Pace-AnymalD-v0", observations={"policy": ObservationGroupCfg(terms={"knees": term})})
    obs, _ = env.reset()
    assert obs["policy"][0].tolist() == pytest.approx([-0.8, -0.8, 0.8, 0.8])
    assert knees.joint_ids == slice(None)


class Count(ManagerTermBase):
    """Calls since the last reset."""

    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.calls = torch.zeros(env.num_envs, 1, dtype=torch.float64)

    def __call__(self, env, step=1.0):
        self.calls += step
        return self.calls

    def reset(self, env_ids):
        self.calls[env_ids] = 0.0


def test_a_class_term_is_built_once_and_reset_where_an_episode_ends():
    term = ObservationTermCfg(func=Count, params={"step": 2.0})
    env = make(3, observations={"policy": ObservationGroupCfg(terms={"count": term})})
    env.reset()
    env.step(act(env))
    obs, _ = env.reset(env_ids=[1])
    assert obs["policy"].flatten().tolist() == [6.0, 2.0, 6.0]
    with pytest.raises(ValueError, match="unknown params stepp"):
        make(rewards={"x": RewardTermCfg(func=Count, params={"stepp": 2.0}, weight=1.0)})


def test_a_term_set_to_none_is_off():
    assert make(rewards={"x": None}).reward_manager.active_terms == []


# ---- actions


def test_an_action_is_scaled_and_offset_to_a_target():
    action = mdp.JointPositionActionCfg(
        scale={".*HAA": 0.5, ".*(HFE|KFE)": 2.0}, offset={"LF_HAA": 0.1}, use_default_offset=False
    )
    env = make(task="Pace-AnymalD-v0", actions={"joint_pos": action})
    env.step(act(env, 0.4))
    target = env.scene["robot"].data.joint_pos_target[0]
    assert target[:6].tolist() == pytest.approx([0.3, 0.8, 0.8, 0.2, 0.8, 0.8])


def test_default_positions_are_the_offset_where_asked():
    env = make(task="Pace-AnymalD-v0", actions={"joint_pos": mdp.JointPositionActionCfg(scale=0.5)})
    env.step(act(env, 1.0))
    data = env.scene["robot"].data
    assert torch.allclose(data.joint_pos_target, data.default_joint_pos + 0.5)


def test_several_action_terms_share_the_action_in_order():
    terms = {
        "knees": mdp.JointPositionActionCfg(joint_names=("RH_KFE", "LF_KFE"), preserve_order=True),
        "hips": mdp.JointPositionActionCfg(joint_names="LF_H.*", use_default_offset=False),
    }
    env = make(task="Pace-AnymalD-v0", actions=terms)
    assert env.action_manager.total_action_dim == 4
    env.step(torch.tensor([[1.0, 2.0, 3.0, 4.0]]).expand(4, 4))
    data = env.scene["robot"].data
    assert data.joint_pos_target[0, :3].tolist() == pytest.approx([3.0, 4.0, 2.0 - 0.8])
    assert data.joint_pos_target[0, 11].item() == pytest.approx(1.0 + 0.8)
    assert torch.equal(data.joint_pos_target[:, 3:11], data.default_joint_pos[:, 3:11])


def test_an_action_of_the_wrong_shape_is_refused():
    env = make()
    with pytest.raises(ValueError, match=r"shape \(4, 2\), expected \(4, 1\)"):
        env.step(torch.zeros(4, 2))


def test_the_last_action_is_remembered_until_a_reset():
    env = make()
    env.step(act(env, 1.0))
    env.step(act(env, 3.0))
    assert mdp.action_rate_l2(env).tolist() == [4.0] * 4
    env.reset(env_ids=[0])
    assert mdp.last_action(env)[:, 0].tolist() == [0.0, 3.0, 3.0, 3.0]
    assert mdp.action_rate_l2(env).tolist() == [0.0, 4.0, 4.0, 4.0]


# ---- observations


def test_observations_are_copies():
    env = make()
    first, _ = env.reset()
    kept = first["policy"].clone()
    first_of_step, *_ = env.step(act(env, 0.5))
    kept_of_step = first_of_step["policy"].clone()
    for _ in range(5):
        env.step(act(env, 0.5))
    assert torch.equal(first["policy"], kept) and torch.equal(first_of_step["policy"], kept_of_step)
    first["policy"].fill_(99.0)
    assert env.scene["robot"].data.joint_pos.abs().max() < 1.0


def test_noise_comes_first_then_clip_then_scale():
    noisy = {"func": mdp.joint_pos, "noise": UniformNoiseCfg(n_min=0.5, n_max=0.7)}
    terms = {
        "a": ObservationTermCfg(**noisy),
        "b": ObservationTermCfg(**noisy, clip=(-0.1, 0.4), scale=10.0),
    }
    groups = {
        "policy": ObservationGroupCfg(terms=terms, enable_corruption=True),
        "critic": ObservationGroupCfg(terms=terms),
    }
    env = make(100, observations=groups)
    obs, _ = env.reset()
    assert obs["policy"].dtype == torch.float32
    assert 0.5 <= obs["policy"][:, 0].min() < 0.55 and 0.65 < obs["policy"][:, 0].max() <= 0.7
    assert (obs["policy"][:, 1] == 4.0).all() and (obs["critic"] == 0.0).all()


def test_noise_is_the_same_for_a_seed():
    term = ObservationTermCfg(func=mdp.joint_pos, noise=UniformNoiseCfg())
    env = make(observations={"policy": ObservationGroupCfg(terms={"q": term}, enable_corruption=True)})
    first, _ = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    other, _ = env.reset(seed=4)
    assert torch.equal(first["policy"], again["policy"]) and not torch.equal(first["policy"], other["policy"])


# ---- rewards and terminations


def test_rewards_are_weighted_per_second_and_logged_per_episode():
    rewards = {
        "a": RewardTermCfg(func=number, params={"value": 2.0}, weight=3.0),
        "b": RewardTermCfg(func=number, params={"value": 1.0}, weight=-1.0),
        "off": RewardTermCfg(func=number, params={"value": float("nan")}, weight=0.0),
    }
    env = make(rewards=rewards, episode_length_s=0.01)
    env.reset()
    for _ in range(3):
        _, reward, *_ = env.step(act(env))
        assert reward.tolist() == pytest.approx([5.0 * 0.0025] * 4)
    *_, extras = env.step(act(env))
    assert extras["log"]["Episode_Reward/a"] == pytest.approx(6.0)
    assert extras["log"]["Episode_Reward/b"] == pytest.approx(-1.0)
    assert extras["log"]["Episode_Termination/time_out"] == 4


def test_failures_terminate_and_time_truncates():
    def second(env):
        return torch.arange(env.num_envs) == 1

    terminations = {
        "time_out": TerminationTermCfg(func=mdp.time_out, time_out=True),
        "failed": TerminationTermCfg(func=second),
    }
    env = make(terminations=terminations, episode_length_s=0.005)
    env.reset()
    _, _, terminated, truncated, _ = env.step(act(env))
    assert terminated.tolist() == [False, True, False, False] and not truncated.any()
    _, _, terminated, truncated, _ = env.step(act(env))
    assert terminated.tolist() == [False, True, False, False]
    assert truncated.tolist() == [True, False, True, True]


@pytest.mark.parametrize("seconds", [0.0175, 0.07, 0.1, 0.3, 0.7, 1.0])
def test_an_episode_has_as_many_steps_as_fit_its_length(seconds):
    env = make(1, episode_length_s=seconds)
    assert env.max_episode_length == round(seconds / 0.0025)


# ---- events and commands


def test_events_happen_in_their_mode_to_their_environments():
    seen = {"startup": [], "reset": [], "interval": []}

    def record(env, env_ids, mode):
        seen[mode].append(env_ids.tolist())

    events = {
        mode: EventTermCfg(
            func=record,
            params={"mode": mode},
            mode=mode,
            interval_range_s=(0.005, 0.005) if mode == "interval" else None,
        )
        for mode in seen
    }
    env = make(3, events=events)
    env.reset()
    env.reset(env_ids=[2, 0])
    for _ in range(5):
        env.step(act(env))
    assert seen == {"startup": [[0, 1, 2]], "reset": [[0, 1, 2], [0, 2]], "interval": [[0, 1, 2], [0, 1, 2]]}


def test_a_reset_starts_the_interval_anew():
    seen = []
    record = EventTermCfg(
        func=lambda env, env_ids: seen.append(env_ids.tolist()), mode="interval", interval_range_s=(0.01, 0.01)
    )
    env = make(2, events={"record": record})
    env.reset()
    for k in range(6):
        if k == 2:
            env.reset(env_ids=[1])
        env.step(act(env))
    assert seen == [[0], [1]]


@pytest.mark.parametrize(
    ("term", "message"),
    [({"mode": "always"}, "Available: startup, reset, interval"), ({"mode": "interval"}, "needs interval_range_s")],
)
def test_an_impossible_event_is_refused(term, message):
    with pytest.raises(ValueError, match=message):
        make(events={"x": EventTermCfg(func=lambda env, env_ids: None, **term)})


def test_joints_start_at_random_offsets_inside_their_limits():
    event = EventTermCfg(
        func=mdp.reset_joints_by_offset,
        mode="reset",
        params={"position_range": (-1.0, 1.0), "velocity_range": (0.5, 0.6)},
    )
    env = make(50, task="Pace-AnymalD-v0", events={"offset": event})
    env.reset()
    data = env.scene["robot"].data
    low, high = data.soft_joint_pos_limits.T
    assert ((data.joint_pos >= low) & (data.joint_pos <= high)).all()
    assert data.joint_pos.std(dim=0).min() > 0.2
    assert ((data.joint_vel >= 0.5) & (data.joint_vel <= 0.6)).all()
    before = data.joint_pos.clone()
    env.reset(env_ids=[7])
    changed = (data.joint_pos != before).any(dim=1)
    assert changed.nonzero()[:, 0].tolist() == [7]


def test_pushing_a_fixed_base_is_refused():
    push = EventTermCfg(func=mdp.push_by_setting_velocity, mode="reset", params={"velocity_range": {"x": (1, 1)}})
    with pytest.raises(ValueError, match="base is fixed"):
        make(events={"push": push}).reset()


def test_commands_are_drawn_at_resets_and_when_their_time_is_over():
    command = mdp.UniformVelocityCommandCfg(
        resampling_time_range=(0.01, 0.01), lin_vel_x=(1.0, 2.0), rel_standing_envs=0.0
    )
    env = make(3, commands={"base_velocity": command})
    env.reset()
    drawn = env.command_manager.get_command("base_velocity").clone()
    assert ((drawn[:, 0] >= 1.0) & (drawn[:, 0] <= 2.0)).all() and len(set(drawn[:, 0].tolist())) == 3
    env.reset(env_ids=[1])
    changed = (env.command_manager.get_command("base_velocity") != drawn).any(dim=1)
    assert changed.tolist() == [False, True, False]
    drawn = env.command_manager.get_command("base_velocity").clone()
    for k in range(4):
        assert torch.equal(env.command_manager.get_command("base_velocity"), drawn), k
        env.step(act(env))
    assert (env.command_manager.get_command("base_velocity") != drawn).any(dim=1).all()
    with pytest.raises(KeyError, match="base_velocity"):
        env.command_manager.get_command("speed")
