"""How fast a recording begins, where it holds no speeds."""

from dataclasses import replace

import numpy as np
import pytest
from places import SHARED
from problems import DT, record

from pace_optim.recording import conform_recording, load_recording
from pace_optim.recording.dataset import make_dataset, start_speed

IN_MOTION = SHARED / "cases" / "strangers" / "in_motion2"


def beginning(speed, acceleration=0.0, noise=1e-4, seed=0):
    """The bench's recording with another motion."""
    recording = record()
    t = recording.time
    q = speed * t + 0.5 * acceleration * t**2 * np.exp(-t / 0.1)
    shown = q + noise * np.random.default_rng(seed).standard_normal(len(t))
    return replace(recording, dof_pos=shown[:, None], dof_vel=None)


def test_a_slope_that_stands_out_of_the_noise_is_the_start_speed():
    found = [start_speed(beginning(1.3, 20.0, seed=seed))[0][0] for seed in range(10)]
    assert np.mean(found) == pytest.approx(1.3, abs=0.03) and np.std(found) < 0.06


@pytest.mark.parametrize("noise", [0.0, 1e-4])
@pytest.mark.parametrize("acceleration", [0.0, 30.0])
def test_what_begins_at_rest_begins_at_rest(noise, acceleration):
    for seed in range(10):
        speed, known = start_speed(beginning(0.0, acceleration, noise, seed))
        assert speed.tolist() == [0.0] and known.all()


def test_a_recorded_speed_is_taken():
    recording = replace(beginning(1.3), dof_vel=np.full((len(record().time), 1), 0.7))
    assert start_speed(recording)[0].tolist() == [0.7]


def test_recordings_of_an_arm_in_motion_have_the_speeds_that_were_recorded_beside_them():
    if not IN_MOTION.exists():
        pytest.skip("../shared is not here")
    for name in "ab":
        found, _ = start_speed(load_recording(IN_MOTION / f"{name}.npz"))
        recorded = load_recording(IN_MOTION / f"{name}v.npz").dof_vel[0]
        assert found == pytest.approx(recorded, abs=0.02)


@pytest.mark.slow
def test_the_first_second_is_left_out_where_no_slope_can_be_told():
    recording = record(np.zeros((2001, 1)))
    rough = np.random.default_rng(0).uniform(-0.1, 0.1, 40)
    shown = recording.dof_pos + 1e-4 * np.random.default_rng(1).standard_normal(recording.dof_pos.shape)
    shown[:40, 0] += rough
    recording = conform_recording(replace(recording, dof_pos=shown), joint_order=recording.joint_names, control_dt=DT)
    data = make_dataset([recording])
    assert float(data.start_vel[0, 0]) == 0.0
    assert not data.train[:400].any() and not data.validation[:400].any() and bool(data.train[401])
    assert "the first 1 s are left out" in data.recordings[0].notes[-1]
