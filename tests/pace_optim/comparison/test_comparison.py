"""Where an error sits is found on data whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest
from problems import BENCH, env_cfg, make_problem, record

from pace_optim.comparison.compare import summary_of
from pace_optim.comparison.dimensions import motion_of
from pace_optim.comparison.drive_loads import load_torques
from pace_optim.comparison.error_regions import worst_places
from pace_optim.comparison.joint import (
    band_edges,
    band_power,
    compare_joint,
    hysteresis,
    narrowest_band,
    response,
    rmse_by_part,
    share_above,
    whiteness,
)
from pace_optim.comparison.regions import best_region, evidence, lay_out
from pace_optim.comparison.tracks import Track
from pace_optim.recording import Load
from pace_optim.recording.noise import NoiseFloor, lattice_step, noise_floor, with_repetitions

DT = 0.0025
TIME = np.arange(8000) * DT
CHIRP = 0.5 * np.sin(2 * np.pi * (0.1 * TIME + 4.9 / 40 * TIME**2))
"""0.1 to 5 Hz in 20 s [rad]."""


def rng(seed=0):
    return np.random.default_rng(seed)


def first_order(rho, seed=0, count=8000):
    """Noise of standard deviation 1 whose neighbours correlate by rho."""
    white, x = rng(seed).standard_normal(count), np.zeros(count)
    for k in range(1, count):
        x[k] = rho * x[k - 1] + white[k] * np.sqrt(1 - rho**2)
    return x


def track(error, position=CHIRP, *, noise=1e-4, name="chirp", group=0, load=None, seed=0, train=True):
    """A recording whose simulation is wrong by ``error``, as the encoder's noise shows it."""
    own = noise * rng(seed).standard_normal(len(position))
    return Track(
        name=name,
        time=TIME[: len(position)],
        target=position[:, None],
        measured=(position + own)[:, None],
        error=(error - own)[:, None],
        train=np.full(len(position), train),
        held_out=np.full(len(position), not train),
        load=None if load is None else load[:, None],
        group=group,
        enabled=np.ones(len(position), dtype=bool),
    )


def test_a_beginning_that_is_not_judged_by_the_fit_is_not_compared_either():
    one = track(np.where(TIME[: len(CHIRP)] < 1.0, 0.1, 0.0), train=False, noise=0.0)
    settled = replace(one, held_out=one.time >= 1.0)
    assert rmse_by_part([one])["validation"] > 0.01 and rmse_by_part([settled])["validation"] == 0.0
    assert not settled.counts[0, 0] and settled.counts[-1, 0]


def reversal_error(position=CHIRP, lasting=0.05):
    """2 mrad for 50 ms after each turn, in the new direction."""
    motion = motion_of(position, DT, 0.0)
    return np.where(motion.since_reversal < lasting, 2e-3 * motion.direction, 0.0)


def test_of_a_leg_that_walks_only_swings_count_and_the_error_is_laid_out_over_them():
    swing = np.where(TIME % 1 < 0.2, (TIME % 1) / 0.2, np.nan)
    late = track(np.where(swing > 0.5, 2e-3, 0.0))
    late = replace(late, error=np.where(np.isnan(swing), 0.0, late.error[:, 0])[:, None], swing=swing[:, None])
    content = compare_joint("hip", 0, [late]).content
    assert content["rmse"]["train"] == pytest.approx(2e-3 / np.sqrt(2), rel=0.01)
    assert content["where"]["swing"]["time"] == pytest.approx([0.25] * 4, abs=0.01)
    assert content["where"]["swing"]["error"] == pytest.approx([0, 0, 0.5, 0.5], abs=0.01)
    assert any("in the last 50 % of each swing" in place["sentence"] for place in content["places"])


# ---------------------------------------------------------------- noise


@pytest.mark.parametrize("sigma", [1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("seed", [0, 1])
def test_white_noise_is_measured_through_the_motion(sigma, seed):
    assert noise_floor(CHIRP + sigma * rng(seed).standard_normal(8000), DT).sigma == pytest.approx(sigma, rel=0.08)


def test_a_motion_without_noise_has_next_to_none():
    assert noise_floor(CHIRP, DT).sigma < 1e-9


@pytest.mark.parametrize("rho", [0.3, 0.5, -0.4])
def test_correlated_noise_is_measured_through_the_motion(rho):
    found = [noise_floor(CHIRP + 1e-4 * first_order(rho, seed), DT).sigma for seed in range(4)]
    assert np.mean(found) == pytest.approx(1e-4, rel=0.15)


@pytest.mark.parametrize("bits", [12, 14, 16])
def test_a_quantised_encoder_is_never_below_its_lattice(bits):
    step = 2 * np.pi / 2**bits
    floor = noise_floor(np.round(CHIRP / step) * step, DT)
    assert floor.lattice == pytest.approx(step, rel=1e-6)
    assert step / np.sqrt(12) <= floor.sigma < 1.3 * step / np.sqrt(12)
    slow = np.round(1e-2 * TIME / step) * step  # so slow that it mostly stands: no noise to be seen between samples
    assert noise_floor(slow, DT).sigma >= step / np.sqrt(12) * (1 - 1e-9)


def test_a_lattice_stored_in_single_precision_is_found_and_a_smooth_motion_has_none():
    step = 2 * np.pi / 2**14
    single = (np.round(CHIRP / step) * step).astype(np.float32).astype(float)
    assert lattice_step(single) == pytest.approx(step, rel=1e-4)
    assert lattice_step(CHIRP + 1e-5 * rng().standard_normal(8000)) is None
    assert lattice_step(np.zeros(100)) is None


def test_repetitions_say_what_a_smooth_disturbance_hides():
    """A disturbance that differs between repetitions but is smooth cannot be seen in one of them."""
    wander = [1e-3 * np.sin(2 * np.pi * 0.7 * TIME + phase) for phase in rng(3).uniform(0, 2 * np.pi, 8)]
    positions = [CHIRP + w + 1e-5 * rng(k).standard_normal(8000) for k, w in enumerate(wander)]
    alone = [noise_floor(position, DT) for position in positions]
    assert max(floor.sigma for floor in alone) < 2e-5
    floors = with_repetitions(alone, positions)
    expected = np.sqrt(np.var(np.stack(positions), axis=0, ddof=1).mean())
    assert floors[0].sigma == pytest.approx(expected) and expected > 4e-4
    assert {floor.source for floor in floors} == {"repetitions"}


def test_repetitions_are_not_below_the_lattice_either():
    step = 1e-3
    floors = with_repetitions([NoiseFloor(sigma=0.0, source="lattice", lattice=step)] * 2, [CHIRP, CHIRP])
    assert floors[0] == NoiseFloor(sigma=step / np.sqrt(12), source="lattice", lattice=step)


def test_the_share_above_the_floor_is_what_is_left_of_the_square():
    assert share_above(2e-3, 1e-3) == pytest.approx(0.75)
    assert share_above(1e-3, 2e-3) == 0.0 and share_above(0.0, 0.0) == 0.0


# ---------------------------------------------------------------- motion and regions


def test_the_time_since_a_reversal_of_a_sine():
    motion = motion_of(0.5 * np.sin(2 * np.pi * TIME), DT, 1e-6)
    middle = slice(1000, 7000)
    expected = (TIME + 0.25) % 0.5
    assert np.quantile(np.abs(motion.since_reversal - expected)[middle], 0.97) < 2 * DT
    assert motion.speed[middle] == pytest.approx(np.pi * np.cos(2 * np.pi * TIME)[middle], abs=0.01)
    assert np.mean(motion.direction == np.sign(np.cos(2 * np.pi * TIME)))[()] > 0.97


def test_a_reversal_is_where_the_speed_is_zero_although_noise_hides_it_for_a_while():
    motion = motion_of(0.5 * np.sin(2 * np.pi * 0.5 * TIME), DT, 3e-3)
    assert motion.standstill > 0.2  # of a top speed of 1.6 rad/s
    middle = slice(1000, 7000)
    assert np.quantile(np.abs(motion.since_reversal - (TIME + 0.5) % 1.0)[middle], 0.97) < 2 * DT


def test_a_joint_that_stands_has_never_turned():
    motion = motion_of(1e-4 * rng().standard_normal(4000), DT, 1e-4)
    assert np.isinf(motion.since_reversal).mean() > 0.9


def test_shares_are_of_what_is_above_the_floor():
    error, floor = np.array([3.0, 3.0, 1.0, 1.0]), np.ones(4)
    layout = lay_out(error, floor, np.array([0, 0, 1, 1]), 2)
    assert layout.error.tolist() == [1.0, 0.0] and layout.time.tolist() == [0.5, 0.5]
    assert layout.rms.tolist() == [3.0, 1.0] and layout.mean.tolist() == [3.0, 1.0]
    assert lay_out(np.ones(4), floor, np.zeros(4, dtype=int), 1).error.tolist() == [0.0]


def test_the_best_region_is_the_one_furthest_from_chance():
    base = np.full(10, 0.1)
    region = best_region(base, np.array([0.02, 0.02, 0.4, 0.4, 0.02, 0.02, 0.02, 0.02, 0.04, 0.04]))
    assert (region.first, region.last) == (2, 3) and region.share == pytest.approx(0.8) and region.is_place
    assert best_region(base, base) is None or not best_region(base, base).is_place
    assert best_region(base, np.zeros(10)) is None
    assert evidence(0.1, 0.5) == 0.0 < evidence(0.6, 0.5) < evidence(0.6, 0.1)


# ---------------------------------------------------------------- sentences


def sentence(*tracks):
    return compare_joint("knee", 0, tracks).content["sentence"]


def test_an_error_after_reversals_is_said_to_be_there():
    compared = compare_joint("knee", 0, [track(reversal_error())])
    assert "within 50 ms after a reversal" in compared.content["sentence"]
    place = compared.content["places"][0]
    assert place["share_of_error"] > 0.9 and "since_reversal" in place["by"]
    bins = compared.content["where"]["since_reversal"]
    assert bins["error"][0] + bins["error"][1] > 0.9
    assert compared.content["share_above_floor"] > 0.9


def test_an_error_at_one_frequency_is_said_to_be_in_its_band():
    compared = compare_joint("knee", 0, [track(1e-3 * np.sin(2 * np.pi * 9.0 * TIME + 0.3))])
    place = compared.content["places"][0]
    assert place["by"] == ["frequency"] and place["share_of_error"] > 0.95
    assert "between 7.9 and 9.9 Hz" in place["sentence"]


def test_noise_does_not_count_in_the_spectrum_either():
    compared = compare_joint("knee", 0, [track(2e-4 * np.sin(2 * np.pi * 9.0 * TIME + 0.3))])
    assert max(compared.content["where"]["frequency"]["error"]) > 0.85  # two thirds, were noise counted


def test_a_nearly_constant_error_is_called_so_and_not_by_its_octave():
    """ "98 % of the remaining error lies below 0.062 Hz" was a constant."""
    compared = compare_joint("knee", 0, [track(-17e-3 + 1e-3 * np.sin(2 * np.pi * 9.0 * TIME))])
    (place,) = compared.places
    assert compared.content["sentence"] == place.sentence
    assert place.sentence.startswith("knee: the error is nearly constant, −17 mrad (simulated less measured): a torque")
    assert place.by == ("constant",) and place.share > 0.99


def test_an_error_at_standstill_is_called_so_however_long_the_joint_stands():
    """A joint stood in 85 % of the time with 95 % of the error, and a range of positions was named."""
    position = np.where(TIME < 17.0, 0.3, 0.3 + 0.2 * np.sin(2 * np.pi * (TIME - 17.0)))
    error = np.where(TIME < 17.0, 1e-3, 2e-4) * np.sign(np.sin(2 * np.pi * 0.3 * TIME))
    (place,) = compare_joint("knee", 0, [track(error, position)]).places
    assert place.by == ("speed",) and "lies where the joint stands still (8" in place.sentence


def test_an_error_at_high_speed_is_said_to_be_there():
    error = np.where(np.abs(motion_of(CHIRP, DT, 0.0).speed) > 10.0, 1e-3, 0.0)
    assert "above 5.6 rad/s" in sentence(track(error))


def test_an_error_in_one_direction_is_said_to_be_there():
    error = np.where(motion_of(CHIRP, DT, 0.0).direction > 0, 1e-3, 0.0) * np.sign(rng().standard_normal(8000))
    place = compare_joint("knee", 0, [track(error)])
    assert place.content["where"]["direction"]["error"][1] > 0.98
    assert any("on the way up" in p["sentence"] for p in place.content["places"])


def test_an_error_under_load_is_said_to_be_there():
    load = 20 * np.sin(2 * np.pi * 0.13 * TIME)
    compared = compare_joint("knee", 0, [track(np.where(load > 15.0, 1e-3, 0.0), load=load)])
    assert "under load torques above" in compared.content["sentence"]


def test_what_is_left_of_a_good_model_is_at_the_noise_floor():
    compared = compare_joint("knee", 0, [track(np.zeros(8000))])
    assert compared.content["sentence"].startswith("knee is at the noise floor: 0.1 mrad against")
    assert compared.places == [] and compared.content["share_above_floor"] < 0.1


def test_an_error_beside_a_joint_that_shows_no_noise_is_no_noise():
    """A simulated recording at rest: the summary stated that the joint is within 10 % of the noise."""
    compared = compare_joint("servo", 0, [track(np.full(8000, 0.01), np.zeros(8000), noise=0.0)])
    assert compared.content["noise_floor"] == 0.0
    assert summary_of([compared]).startswith("There is error above the noise floor")


def test_an_error_without_a_place_is_said_to_be_spread_evenly():
    """As much in every octave, at any time."""
    lines = np.fft.rfftfreq(8000, DT)
    phases = np.exp(2j * np.pi * rng(1).uniform(size=len(lines)))
    density = np.where((lines > 0.1) & (lines < 5.0), 1 / np.sqrt(np.maximum(lines, 0.1)), 0.0)
    error = np.fft.irfft(density * phases)
    assert "is spread evenly" in sentence(track(1e-3 * error / error.std()))


def test_an_error_in_one_of_two_recordings_is_named_by_it():
    sine = 0.3 * np.sin(2 * np.pi * 1.1 * TIME)
    lines = np.fft.rfftfreq(8000, DT)
    phases = np.exp(2j * np.pi * rng(1).uniform(size=len(lines)))
    error = np.fft.irfft(np.where((lines > 0.1) & (lines < 5.0), 1 / np.sqrt(np.maximum(lines, 0.1)), 0.0) * phases)
    good = track(np.zeros(8000), sine, name="good", seed=1)
    bad = track(1e-3 * error / error.std(), sine, name="bad", seed=2, group=1)
    where = compare_joint("knee", 0, [good, bad]).content["where"]["recording"]
    assert where["error"][1] > 0.98 and where["time"] == pytest.approx([0.5, 0.5])


def test_three_places_over_all_joints_the_largest_first():
    joints = [compare_joint(f"j{k}", 0, [track(scale * reversal_error())]) for k, scale in enumerate((1, 3, 0, 2, 0.5))]
    worst = worst_places([joint.places for joint in joints])
    assert [place.joint for place in worst] == ["j1", "j3", "j0"]


def test_two_places_of_one_joint_hold_different_parts():
    fast = np.where(np.abs(motion_of(CHIRP, DT, 0.0).speed) > 13.0, 2e-3, 0.0)
    places = compare_joint("knee", 0, [track(reversal_error() + fast)]).places
    masks = [place.mask for place in places if place.mask is not None]
    for i, one in enumerate(masks):
        assert all((one & other).sum() < 0.5 * min(one.sum(), other.sum()) for other in masks[:i])


# ---------------------------------------------------------------- frequency, loops, whiteness


def test_bands_hold_the_whole_error():
    error = rng().standard_normal(4001) + 0.3
    edges = band_edges(4001 * DT, DT)
    power = band_power(error, DT, edges)
    assert power.sum() == pytest.approx(np.square(error).sum())
    tone = band_power(np.sin(2 * np.pi * 20.0 * TIME), DT, band_edges(20.0, DT))
    b = int(tone.argmax())
    assert tone[b] > 0.99 * tone.sum() and band_edges(20.0, DT)[b] < 20.0 < band_edges(20.0, DT)[b + 1]


def test_the_narrowest_band_that_holds_most():
    assert narrowest_band(np.array([0.1, 0.1, 0.5, 0.2, 0.1])) == (2, 3)
    assert narrowest_band(np.zeros(4)) is None


def test_the_response_of_a_known_filter():
    """H = 1 / (1 + s T) with T = 50 ms, and the same with twice the gain; without a command there is nothing."""
    n = 16000
    command = np.fft.irfft(np.where(np.fft.rfftfreq(n, DT) < 10.0, np.fft.rfft(rng().standard_normal(n)), 0))
    lag = np.fft.irfft(np.fft.rfft(command) / (1 + 2j * np.pi * np.fft.rfftfreq(n, DT) * 0.05))
    found = response(command, lag, 2 * lag, DT)
    frequency = np.array(found["frequency"])
    assert 0.03 < frequency.min() < 0.2 and 8.0 < frequency.max() < 10.5
    expected = 1 / (1 + 2j * np.pi * frequency * 0.05)
    inner = frequency > 0.5
    for name, gain in (("measured", 1.0), ("model", 2.0)):
        magnitude = 20 * np.log10(gain * np.abs(expected))
        assert found[name]["magnitude_db"][inner] == pytest.approx(magnitude[inner], abs=0.15)
        assert found[name]["phase_deg"][inner] == pytest.approx(np.degrees(np.angle(expected))[inner], abs=2.5)
        assert found[name]["coherence"][inner].min() > 0.98
    assert found["largest"]["magnitude_db"]["difference"] == pytest.approx(6.02, abs=0.01)
    assert response(np.zeros(n), lag, lag, DT) is None


def test_the_width_of_a_known_loop():
    position = 0.5 * np.sin(2 * np.pi * 0.5 * TIME)
    motion = motion_of(position, DT, 1e-6)
    offset = 0.01 * motion.direction + 0.02 * position
    content = hysteresis(motion, offset, 0.004 * motion.direction)
    assert content["measured"]["half_width"] == pytest.approx(0.01, rel=0.02)
    assert content["model"]["half_width"] == pytest.approx(0.006, rel=0.03)
    assert content["error"]["half_width"] == pytest.approx(0.004, rel=0.02)
    assert hysteresis(motion_of(np.zeros(2000), DT, 1e-4), np.zeros(2000), np.zeros(2000)) == {}


def test_white_noise_is_white_and_correlated_noise_is_not():
    white = whiteness(rng().standard_normal(24_000), DT)
    assert abs(white["lag_1"]) < 0.03 and white["correlation_time"] == pytest.approx(DT, rel=0.15)
    assert white["ljung_box"]["p"] > 1e-3
    red = whiteness(first_order(0.9, count=24_000), DT)
    assert red["predictable"] == pytest.approx(0.81, abs=0.04)
    assert red["correlation_time"] == pytest.approx(19 * DT, rel=0.25)
    assert red["ljung_box"]["p"] < 1e-10
    assert whiteness(np.ones(100), DT)["lag_1"] == 0.0


# ---------------------------------------------------------------- load


@pytest.mark.slow
def test_the_load_torque_of_a_pendulum_is_its_equation():
    """τ = m l² q̈ + m g l sin q, of the stated load, at the joint's own position (encoder + bias)."""
    target = 0.6 * np.sin(2 * np.pi * 0.8 * np.arange(1201) * DT)[:, None]
    recordings = [record(target), record(target, load=Load(load_mass=2.5, load_length=0.3), name="heavy")]
    problem = make_problem(recordings, cfg=env_cfg(BENCH))
    bias = 0.02
    loads = load_torques(problem.evaluator(), np.array([bias]))
    for recording, load, mass, length in zip(recordings, loads, (1.0, 2.5), (0.2, 0.3), strict=True):
        q = recording.dof_pos[:, 0] + bias
        acceleration = np.gradient(np.gradient(q, DT), DT)
        expected = mass * length**2 * acceleration + mass * 9.81 * length * np.sin(q)
        middle = slice(200, -200)
        scale = np.abs(expected[middle]).max()
        assert np.sqrt(np.mean(np.square(load[middle, 0] - expected[middle]))) < 0.03 * scale


def test_a_joint_that_never_turns_round_has_no_reversal():
    motion = motion_of(np.linspace(0.0, 1.0, 400), DT, 1e-5)
    assert np.isinf(motion.since_reversal).all() and (motion.direction == 1).all()
