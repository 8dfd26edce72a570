"""Recordings too long to fit are cut to the parts that move the joints most; what was left out is told."""

from dataclasses import replace

import numpy as np
import pytest
from problems import BENCH, TRUTH, chirp, env_cfg, record, replayed

from pace_optim.problem.problem import load_problem
from pace_optim.recording import Recording, conform_recording, load_recording, save_recording
from pace_optim.recording import parts as parts_module
from pace_optim.recording.dataset import make_dataset
from pace_optim.recording.parts import affordable, informative_parts

DT = 0.01


def joint_by_joint(joints=4, seconds=80.0, vel=False):
    """Each joint moves for some seconds while the others stand still; between them nothing moves."""
    time = np.arange(0.0, seconds, DT)
    pos = np.zeros((len(time), joints))
    for j in range(joints):
        here = (time >= 20.0 * j + 7) & (time < 20.0 * j + 12)
        pos[here, j] = 0.3 * np.sin(4.0 * (time[here] - 7))
    speed = {"dof_vel": np.gradient(pos, DT, axis=0)} if vel else {}
    recording = Recording(name="r", joint_names=tuple("abcd"), time=time, dof_pos=pos, des_dof_pos=pos + 0.01, **speed)
    return conform_recording(recording, joint_order=tuple("abcd"), control_dt=DT)


def test_the_parts_move_every_joint():
    parts = informative_parts(joint_by_joint(), 40.0)
    assert len(parts) == 8 and all(part.duration == pytest.approx(5.0 - DT) for part in parts)
    moved = sum((np.ptp(part.dof_pos, axis=0) > 0.1).astype(int) for part in parts)
    assert (moved >= 1).all()
    assert "of 79.99 s the 40 s that move the joints most are used (50 %), in 8 parts" in parts[0].notes[-1]
    assert [part.time_origin for part in parts] == sorted({part.time_origin for part in parts})


@pytest.mark.parametrize("vel", [False, True])
def test_a_part_is_what_was_recorded_there(vel):
    whole = joint_by_joint(vel=vel)
    for part in informative_parts(whole, 20.0):
        first = round(part.time_origin / DT)
        place = slice(first, first + part.num_samples)
        assert np.array_equal(part.dof_pos, whole.dof_pos[place]) and part.time[0] == 0.0
        assert np.array_equal(part.command, whole.command[place]) and part.has_position_command.all()
        assert part.part_of == "r" and part.name == f"r {part.time_origin:g} to {part.time_origin + 5:g} s"
        data = make_dataset([part])
        slope = np.gradient(whole.dof_pos, DT, axis=0)[first]
        assert np.allclose(data.start_vel[0], slope, atol=0.1)


def test_what_can_be_afforded_stays_whole():
    whole = joint_by_joint()
    told: list[str] = []
    (kept,), (other,) = affordable([[whole], [whole]], DT, 9, 4, None, told.append)
    assert kept is whole and other is whole and told == []
    assert affordable([[whole]], DT, 9, 4, 80.0, told.append)[0][0] is whole


def test_a_whole_part_between_gaps_is_not_said_to_be_cut():
    whole, told = replace(joint_by_joint(seconds=8.0), part_of="log", notes=("2001 samples.",)), []
    assert affordable([[whole]], 0.0025, 9, 1, None, told.append) == [[whole]] and not told


def test_too_many_derivatives_and_too_little_memory(monkeypatch):
    whole = joint_by_joint()
    told: list[str] = []
    monkeypatch.setattr(parts_module, "_NUMBERS", 9 * 4 * 100 * 20)  # of 20 s
    kept = affordable([[whole], []], DT, 9, 4, None, told.append)
    assert len(kept[0]) == 4 and kept[1] == [] and len(told) == 1
    with pytest.raises(ValueError, match=r"Fitting 79.99 s would take .* GB of memory.*smaller --max_duration"):
        affordable([[whole]], DT, 10**9, 4, 80.0, told.append)


def test_fine_steps_make_a_recording_dear(monkeypatch):
    whole = joint_by_joint()
    monkeypatch.setattr(parts_module, "_EVALUATIONS", 9 * 4 * 100 * 4 * 40)  # of 40 s, at four a step
    for evaluations, parts in ((1, 1), (4, 8), (8, 4)):
        assert len(affordable([[whole], []], DT, 9, evaluations, None, [].append)[0]) == parts


def test_parts_of_a_motion_show_the_truth(tmp_path, capsys):
    path = save_recording(tmp_path / "r.npz", replayed(chirp(11.0), TRUTH, env_cfg()))
    problem = load_problem(BENCH, data=[path], env_cfg=env_cfg(BENCH), max_duration=5.0)
    assert problem.dataset.num_recordings == 1 and "in 1 part of 5 s" in capsys.readouterr().err
    physical = problem.space.from_dict(TRUTH)
    score = problem.evaluator().residuals(physical[None], problem.dataset.sampled).score
    assert float(score.sqrt()) < 1e-3


def test_more_than_all_is_all(tmp_path, capsys):
    path = save_recording(tmp_path / "r.npz", record())
    length = load_recording(path).duration
    problem = load_problem(BENCH, data=[path], env_cfg=env_cfg(BENCH), max_duration=2 * length)
    assert problem.dataset.num_recordings == 1 and capsys.readouterr().err == ""
