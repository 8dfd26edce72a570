"""What an environment is given and may not be: wrong actions, use after close; and what Gymnasium asks of one."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from problems import ANYMAL, BENCH, env_cfg

from pace_envs import ManagerBasedRLEnv

N = 3


@pytest.fixture(scope="module")
def env():
    cfg = env_cfg(ANYMAL)
    cfg.scene.num_envs = N
    env = ManagerBasedRLEnv(cfg)
    env.reset(seed=0)
    yield env
    env.close()


def state(env):
    return torch.cat([env.sim.qpos, env.sim.qvel], dim=1).clone()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([[0.0] * 12] * N, "the action is a builtins.list, expected a number or a torch.Tensor of shape \\(3, 12\\)"),
        (np.zeros((N, 12)), r"the action is a numpy.ndarray.*torch\.as_tensor"),
        (None, "the action is a builtins.NoneType"),
        ("x", "the action is a builtins.str"),
        (torch.zeros(N, 11), r"the action has the shape \(3, 11\), expected \(3, 12\)"),
        (torch.zeros(N + 1, 12), r"has the shape \(4, 12\)"),
        (torch.zeros(12, N), r"has the shape \(12, 3\)"),
        (torch.zeros(N), r"has the shape \(3,\)"),
        (torch.zeros(1, N, 12), r"has the shape \(1, 3, 12\)"),
        (torch.zeros(N, 12, dtype=torch.complex64), "complex"),
        (torch.full((N, 12), torch.nan), r"not finite, first at \[0, 0\]"),
        (torch.tensor([[0.0] * 11 + [torch.inf]]), r"not finite, first at \[0, 11\]"),
    ],
)
def test_what_is_no_action_is_refused_and_nothing_moves(action, message, env):
    before, steps = state(env), env.common_step_counter
    with pytest.raises(ValueError, match=message):
        env.step(action)
    assert torch.equal(state(env), before) and env.common_step_counter == steps


WRITERS = {
    "action": lambda env, value: env.action_manager.process_action(value),
    "position target": lambda env, value: env.scene["robot"].set_joint_position_target(value),
    "velocity target": lambda env, value: env.scene["robot"].set_joint_velocity_target(value),
    "effort target": lambda env, value: env.scene["robot"].set_joint_effort_target(value),
    "armature": lambda env, value: env.scene["robot"].write_joint_armature_to_sim(value),
    "position": lambda env, value: env.scene["robot"].write_joint_state_to_sim(value, 0.0),
}
READ = {
    "action": lambda env: env.action_manager.action,
    "position target": lambda env: env.scene["robot"].data.joint_pos_target,
    "velocity target": lambda env: env.scene["robot"].data.joint_vel_target,
    "effort target": lambda env: env.scene["robot"].data.joint_effort_target,
    "armature": lambda env: env.sim.expand("dof_armature")[:, env.scene["robot"].dof_columns],
    "position": lambda env: env.scene["robot"].data.joint_pos,
}


@pytest.mark.parametrize("name", WRITERS)
def test_values_are_spread_over_environments_and_joints_by_one_rule(name, env):
    joints, envs = torch.arange(12.0) / 100, torch.arange(float(N))[:, None] / 10
    for value in (0.1, joints, joints[None], envs, joints + envs):
        WRITERS[name](env, value)
        expected = torch.as_tensor(value).double().expand(N, 12)
        assert torch.allclose(READ[name](env), expected, atol=1e-6), value
    for value in (torch.zeros(N), torch.zeros(N, 11), torch.zeros(2, 12), np.zeros(12), [0.0] * 12):
        with pytest.raises(ValueError, match="expected"):
            WRITERS[name](env, value)


def test_a_closed_environment_says_so():
    cfg = env_cfg(BENCH)
    cfg.scene.num_envs = 1
    env = ManagerBasedRLEnv(cfg, render_mode="rgb_array")
    env.reset()
    env.close()
    env.close()
    for use in (env.reset, env.render, lambda: env.step(torch.zeros(1, 1)), lambda: env.simulate(torch.zeros(1, 1))):
        with pytest.raises(ValueError, match="closed"):
            use()


class OneInNumPy(gym.Env):
    """One environment without its axis of environments, NumPy at the edge: what Gymnasium's checker looks at."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, task):
        self.env = gym.make(task, num_envs=1)
        inside = self.env.unwrapped
        self.observation_space, self.action_space = (
            inside.single_observation_space["policy"],
            inside.single_action_space,
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        obs, extras = self.env.reset(seed=seed, options=options)
        return obs["policy"][0].numpy().astype(np.float32), extras

    def step(self, action):
        obs, reward, terminated, truncated, _ = self.env.step(torch.as_tensor(action)[None])
        return obs["policy"][0].numpy().astype(np.float32), float(reward), bool(terminated), bool(truncated), {}


@pytest.mark.parametrize("task", [BENCH, "Pace-Go2-Velocity-v0"])
def test_an_environment_passes_gymnasiums_check(task):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*(infinity|Box|not within the range|normalized|spec).*")
        check_env(OneInNumPy(task), skip_render_check=True)


def test_a_seed_reaches_gymnasiums_own_generator(env):
    env.reset(seed=5)
    first = env.np_random.random()
    env.reset(seed=5)
    assert env.np_random.random() == first and env.np_random_seed == 5
