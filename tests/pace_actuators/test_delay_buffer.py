"""Delays of a real number of steps, against closed forms and a NumPy reference."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pace_actuators import DelayBuffer


def delayed(buffer: DelayBuffer, samples: torch.Tensor) -> torch.Tensor:
    """Push samples (steps, num_envs, num_joints) one by one; returns the outputs, same shape."""
    return torch.stack([buffer.compute(sample.clone()).clone() for sample in samples])


def ramp(steps: int, num_envs: int = 1) -> torch.Tensor:
    """Sample k is k."""
    return torch.arange(steps, dtype=torch.float64).view(-1, 1, 1).expand(-1, num_envs, 1)


@pytest.mark.parametrize(
    ("lag", "interpolation", "expected"),
    [
        (0.0, "linear", [0, 1, 2, 3, 4, 5]),
        (2.0, "linear", [0, 0, 0, 1, 2, 3]),
        (2.5, "linear", [0, 0, 0, 0.5, 1.5, 2.5]),
        (0.25, "linear", [0, 0.75, 1.75, 2.75, 3.75, 4.75]),
        (3.0, "linear", [0, 0, 0, 0, 1, 2]),
        (2.0, "hold", [0, 0, 0, 1, 2, 3]),
        (2.5, "hold", [0, 0, 0, 0, 1, 2]),
        (2.01, "hold", [0, 0, 0, 0, 1, 2]),
    ],
)
def test_a_ramp_comes_out_delayed(lag, interpolation, expected):
    buffer = DelayBuffer(3.0, 1, interpolation=interpolation)
    buffer.set_time_lag(lag)
    assert delayed(buffer, ramp(6)).flatten().tolist() == pytest.approx(expected)


@settings(deadline=None, max_examples=50)
@given(lag=st.floats(0.0, 3.5), parts=st.integers(2, 6), seed=st.integers(0, 1000))
def test_within_a_step_a_held_signal_switches_at_its_instant(lag, parts, seed):
    """Each part shows the mean of the held signal over it, and all parts together the linear mix of samples."""
    samples = np.random.default_rng(seed).normal(size=8)
    buffer, whole = DelayBuffer(3.5, 1, parts=parts), DelayBuffer(3.5, 1)
    buffer.set_time_lag(lag)
    whole.set_time_lag(lag)
    edges = np.concatenate([np.arange(len(samples) + 1) + lag, (np.arange(8 * parts + 1)) / parts])
    for k, sample in enumerate(samples):
        pushed = torch.full((1, 1), sample, dtype=torch.float64)
        first, linear = float(buffer.compute(pushed)), float(whole.compute(pushed))
        shown = [first, *(float(buffer.part(p)) for p in range(1, parts))]
        for p, value in enumerate(shown):
            begin, end = k + p / parts, k + (p + 1) / parts
            cuts = np.unique([begin, *edges[(edges > begin) & (edges < end)], end])
            middle = 0.5 * (cuts[1:] + cuts[:-1])
            held = samples[np.clip(np.floor(middle - lag).astype(int), 0, None)]
            assert value == pytest.approx(float(np.sum(held * np.diff(cuts)) / (end - begin)), abs=1e-9)
            if p and not buffer.changes(p):
                assert value == pytest.approx(shown[p - 1], abs=1e-12)
        assert np.mean(shown) == pytest.approx(linear, abs=1e-9)
        assert float(buffer.mean()) == pytest.approx(linear, abs=1e-12)


@settings(deadline=None, max_examples=50)
@given(
    lags=st.lists(st.floats(0.0, 6.5), min_size=2, max_size=4),
    per_joint=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_linear_interpolation_is_numpys(lags, per_joint, seed):
    num_envs, steps = (2, 20) if per_joint else (len(lags), 20)
    samples = np.random.default_rng(seed).normal(size=(steps, num_envs, len(lags) if per_joint else 2))
    lag = np.tile(lags, (num_envs, 1)) if per_joint else np.tile(np.array(lags)[:, None], (1, 2))
    buffer = DelayBuffer(6.5, num_envs)
    buffer.set_time_lag(torch.tensor(lag if per_joint else lags, dtype=torch.float64))
    output = delayed(buffer, torch.tensor(samples))
    time = np.arange(steps)
    for env in range(num_envs):
        for joint in range(samples.shape[2]):
            expected = np.interp(time - lag[env, joint], time, samples[:, env, joint])
            assert output[:, env, joint].numpy() == pytest.approx(expected, abs=1e-12)


def test_output_is_continuous_in_the_lag():
    below, above = DelayBuffer(5.0, 1), DelayBuffer(5.0, 1)
    below.set_time_lag(2.0 - 1e-9)
    above.set_time_lag(2.0 + 1e-9)
    samples = torch.randn(20, 1, 3, dtype=torch.float64)
    assert (delayed(below, samples) - delayed(above, samples)).abs().max() < 1e-7


def test_every_environment_has_its_own_lag():
    buffer = DelayBuffer(4.0, 3)
    buffer.set_time_lag(torch.tensor([0.0, 1.5, 4.0]))
    assert delayed(buffer, ramp(9, 3))[-1].flatten().tolist() == [8.0, 6.5, 4.0]
    buffer.set_time_lag(torch.tensor([[2.0]]), env_ids=[2])
    assert buffer.time_lags.tolist() == [0.0, 1.5, 2.0]


def test_a_changed_lag_sees_the_same_history():
    buffer = DelayBuffer(4.0, 1)
    delayed(buffer, ramp(9))
    buffer.set_time_lag(4.0)
    assert buffer.compute(torch.full((1, 1), 9.0, dtype=torch.float64)).item() == 5.0


@pytest.mark.parametrize(
    "env_ids", [[2, 0], torch.tensor([0, 2]), torch.tensor([True, False, True]), slice(0, 3, 2)], ids=repr
)
def test_a_partial_reset_clears_only_those_environments(env_ids):
    buffer = DelayBuffer(4.0, 3)
    buffer.set_time_lag(3.0)
    delayed(buffer, ramp(9, 3))
    buffer.reset(env_ids)
    new = torch.tensor([[100.0], [9.0], [100.0]], dtype=torch.float64)
    assert buffer.compute(new).flatten().tolist() == [100.0, 6.0, 100.0]


def test_it_survives_leaving_inference_mode():
    buffer = DelayBuffer(4.0, 2)
    with torch.inference_mode():
        buffer.set_time_lag(torch.tensor([[1.0, 2.0], [0.5, 1.5]]))
        buffer.compute(torch.zeros(2, 2))
    buffer.set_time_lag(2.0, env_ids=[1])
    buffer.reset([0])
    assert buffer.compute(torch.ones(2, 2)).tolist() == [[1.0, 1.0], [0.0, 0.0]]


@pytest.mark.parametrize("lag", [-0.1, 4.1, float("nan")])
def test_a_lag_outside_of_the_buffer_is_refused(lag):
    with pytest.raises(ValueError, match="expected 0 to max_delay = 4"):
        DelayBuffer(4.0, 1).set_time_lag(lag)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"max_delay": -1.0}, "max_delay is -1"),
        ({"max_delay": float("inf")}, "max_delay is inf"),
        ({"max_delay": 1.0, "interpolation": "cubic"}, "Available: 'linear', 'hold'"),
    ],
)
def test_an_impossible_buffer_is_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        DelayBuffer(num_envs=1, **kwargs)


@pytest.mark.parametrize(("interpolation", "parts", "columns"), [("linear", 1, 1), ("linear", 4, 3), ("hold", 1, 3)])
def test_a_buffer_that_counts_in_tensors_gives_what_one_gives_that_counts_in_python(interpolation, parts, columns):
    """As on a GPU, where a CUDA graph repeats the same step."""
    random = np.random.default_rng(0)
    both = [DelayBuffer(4.0, 5, interpolation=interpolation, parts=parts, counts_on_device=d) for d in (False, True)]
    lags = torch.as_tensor(random.uniform(0.0, 4.0, (5, columns)))
    for buffer in both:
        buffer.set_time_lag(lags)
    for k in range(30):
        sample, some = torch.as_tensor(random.normal(size=(5, 3))), torch.as_tensor(random.random(5) < 0.2)
        given = []
        for buffer in both:
            if k in (7, 20):
                buffer.reset(some)
            if k == 13:
                buffer.reset([0, 3])
            if k == 25:
                buffer.set_time_lag(lags.flip(0))
            first = buffer.compute(sample)
            given.append([first, *(buffer.part(part) for part in range(parts)), buffer.mean(), buffer.history()])
        assert all(torch.equal(a, b) for a, b in zip(*given, strict=True)), k
