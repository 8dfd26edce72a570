"""Gains that nobody has stated: assumed and said, not zero without a word."""

import mujoco
import numpy as np
import pytest
from models import HEAD, KD, KP, MOTORS

from pace_optim.problem.problem import load_problem
from pace_optim.recording import Drive, Recording, save_recording

SPEEDS = '<velocity joint="pan" kv="0.1" ctrlrange="-3 3"/><velocity joint="tilt" kv="0.1" ctrlrange="-3 3"/>'
DT = 0.0025


@pytest.fixture
def robot(tmp_path):
    (tmp_path / "head.xml").write_text(HEAD.format(MOTORS))
    return tmp_path / "head.xml"


def recorded(robot, seconds=1.0, **facts):
    """Plain MuJoCo's motion of motors whose loop runs at the control rate."""
    model = mujoco.MjModel.from_xml_path(str(robot))
    model.opt.timestep, data = DT / 10, mujoco.MjData(model)
    time = np.arange(round(seconds / DT)) * DT
    target = np.stack([0.5 * np.sin(6 * time), 0.3 * np.sin(9 * time)], axis=1)
    read, torque = np.zeros_like(target), np.zeros_like(target)
    for k, wanted in enumerate(target):
        read[k], torque[k] = data.qpos, np.clip(KP * (wanted - data.qpos) - KD * data.qvel, -1.5, 1.5)
        data.ctrl[:] = torque[k]
        mujoco.mj_step(model, data, 10)
    series = {"des_dof_pos": target, "des_dof_effort": torque}
    chosen = {key: series[key] for key in facts.pop("commands", ("des_dof_pos",))}
    recording = Recording(
        name="r", joint_names=("pan", "tilt"), time=time, dof_pos=read, drive=Drive(**facts), **chosen
    )
    return save_recording(robot.parent / "r.npz", recording)


def error_of(problem):
    """Of the bare model with these gains [rad]."""
    low = {"armature": 1e-6, "viscous_friction": 0.0, "friction": 0.0, "encoder_bias": 0.0, "delay": 0.0}
    gains = {f"{name}.gain": 1.0 for name in ("proportional_gain", "derivative_gain") if name in problem.effects}
    physical = problem.space.from_dict({**low, **gains})
    return float(problem.evaluator().residuals(physical[None], problem.dataset.sampled).score.sqrt())


def test_positions_that_follow_motors_are_told_to_lack_gains(robot):
    problem = load_problem(str(robot), data=[recorded(robot)])
    (said,) = problem.contradictions
    assert said.startswith("The gains of pan, tilt are not stated: kp = 1.5") and "--unknown stiffness" in said
    assert error_of(problem) < 0.3  # a loop moves it, if not the right one


def test_stated_gains_are_those_that_act(robot):
    problem = load_problem(str(robot), data=[recorded(robot, stiffness=KP, damping=KD)])
    assert problem.contradictions == () and error_of(problem) < 2e-3


def test_notes_are_of_what_is_stated(robot):
    """They said what would hold without the facts beside the log and without --drive_dt."""
    plain, told = recorded(robot), recorded(robot, stiffness=KP, damping=KD, effort_limit=np.array([3.0, 3.0]))
    notes = load_problem(str(robot), data=[told], drive_dt=0.001).env_cfg.sim2real.notes
    assert "gains: as the recordings state" in notes and "effort limit: as the recordings state" in notes
    assert "drive loops: they run every 1 ms, by --drive_dt" in notes
    assert not any("the file has none" in note or "without it" in note or "the file's" in note for note in notes)
    recorded(robot)  # the same file without gains
    notes = load_problem(str(robot), data=[plain]).env_cfg.sim2real.notes
    for said in ("the file has none", "without it", "1.5 N m, the file's"):
        assert any(said in note for note in notes)


def test_gains_that_are_sought_are_no_warning(robot):
    problem = load_problem(str(robot), data=[recorded(robot)], unknown=("stiffness", "damping"))
    assert problem.contradictions == () and "proportional_gain" in problem.effects
    ratio = KP / np.array([1.5, 1.5])
    assert ((ratio > 0.1) & (ratio < 10)).all()  # within reach of what is assumed


@pytest.mark.slow
@pytest.mark.parametrize("commands", [("des_dof_effort",), ("des_dof_pos", "des_dof_effort")])
def test_a_torque_that_is_commanded_is_all_that_moves_a_motor(robot, commands):
    problem = load_problem(str(robot), data=[recorded(robot, commands=commands)])
    assert problem.contradictions == ()
    assert error_of(problem) < 5e-3  # nothing holds it: steps of 2.5 ms drift so far from steps of 0.25 ms in a second
    assert any("taken as all that the drive gives" in note for note in problem.dataset.recordings[0].notes)


def test_positions_cannot_move_a_drive_that_has_no_position_loop(robot):
    path = recorded(robot)
    robot.write_text(HEAD.format(SPEEDS))
    with pytest.raises(ValueError, match=r"nothing moves pan, tilt: .*stiffness is 0.*state them beside the log"):
        load_problem(str(robot), data=[path])


def test_a_loop_that_is_unstable_with_a_tiny_armature_alone_blames_no_gain(robot):
    """An xArm's first axis: all facts were right, and the note asked for a faster loop or other gains."""
    problem = load_problem(str(robot), data=[recorded(robot, stiffness=KP, damping=30 * KD)])
    (note,) = (note for note in problem.dataset.recordings[0].notes if "unstable" in note)
    assert "A fit seeks larger armatures. If it ends at the least one, the real loop is faster" in note
    armature = problem.env_cfg.sim2real.bounds["armature"]
    assert (armature[:, 0] > 0.01 * armature[:, 1]).any()  # it does
