"""Excitations: closed forms, ranges, smooth starts, reproducibility; and the check of a motion against a robot."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from pace_envs import load_env_cfg
from pace_envs.tasks.pace import ExcitationCfg, PaceCfg
from pace_optim.motion.design.motion_check import (
    MotionLimits,
    check_command,
    check_simulated,
    refuse_errors,
    summarise,
)
from pace_optim.motion.signals import Trajectory, excitations, make_excitation, register_excitation, write_command_csv

DT = 0.0025
TASKS = ("Pace-AnymalD-v0", "Pace-Go2-v0", "Pace-SO101-v0", "Pace-TestBench-v0")
NAMES = ("battery", "chirp", "multisine", "ramp", "steps")


def robot(bias=(0.0, 0.4), direction=(1.0, -1.0), scale=(0.25, 0.5)) -> PaceCfg:
    joints = ("hip", "knee")
    pairs = dict.fromkeys(("armature", "viscous_friction", "friction", "encoder_bias", "delay"), (0.0, 1.0))
    return PaceCfg(
        robot_name="two_joints",
        data_dir="none.npz",
        joint_order=joints,
        bounds=pairs,
        excitation=ExcitationCfg(bias=bias, direction=direction, scale=scale),
    )


def make(name: str, cfg: PaceCfg | None = None, **options) -> list[Trajectory]:
    return make_excitation(name, cfg or robot(), control_dt=DT, **options)


def test_every_excitation_is_registered():
    assert tuple(e.name for e in excitations()) == NAMES


def test_chirp_is_the_reference_formula():
    (chirp,) = make("chirp", load_env_cfg("Pace-AnymalD-v0").sim2real)
    assert chirp.time.shape == (8000,) and chirp.time[0] == 0.0 and chirp.time[4000] == pytest.approx(10.0)
    # at 10 s the phase is 2π (0.1 · 10 + 9.9 / 40 · 100) = 2π · 25.75, so the sine is -1
    assert chirp.des_dof_pos[4000, :3] == pytest.approx([-0.25, 0.5 * (-1 + 0.4), -2.0 * (-1 + 0.8)], abs=1e-9)
    # at 2 s: 2π (0.2 + 0.99) = 2π · 1.19
    s = np.sin(2 * np.pi * 0.19)
    expected = np.array([0.25 * s, 0.5 * (s + 0.4), -2.0 * (s + 0.8)])
    assert chirp.des_dof_pos[800] == pytest.approx(
        np.concatenate([expected, expected * [-1, 1, 1], expected * [1, -1, -1], -expected]), abs=1e-12
    )


def test_a_direction_of_minus_one_mirrors_the_motion():
    (plus,) = make("chirp", robot(direction=(1, 1)))
    (minus,) = make("chirp", robot(direction=(1, -1)))
    assert np.array_equal(plus.des_dof_pos * [1, -1], minus.des_dof_pos)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", NAMES)
def test_motions_start_at_the_centre_and_stay_in_range(task, name):
    cfg = load_env_cfg(task).sim2real
    e = cfg.excitation
    scale = np.abs(e.scale)
    centre = np.array(e.bias) * e.direction * e.scale
    for trajectory in make(name, cfg):
        away = np.abs(trajectory.des_dof_pos - centre)
        assert np.all(away <= scale + 1e-9)
        assert np.all(away[0] == 0.0)
        assert np.all(np.ptp(trajectory.des_dof_pos, axis=0) > 0.05 * scale)
        assert np.all(np.abs(np.diff(trajectory.des_dof_pos[:2], axis=0)) < 0.01 * scale), "no jump at the start"


@pytest.mark.parametrize("name", NAMES)
def test_only_the_seed_decides(name):
    one, same, other = make(name, seed=3), make(name, seed=3), make(name, seed=4)
    equal = [np.array_equal(a.des_dof_pos, b.des_dof_pos) for a, b in zip(one, same, strict=True)]
    assert all(equal)
    differs = [not np.array_equal(a.des_dof_pos, b.des_dof_pos) for a, b in zip(one, other, strict=True)]
    assert any(differs) == (name in ("battery", "multisine", "steps"))


def test_battery_holds_six_motions_of_ten_seconds():
    parts = make("battery")
    names = ["chirp_small", "chirp_medium", "chirp_large", "triangle", "steps", "staircase"]
    assert [part.name for part in parts] == names
    assert all(len(part.time) == 4000 for part in parts)
    heights = [np.ptp(part.des_dof_pos[:, 0]) / 2 for part in parts]
    assert heights[:3] == pytest.approx([0.25 / 8, 0.25 / 2, 0.25], rel=1e-3)  # 0.1 : 0.4 : 0.8
    assert [part.has_jumps for part in parts] == [False] * 4 + [True, False]


def test_staircase_holds_every_level_and_comes_from_both_sides():
    (stairs,) = [part for part in make("battery") if part.name == "staircase"]
    signal = stairs.des_dof_pos[:, 0] / 0.25
    held = [signal[round((i + 0.3) / 9 * 4000)] for i in range(9)]
    assert held == pytest.approx([0, 0.5, 1, 0.5, 0, -0.5, -1, -0.5, 0])
    assert np.abs(np.diff(signal)).max() < 0.01


def test_steps_last_half_to_one_second():
    (steps,) = make("steps", duration=40.0)
    for column in steps.des_dof_pos.T:
        at = np.flatnonzero(np.diff(column)) * DT
        assert np.all(np.diff(at) >= 0.5 - DT) and np.all(np.diff(at) <= 1.0 + DT)
        assert 0.5 - DT <= at[0] <= 1.0
    assert not np.array_equal(np.diff(steps.des_dof_pos[:, 0]) != 0, np.diff(steps.des_dof_pos[:, 1]) != 0)


@pytest.mark.parametrize("duration", [10.0, 20.0, 60.0])
def test_ramp_moves_at_the_same_slow_speed_up_and_down(duration):
    (ramp,) = make("ramp", robot(scale=(0.25, 3.0)), duration=duration)
    speed = np.diff(ramp.des_dof_pos, axis=0) / DT
    assert np.median(np.abs(speed), axis=0) == pytest.approx([0.15, 0.15])
    assert np.abs(speed).max() <= 0.15 + 1e-9
    for column in np.sign(speed.round(6)).T:
        assert 0.3 < (column > 0).mean() < 0.7


def test_a_ramp_of_a_slide_has_a_tenth_of_the_speed():
    (ramp,) = make("ramp", replace(robot(scale=(0.25, 0.2)), slide_joints=("knee",)), duration=60.0)
    assert np.median(np.abs(np.diff(ramp.des_dof_pos, axis=0)), axis=0) / DT == pytest.approx([0.15, 0.015])


def test_multisine_excites_odd_lines_alone_and_repeats():
    (multisine,) = make("multisine")
    signal = multisine.des_dof_pos[:, 0]
    assert len(signal) == 16000
    periods = signal.reshape(4, 4000)
    assert np.allclose(periods[1], periods[2]) and np.allclose(periods[2], periods[3])
    spectrum = np.abs(np.fft.rfft(periods[1] - periods[1].mean())) / 4000
    lines = np.flatnonzero(spectrum > 1e-3 * spectrum.max())
    assert np.all(lines % 2 == 1) and lines[0] >= 1 and lines[-1] <= 100  # 0.1 to 10 Hz in steps of 0.1 Hz
    assert len(lines) == pytest.approx(2 / 3 * 50, abs=2)
    assert np.ptp(spectrum[lines]) < 1e-9  # equal amplitudes
    joints = np.corrcoef(multisine.des_dof_pos.T)
    assert abs(joints[0, 1]) < 0.5, "each joint has phases of its own"


def test_multisine_stays_in_the_band():
    (multisine,) = make("multisine", min_frequency=1.0, max_frequency=5.0)
    spectrum = np.abs(np.fft.rfft(multisine.des_dof_pos[4000:8000, 0]))
    spectrum[0] = 0
    frequencies = np.flatnonzero(spectrum > 1e-6 * spectrum.max()) * 0.1
    assert frequencies.min() >= 1.0 - 1e-9 and frequencies.max() <= 5.0 + 1e-9


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("chrip", {}, "Did you mean 'chirp'"),
        ("chirp", {"duration": 0.01}, "0.05 s"),
        ("chirp", {"duration": -1.0}, "3600"),
        ("chirp", {"duration": float("nan")}, "nan"),
        ("chirp", {"min_frequency": 0.0}, "0 < min_frequency"),
        ("chirp", {"min_frequency": 5.0, "max_frequency": 1.0}, "min_frequency < max_frequency"),
        ("chirp", {"max_frequency": 200.0}, "200 Hz"),
        ("steps", {"seed": -1}, "seed"),
        ("multisine", {"duration": 1.0}, "at least 3"),
        ("chirp", {"cfg": robot(bias=(0.0,))}, "expected 2 finite numbers"),
        ("chirp", {"cfg": robot(scale=(0.2, float("inf")))}, "excitation.scale"),
    ],
)
def test_what_cannot_be_met_is_refused(name, options, says):
    with pytest.raises(ValueError, match=says):
        make(name, **options)


def test_a_robot_without_excitation_is_told_so():
    cfg = robot()
    cfg.excitation = None
    with pytest.raises(ValueError, match="two_joints has no excitation"):
        make("chirp", cfg)


def test_an_excitation_of_ones_own_is_one_function():
    @register_excitation("test_sine", "a sine", duration=5.0)
    def sine(motion):
        return [motion.trajectory("sine", np.sin(2 * np.pi * motion.time))]

    (trajectory,) = make("test_sine")
    assert len(trajectory.time) == 2000
    with pytest.raises(ValueError, match="already registered"):
        register_excitation("test_sine", "again")(sine)
    from pace_optim.motion.signals import registry

    del registry._EXCITATIONS["test_sine"]


def test_commands_written_as_csv_read_back_bit_for_bit(tmp_path):
    (chirp,) = make("chirp", duration=2.0)
    path = write_command_csv(tmp_path / "new" / "chirp.csv", chirp)
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header == ["time", "des_dof_pos/hip", "des_dof_pos/knee"]
    values = np.array(rows, dtype=float)
    assert np.array_equal(values[:, 0], chirp.time) and np.array_equal(values[:, 1:], chirp.des_dof_pos)
    assert [p.name for p in path.parent.iterdir()] == ["chirp.csv"]


# --- the check of a motion

TIME = np.arange(400) * DT
LIMITS = MotionLimits(
    joint_names=("hip", "knee"),
    position=np.array([[-1.0, 1.0], [-np.inf, np.inf]]),
    velocity=np.array([5.0, np.inf]),
    effort=np.array([10.0, np.inf]),
)


def motion(hip, knee=None, **options) -> Trajectory:
    knee = np.zeros_like(TIME) if knee is None else knee
    return Trajectory(
        name="m", time=TIME, des_dof_pos=np.stack([hip, knee], axis=1), joint_names=("hip", "knee"), **options
    )


def test_a_motion_within_limits_has_no_findings():
    assert check_command(motion(0.9 * np.sin(5 * TIME)), LIMITS) == []


def test_a_target_beyond_a_joint_limit_is_an_error_that_says_where():
    (finding,) = check_command(motion(1.5 * TIME, knee=100 * TIME), LIMITS)
    assert finding.is_error and (finding.joint, finding.quantity, finding.limit) == ("hip", "target", 1.0)
    assert finding.value == pytest.approx(1.5 * TIME[-1]) and finding.time == pytest.approx(TIME[-1])
    with pytest.raises(ValueError, match=r"'m' must not be sent.* hip: its target is 1\.496 rad at 1\.00 s"):
        refuse_errors([finding], "m", "this robot")


def test_the_lower_limit_counts_too():
    (finding,) = check_command(motion(-1.2 * TIME), LIMITS)
    assert finding.limit == -1.0


def test_fast_targets_are_a_warning_but_steps_are_excepted():
    step = np.where(TIME > 0.5, 0.5, 0.0)
    (finding,) = check_command(motion(step), LIMITS)
    assert not finding.is_error and finding.quantity == "speed"
    assert finding.value == pytest.approx(0.5 / DT) and finding.share == pytest.approx(1 / 399)
    refuse_errors([finding], "m", "this robot")
    assert check_command(motion(step, has_jumps=True), LIMITS) == []


@pytest.mark.parametrize(("share", "is_error"), [(0.0, None), (0.2, False), (0.6, True)])
def test_torque_at_its_limit_for_most_of_the_time_is_an_error(share, is_error):
    torque = np.full((399, 2), 3.0)
    torque[: round(399 * share), 0] = -10.0
    findings = check_simulated(TIME, np.zeros((400, 2)), torque, LIMITS)
    assert [f.is_error for f in findings] == ([] if is_error is None else [is_error])
    if findings:
        assert findings[0].share == pytest.approx(share, abs=0.002)


def test_a_simulated_position_beyond_its_limit_is_a_warning():
    (finding,) = check_simulated(TIME, np.outer(1.2 * TIME, [1, 0]), np.zeros((399, 2)), LIMITS)
    assert not finding.is_error and finding.quantity == "position"


def test_the_summary_has_one_line_per_quantity():
    limits = MotionLimits(
        joint_names=("hip", "knee"), position=LIMITS.position, velocity=np.array([5.0, 5.0]), effort=LIMITS.effort
    )
    findings = check_command(motion(np.sin(6 * TIME), knee=np.sin(9 * TIME)), limits)
    (line,) = summarise(findings)
    assert line.startswith("knee: its target moves at up to 9 rad/s") and line.endswith("Likewise: hip.")


def test_other_joints_than_the_limits_are_refused():
    trajectory = Trajectory(name="m", time=TIME, des_dof_pos=np.zeros((400, 2)), joint_names=("knee", "hip"))
    with pytest.raises(ValueError, match="same order"):
        check_command(trajectory, LIMITS)
