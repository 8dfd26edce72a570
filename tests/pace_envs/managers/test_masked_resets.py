"""Environments that are reset where a mask says so, as on a GPU, do what those do that are counted first."""

from collections import deque
from types import SimpleNamespace

import pytest
import torch
from without_chance import NUM_ENVS, without_chance

from pace_envs import ManagerBasedRLEnv
from pace_envs.managers import EventTermCfg, state_only
from pace_envs.rl.runner import DeferredEpisodes


def step_both(counted, masked, steps=45):
    """Steps of both, which must be equal in all that they return; returns how many episodes ended."""
    generator, ended = torch.Generator().manual_seed(0), 0
    for env in (counted, masked):
        env.reset(seed=1)
        env.episode_length_buf[:] = torch.arange(NUM_ENVS)
    for _ in range(steps):
        action = 1.5 * torch.randn(NUM_ENVS, 12, generator=generator)
        (obs, *rest, extras), (masked_obs, *masked_rest, masked_extras) = counted.step(action), masked.step(action)
        for a, b in zip((obs["policy"], *rest), (masked_obs["policy"], *masked_rest), strict=True):
            assert torch.equal(a, b)
        for a, b in zip(counted.sim.state, masked.sim.state, strict=True):
            assert torch.equal(a, b)
        assert torch.equal(counted.episode_length_buf, masked.episode_length_buf)
        if "log" in extras:
            log = {name: float(value) for name, value in masked_extras["log"].items()}
            assert log == pytest.approx({name: float(value) for name, value in extras["log"].items()}, abs=1e-6)
        ended += int((rest[1] | rest[2]).sum())
    return ended


def test_masks_reset_what_indices_reset_drives_sensors_and_logs_included():
    counted, masked = ManagerBasedRLEnv(without_chance()), ManagerBasedRLEnv(without_chance())
    assert masked.takes_masks and masked.can_be_captured and not masked.masks_resets
    masked.masks_resets = True
    assert step_both(counted, masked) >= NUM_ENVS


def test_terms_of_one_s_own_are_told_the_environments_unless_they_say_that_they_change_the_state_alone():
    def shift(env, env_ids):
        env.sim.qpos[env_ids, 0] += 0.25

    cfg = without_chance()
    cfg.events = {**cfg.events, "shift": EventTermCfg(func=shift, mode="reset")}
    counted = ManagerBasedRLEnv(cfg)
    assert not counted.takes_masks
    cfg.events["shift"].func = state_only(shift)
    masked = ManagerBasedRLEnv(cfg)
    assert masked.takes_masks and masked.can_be_captured
    masked.masks_resets = True
    assert step_both(counted, masked, steps=35)


def test_a_curriculum_judges_episodes_alike_whether_they_are_counted_or_not():
    env = ManagerBasedRLEnv(without_chance())
    term = env.curriculum_manager.terms[0]
    other = ManagerBasedRLEnv(without_chance())
    for step in range(12):
        ids = torch.arange(step % 4, NUM_ENVS, 3)
        done = torch.zeros(NUM_ENVS, dtype=torch.bool).index_fill(0, ids, True)
        for each in (env, other):
            each.reward_manager.episode_sums["track_velocity"][:] = 11.0 + step
        expected = term(ids)
        got = other.curriculum_manager.compute_where(done)["Curriculum/command_range"]
        assert float(got) == pytest.approx(expected)
    assert 0.5 < expected <= 1.0


def test_episodes_that_are_looked_at_once_an_iteration_are_those_that_ended():
    logged = []
    logger = SimpleNamespace(
        writer=object(),
        ep_extras=[],
        rewbuffer=deque(maxlen=100),
        lenbuffer=deque(maxlen=100),
        cur_reward_sum=torch.zeros(3),
        cur_episode_length=torch.zeros(3),
        log=lambda **kwargs: logged.append(kwargs),
        process_env_step=None,
    )
    DeferredEpisodes(logger)
    for dones in ([0, 1, 0], [0, 0, 0], [1, 1, 0]):
        logger.process_env_step(torch.tensor([1.0, 2.0, 3.0]), torch.tensor(dones), {"log": {"a": torch.ones(())}})
    assert not logger.rewbuffer and len(logger.ep_extras) == 3
    logger.log(it=4)
    assert list(logger.rewbuffer) == [2.0, 3.0, 4.0] and list(logger.lenbuffer) == [1.0, 3.0, 2.0]
    assert logger.cur_reward_sum.tolist() == [0.0, 0.0, 9.0] and logged == [{"it": 4}]
