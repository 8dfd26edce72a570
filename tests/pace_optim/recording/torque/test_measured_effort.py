"""What the torque in a recording says of the drive."""

import json
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from places import SHARED
from problems import TRUTH, chirp, record
from scipy.signal import savgol_filter

import pace_optim.identification.fit as fit_module
from pace_optim.identification.fit import fit_with_torques
from pace_optim.problem.problem import load_problem
from pace_optim.recording import Drive, Recording, conform_recording, save_recording
from pace_optim.recording.torque import read_drives, read_law
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.progress import ProgressLine

BENCH, DT = "Pace-TestBench-v0", 0.0025
CASE = SHARED / "cases/bench/measured_effort_and_speed.csv"
CONFIGURED = {"stiffness": np.array([85.0]), "damping": np.array([0.6]), "effort_limit": np.array([np.inf])}


def sines(time: np.ndarray, seed: int, size: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0, 2 * np.pi, 8)
    return size * sum(np.sin(2 * np.pi * f * time + p) for f, p in zip(np.geomspace(0.3, 7, 8), phases, strict=True))


def recorded(
    *, kp=40.0, kd=1.0, delay=3, lag=0, speed_lag=0, limit=np.inf, noise=0.0, offset=0.0, feed_forward=None,
    seconds=8.0, measured_speed=True, stated=None, position=True,
) -> Recording:  # fmt: skip
    """A motion and the torque that a drive asks for along it; commands and positions come so many steps late in it."""
    time = np.arange(round(seconds / DT)) * DT
    target, moved = sines(time, 1, 0.1), sines(time - 0.01, 2, 0.1)
    speed = np.gradient(moved, DT)
    late = np.maximum(np.arange(len(time)) - delay - lag, 0)
    now = np.maximum(np.arange(len(time)) - lag, 0)
    torque = kp * (target[late] - moved[now]) - kd * speed[np.maximum(now - speed_lag, 0)] + offset
    given = None
    if feed_forward is not None:
        given = sines(time, 3, 1.0)
        torque += feed_forward * given[late]
    torque = np.clip(torque, -limit, limit) + noise * np.random.default_rng(0).normal(size=len(time))
    recording = Recording(
        name="r",
        joint_names=("servo",),
        time=time,
        dof_pos=moved[:, None],
        des_dof_pos=target[:, None] if position else None,
        des_dof_effort=None if given is None else given[:, None],
        dof_vel=speed[:, None] if measured_speed else None,
        dof_effort=torque[:, None],
        drive=Drive(**{k: np.array([v]) for k, v in (stated or {}).items()}),
    )
    return conform_recording(recording, joint_order=("servo",), control_dt=DT)


def drives(*recordings: Recording, unknown=(), assumed=("servo",)):
    return read_drives(
        recordings,
        CONFIGURED,
        delay_bounds=(0.0, 10.0),
        delay_mode="command",
        control_dt=DT,
        unknown=unknown,
        assumed=assumed,
    )


def test_gains_and_delay_are_read():
    law = read_law(recorded(), 0, 10)
    assert (law.stiffness, law.damping, law.delay) == pytest.approx((40, 1, 3), abs=1e-3)
    assert law.limit is None and law.r_squared > 0.99999 and law.feedback_lag == 0


def test_the_speed_may_be_that_of_the_positions():
    law = read_law(recorded(measured_speed=False), 0, 10)
    assert (law.stiffness, law.damping) == pytest.approx((40, 1), rel=0.01)


def test_a_log_may_have_its_torques_late():
    law = read_law(recorded(lag=2), 0, 10)
    assert (law.stiffness, law.delay, law.feedback_lag) == pytest.approx((40, 3, 2), abs=1e-2)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_drives_speed_may_be_older_than_its_position(noise):
    law = read_law(recorded(kp=400.0, kd=8.0, delay=0, speed_lag=1, noise=noise), 0, 10)
    assert (law.feedback_lag, law.speed_lag) == pytest.approx((0, 1)) and 0 <= law.delay < 0.01
    assert (law.stiffness, law.damping) == pytest.approx((400, 8), rel=2e-3)


def test_no_delay_is_negative():
    assert read_law(recorded(delay=0, lag=1, speed_lag=1, noise=0.3), 0, 10).delay >= 0


def test_torques_commanded_beside_a_damping_say_that_damping():
    law = read_law(recorded(kp=0, kd=0.5, feed_forward=1.0, position=False), 0, 10)
    assert (law.damping, law.feed_forward) == pytest.approx((0.5, 1.0), rel=1e-3) and law.r_squared > 0.9999


def test_an_idle_joints_torque_is_no_law():
    recording = recorded(kp=0, kd=0, feed_forward=1.0, position=False)
    still = np.full_like(recording.dof_pos, 0.001)
    none = np.zeros_like(recording.des_dof_effort)
    noise = 0.01 * np.random.default_rng(0).normal(size=still.shape)
    idle = replace(recording, dof_pos=still, dof_vel=None, des_dof_effort=none, command_effort=none, dof_effort=noise)
    assert read_law(idle, 0, 10) is None


@pytest.mark.parametrize(("limit", "noise"), [(8.0, 0.0), (4.0, 0.0), (6.0, 0.3)])
def test_torque_that_is_cut_gives_the_limit_and_not_the_gains(limit, noise):
    law = read_law(recorded(limit=limit, noise=noise), 0, 10)
    assert law.limit == pytest.approx(limit, rel=0.02)
    assert (law.stiffness, law.damping) == pytest.approx((40, 1), rel=0.02)


def test_error_bars_hold_the_truth():
    law = read_law(recorded(noise=0.5), 0, 10)
    assert abs(law.stiffness - 40) < 4 * law.std["stiffness"] < 2
    assert abs(law.damping - 1) < 4 * law.std["damping"] < 0.1
    assert law.residual == pytest.approx(0.5, rel=0.1)


def test_feed_forward_is_read_and_simulated_as_the_drive_takes_it():
    recording = recorded(feed_forward=0.5)
    law = read_law(recording, 0, 10)
    assert (law.feed_forward, law.stiffness) == pytest.approx((0.5, 40), abs=1e-2)
    taken = drives(recording).recordings[0]
    assert taken.command_effort == pytest.approx(law.feed_forward * recording.command_effort)


@pytest.mark.slow
def test_a_feed_forward_in_one_recording_of_two_is_read():
    several = replace(recorded(feed_forward=0.5), name="a"), replace(recorded(seconds=6.0), name="b")
    for order in (several, several[::-1]):
        (line, *_) = drives(*order).notes
        assert "feed-forward 0.5 ±" in line and "kp 40" in line


def test_a_gain_of_a_joint_without_a_sensor_is_refined_within_what_its_torque_says():
    found = drives(recorded(noise=0.1))
    factors = {"stiffness": "proportional_gain.gain"}
    alone, other, own = (
        found.gain_bounds(["stiffness"], factors, sensed)["proportional_gain.gain"]["servo"]
        for sensed in ((), ("knee",), ("servo",))
    )
    assert alone == other and own == (0.2, 1.0, 5.0)


def test_a_constant_torque_of_the_drive_is_simulated():
    taken = drives(recorded(offset=3.0)).recordings[0]
    assert taken.command_effort == pytest.approx(3.0, abs=0.01)
    assert drives(recorded()).recordings[0].command_effort is None


def test_a_torque_drive_has_no_gains_to_read():
    law = read_law(recorded(kp=0, kd=0, feed_forward=1.0, position=False), 0, 10)
    assert law.feed_forward == pytest.approx(1.0) and "stiffness" not in law.std and "damping" not in law.std


def test_what_nobody_stated_is_taken_from_the_torque():
    found = drives(recorded(limit=8.0))
    drive = found.recordings[0].drive
    assert (drive.stiffness[0], drive.damping[0], drive.effort_limit[0]) == pytest.approx((40, 1, 8), rel=0.01)
    assert found.taken["stiffness"] == {"servo"} and found.delay_bounds == pytest.approx((2, 4), abs=0.01)
    assert len(found.notes) == 2 and "kp 40 " in found.notes[0] and "7.5 ms" in found.notes[0]
    assert not found.contested


def test_what_the_robot_states_holds_until_a_fit_says_better():
    found = drives(recorded(), assumed=())
    assert found.recordings[0].drive.stiffness is None and found.contested == ("stiffness", "damping")
    assert "configured as 85" in found.warnings[0] and "says 40" in found.warnings[0] and "is used" in found.warnings[0]


@pytest.mark.parametrize(
    ("factor", "word"), [(180 / np.pi, "180/pi times that"), (1 / (2 * np.pi), "2 pi times less"), (1000.0, "mN m")]
)
def test_a_gain_that_is_off_by_a_unit_says_so(factor, word):
    found = drives(recorded(stated={"stiffness": 40.0 / factor, "damping": 1.0}))
    assert word in found.warnings[0]


def test_what_is_stated_holds_and_a_contradiction_is_told_with_both_numbers():
    found = drives(recorded(stated={"stiffness": 20.0, "damping": 1.0}))
    assert found.recordings[0].drive.stiffness[0] == 20.0 and "stiffness" not in found.taken
    (said,) = found.warnings
    assert "stated as 20" in said and "says 40" in said and "--unknown stiffness" in said
    assert not drives(recorded(stated={"stiffness": 40.5, "damping": 1.0})).warnings


def test_what_is_declared_unknown_is_taken_from_the_torque():
    found = drives(recorded(stated={"stiffness": 20.0, "damping": 1.0}), unknown=["stiffness"])
    assert found.recordings[0].drive.stiffness[0] == pytest.approx(40, rel=0.01)


def test_a_torque_that_follows_no_law_is_not_used():
    recording = recorded()
    other = np.random.default_rng(0).normal(size=recording.dof_effort.shape)
    found = drives(replace(recording, dof_effort=other))
    assert found.recordings[0].drive.stiffness is None and found.delay_bounds is None
    assert "not the torque of a PD law" in found.notes[0]


def test_nothing_is_read_where_there_is_no_torque():
    recording = replace(recorded(), dof_effort=None)
    assert read_law(recording, 0, 10) is None
    found = drives(recording)
    assert found.recordings[0].drive is recording.drive and not found.notes and not found.to_dict()


def test_torque_of_a_drive_that_is_off_says_nothing():
    recording = recorded()
    on = np.ones(recording.num_samples, dtype=bool)
    on[1000:2000] = False
    torque = np.where(on[:, None], recording.dof_effort, 0.0)
    law = read_law(replace(recording, torque_enable=on, dof_effort=torque), 0, 10)
    assert (law.stiffness, law.delay) == pytest.approx((40, 3), abs=0.01)


def test_torque_that_comes_as_late_as_its_position_may_be_delayed_torque():
    found = drives(recorded(delay=0, lag=3))
    assert found.delay_bounds is None and "--delay_mode effort" in found.notes[-1]


def test_recordings_at_other_gains_are_one_line():
    found = drives(recorded(kp=20.0), replace(recorded(), name="s"))
    assert "kp 20 to 40" in found.notes[0] and len(found.notes) == 2
    assert [r.drive.stiffness[0] for r in found.recordings] == pytest.approx([20, 40], rel=0.01)


@pytest.mark.skipif(not CASE.is_file(), reason="needs ../shared/cases")
def test_a_log_with_its_drives_own_torque_says_gains_and_delay(tmp_path):
    target = tmp_path / "log.csv"
    target.write_text(CASE.read_text())
    facts = json.loads(CASE.with_suffix(".json").read_text())
    del facts["stiffness"], facts["damping"]
    target.with_suffix(".json").write_text(json.dumps(facts))
    problem = load_problem(BENCH, data=[target], unknown=["stiffness", "damping"])
    (recording,) = problem.dataset.recordings
    assert (recording.drive.stiffness[0], recording.drive.damping[0]) == pytest.approx((40, 1), rel=1e-3)
    low, high = (
        float(bound[problem.space["proportional_gain.gain"]]) for bound in (problem.space.lower, problem.space.upper)
    )
    assert (low, high) == pytest.approx((0.99, 1.01), abs=1e-6)
    law = problem.measured.to_dict()["servo"]["log"]
    assert DT * law["delay"] == pytest.approx(0.005, abs=1e-5) and law["limit"] is None
    low, high = (float(bound[problem.space["delay"]]) for bound in (problem.space.lower, problem.space.upper))
    assert (low, high) == pytest.approx((1, 3), abs=0.01)


def test_a_log_at_another_rate_than_the_drive_is_read_at_its_own_samples():
    rng = np.random.default_rng(3)
    fine = np.arange(0, 8, 1e-4)
    moved, target = sines(fine - 0.01, 2, 0.1), sines(fine, 1, 0.1)
    ticks = np.arange(0, len(fine), 25)  # the drive runs at 400 Hz, commands come at 200 Hz
    command = target[(ticks // 50) * 50]
    torque = 40.0 * (command[np.maximum(np.arange(len(ticks)) - 2, 0)] - moved[ticks]) - np.gradient(moved, 1e-4)[ticks]
    rows = np.unique(np.clip(np.arange(0, len(fine), 20) + rng.integers(-1, 2, len(fine) // 20), 0, None))
    recording = Recording(
        name="r",
        joint_names=("servo",),
        time=fine[rows],
        dof_pos=moved[rows, None],
        dof_vel=np.gradient(moved, 1e-4)[rows, None],
        dof_effort=torque[rows // 25, None],
        des_dof_pos=target[::50, None],
        des_time=fine[::50],
    )
    law = read_law(conform_recording(recording, joint_order=("servo",), control_dt=DT), 0, 10)
    assert law.stiffness == pytest.approx(40, rel=0.03) and law.damping == pytest.approx(1, rel=0.03)
    assert 2 - law.resolution <= law.delay <= 2 + law.resolution


@pytest.mark.slow
def test_a_gain_that_torques_contradict_is_used_where_it_fits_better(tmp_path, monkeypatch):
    monkeypatch.setattr(fit_module, "write_report", lambda folder: None)
    kp, kd, delay, stated = 85.0, 0.6, 2, 60.0
    made = record(target := chirp(2.0), TRUTH | {"delay": float(delay)}, noise=1e-4)
    q, late = made.dof_pos, np.maximum(np.arange(len(target)) - delay, 0)
    speed = savgol_filter(q, 9, 3, deriv=1, delta=DT, axis=0)
    gains = Drive(stiffness=np.array([stated]), damping=np.array([kd]))
    made = replace(made, dof_effort=kp * (target[late] - q) - kd * speed, drive=gains)
    save_recording(tmp_path / "log.npz", made)
    told = StringIO()
    settings = FitSettings(
        task=BENCH,
        data=[str(tmp_path / "log.npz")],
        optimizer="least_squares",
        check_consistency=False,
        log_dir=str(tmp_path),
    )
    result, folder = fit_with_torques(settings, ProgressLine(told))
    assert "this fit is kept" in told.getvalue() and folder == max(folder.parent.iterdir(), key=lambda f: f.name)
    assert result.parameters["armature"]["servo"] == pytest.approx(0.1, rel=0.05)
    assert result.rmse["train"]["all"] < 2e-4
    assert "stiffness" in FitSettings.load(folder / "settings.json")[0].unknown
