"""The checks of a log name what is wrong with it before a search, and nothing where nothing is."""

import json
import re
from dataclasses import MISSING, fields, replace
from types import SimpleNamespace

import log_checks as inputs
import numpy as np
import pytest
from places import SHARED
from scipy.optimize import lsq_linear

from pace_envs import load_env_cfg
from pace_envs.task_source import use_task
from pace_optim.identification.log_checks import check_log, checked
from pace_optim.identification.log_checks.balance import View, views_of
from pace_optim.identification.log_checks.checks import (
    Evidence,
    _flat_ends,
    explained,
    frozen_encoder,
    standstill,
    swapped,
)
from pace_optim.identification.setup import load_for_fit
from pace_optim.problem.inverse_dynamics import bounded_least_squares
from pace_optim.problem.problem import load_problem
from pace_optim.recording import Drive, Recording, save_recording
from pace_optim.run.settings import FitSettings

STRANGERS = SHARED / "cases" / "strangers"
FAULTS = ("sign_positions", "swapped", "wrapped", "frozen", "dead", "motor_side", "limit", "gravity", "spikes")


def found_in(kind, seed, folder):
    made = inputs.make(kind, seed)
    return made, check_log(inputs.problem_of(made, folder))


@pytest.mark.parametrize("seed", [0, 3])
def test_a_clean_log_has_no_findings(seed, tmp_path):
    assert found_in("clean", seed, tmp_path)[1] == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_is_named_with_its_joints(kind, tmp_path):
    made, found = found_in(kind, 0, tmp_path)
    assert {each.check for each in found} == {made.check}
    assert set(made.joints) <= {joint for each in found for joint in each.joints}


@pytest.mark.parametrize(("kind", "seed"), [("swapped", 705), ("limit", 701), ("gravity", 705)])
def test_a_fault_that_one_joint_hides_is_named(kind, seed, tmp_path):
    made, found = found_in(kind, seed, tmp_path)
    assert {each.check for each in found} == {made.check}


def test_a_robot_that_stands_is_refused_however_it_is_commanded(tmp_path):
    made = inputs.make("still", 0)
    torque = np.ones_like(made.recording.dof_pos)
    log = replace(made.recording, des_dof_pos=None, des_dof_effort=torque, drive=Drive())
    (found,) = check_log(inputs.problem_of(replace(made, recording=log), tmp_path))
    assert found.stops and found.joints == made.recording.joint_names and "shows no parameter" in found.text


def test_a_frozen_encoder_is_told_with_its_time(tmp_path):
    made, (found,) = found_in("frozen", 1, tmp_path)
    joint = made.recording.joint_names.index(made.joints[0])
    held = np.flatnonzero(np.diff(made.recording.dof_pos[:, joint]) == 0)
    assert f"{held[0] * inputs.CONTROL_DT:.4g} to {(held[-1] + 1) * inputs.CONTROL_DT:.4g} s" in found.text


def test_spikes_of_several_joints_are_all_taken_off(monkeypatch, tmp_path):
    """The positions of all joints but the last stayed as they were."""
    made = inputs.make("clean", 0)
    clean, spiky = made.recording.dof_pos, made.recording.dof_pos.copy()
    spiky[500] += 1.0
    log = replace(made.recording, dof_pos=spiky)
    (view,) = views_of(inputs.problem_of(replace(made, recording=log), tmp_path))
    seen = []
    monkeypatch.setattr(
        Evidence, "of", lambda view, *_: seen.append(view) or Evidence(view=view, links=None, balance={})
    )
    found = explained(view)
    assert [each.joints for each in found] == [(name,) for name in log.joint_names]
    assert np.abs(seen[0].position - clean).max() < 0.05


AXIS = """<mujoco><worldbody><body><joint name="axis" type="slide" axis="0 0 1"/><inertial pos="0 0 0" mass="2"
diaginertia="1 1 1"/></body></worldbody><actuator><motor joint="axis"/></actuator></mujoco>"""


def axis_problem(folder, travel, limit=np.inf, drive=None, unit=1.0):
    """A carriage on a vertical slide that follows a chirp."""
    dt, kp, kd = 0.0025, 800.0, 20.0
    t = dt * np.arange(1600)
    target = 0.5 * travel * np.sin(2 * np.pi * (0.3 * t + 0.4 * t**2))
    position, speed, shown = target[0] - 2 * 9.81 / kp, 0.0, []
    for each in target:
        shown.append(position)
        for _ in range(10):
            torque = np.clip(kp * (each - position) - kd * speed, -limit, limit)
            speed += 0.1 * dt * (torque - 2 * 9.81 - 0.2 * np.tanh(1e3 * speed) - 1.0 * speed) / 2.5
            position += 0.1 * dt * speed
    noise = 1e-6 * np.random.default_rng(0).standard_normal(len(t))
    recording = Recording(
        name="log", joint_names=("axis",), time=t, dof_pos=unit * (np.array(shown) + noise)[:, None],
        des_dof_pos=unit * target[:, None],
        drive=drive or Drive(stiffness=np.array([kp]), damping=np.array([kd])),
    )  # fmt: skip
    (folder / "axis.xml").write_text(AXIS)
    save_recording(folder / "log.npz", recording)
    return load_problem(use_task(str(folder / "axis.xml")), data=[folder / "log.npz"], tell=lambda _: None)


def test_a_slide_of_a_few_centimetres_is_checked_as_a_hinge_is(tmp_path):
    """Its travel was less than what a hinge's was taken for: a dead encoder was not seen."""
    problem = axis_problem(tmp_path, 0.04)
    assert check_log(problem) == []
    (view,) = views_of(problem)
    (dead,) = standstill(replace(view, position=np.zeros_like(view.position)))
    assert "never changes while its command travels 0.04" in dead.text
    held = view.position.copy()
    held[600:800] = held[600]
    (frozen,) = frozen_encoder(replace(view, position=held))
    assert "is frozen from 1.5" in frozen.text


def test_millimetres_are_named(tmp_path):
    """No factor up to a thousand was tried."""
    (found,) = check_log(axis_problem(tmp_path, 0.04, unit=1e3))
    assert "1000 times those of the joint. They are in thousandths: state the unit in the column map." in found.text


def test_limits_of_a_slide_are_told_in_its_units(tmp_path):
    drive = Drive(
        stiffness=np.array([800.0]), damping=np.array([20.0]),
        saturation_effort=np.array([200.0]), velocity_limit=np.array([2.0]),
    )  # fmt: skip
    problem = checked(axis_problem(tmp_path, 0.04, limit=24.0, drive=drive), trust=True)
    (warning,) = (each for each in problem.contradictions if "ends below" in each)
    assert "stated [N]" in warning and "200 at stall, 0 at 2 m/s" in warning and "rad" not in warning


@pytest.mark.slow
def test_a_faulty_log_is_refused_before_the_search_unless_it_is_trusted(tmp_path):
    inputs.problem_of(inputs.make("swapped", 0), tmp_path)
    task = use_task(str(tmp_path / "robot.xml"))
    settings = FitSettings(task=task, data=[str(tmp_path / "log.npz")])
    with pytest.raises(ValueError, match=r"are swapped.*--trust_log"):
        load_for_fit(settings, load_env_cfg(task))
    settings.trust_log = True
    problem = load_for_fit(settings, load_env_cfg(task))
    assert "are swapped" in " ".join(problem.contradictions)


@pytest.mark.slow
def test_what_a_drive_does_otherwise_is_a_warning(tmp_path):
    problem = inputs.problem_of(inputs.make("limit", 0), tmp_path)
    assert "--unknown effort_limit" in " ".join(checked(problem).contradictions)


@pytest.mark.slow
def test_a_limit_that_the_motion_refutes_is_said_before_the_search(tmp_path):
    """Beside missing physics too: another joint carries a spring that the model does not have."""
    made = inputs.make("clean", 0)
    drive, position = made.recording.drive, made.recording.dof_pos
    pull = np.zeros_like(position)
    pull[:, 1] = 0.3 * drive.stiffness[1] * (position[:, 1] - position[:, 1].mean())
    target = made.recording.des_dof_pos + pull / drive.stiffness
    asked = np.abs(drive.stiffness * (target - position)).max(axis=0)
    limit = np.array([0.2 * asked[0], *(10 * asked[1:])])
    recording = replace(made.recording, des_dof_pos=target, drive=replace(drive, effort_limit=limit))
    said: list[str] = []
    problem = checked(inputs.problem_of(replace(made, recording=recording), tmp_path), trust=True, tell=said.append)
    (warning,) = (each for each in said if "State the real effort_limit" in each)
    assert warning.startswith("warning: ") and made.recording.joint_names[0] in warning
    assert warning.removeprefix("warning: ") in problem.contradictions


def test_refuted_limits_of_all_joints_are_one_warning_with_the_facts_to_state(tmp_path):
    """A reader with a URDF whose limits were guesses got seven long warnings in a row."""
    made = inputs.make("clean", 0)
    asked = np.abs(made.recording.drive.stiffness * (made.recording.des_dof_pos - made.recording.dof_pos)).max(axis=0)
    recording = replace(made.recording, drive=replace(made.recording.drive, effort_limit=0.2 * asked))
    problem = checked(inputs.problem_of(replace(made, recording=recording), tmp_path), trust=True)
    (warning,) = (each for each in problem.contradictions if "the stated limit" in each)
    sentence, head, *rows, fact = warning.split("\n")
    assert sentence.endswith("[W3]") and len(rows) > 1
    assert [word for word in head.split() if word.isalpha() and len(word) > 1] == ["joint", "stated", "needed"]
    needed = json.loads(f"{{{fact}}}")["effort_limit"]
    assert [row.split()[0] for row in rows] == [j for j in made.recording.joint_names if j in needed]
    for row in rows:
        joint, stated, shown = row.split()
        assert float(shown) == needed[joint] > float(stated)


def test_every_bound_is_kept_and_little_is_lost_by_it():
    rng = np.random.default_rng(0)
    for _ in range(50):
        table, values = rng.normal(size=(40, 6)), rng.normal(size=40)
        lower, upper = -rng.uniform(0, 0.1, 6), rng.uniform(0, 0.1, 6)
        found, left = bounded_least_squares(table, values, lower, upper)
        assert (found >= lower - 1e-9).all() and (found <= upper + 1e-9).all()
        best = 2 * lsq_linear(table, values, (lower, upper)).cost
        assert best <= left * (1 + 1e-9) and left < 1.02 * best


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "says"),
    [
        ("swapped", "all columns of shoulder, elbow are swapped"),
        ("sign_pos", r"positions \(dof_pos\) of elbow have the opposite sign"),
        ("wrap_tg_only", "targets of shoulder are wrapped"),
        ("frozen_1s", "of elbow is frozen from 2 to 2.997 s"),
        ("dead_encoder", "of elbow never changes"),
        ("motor_side", "gear of 9"),
        ("torque_saturates_unstated", "torque of shoulder, elbow ends below"),
        ("on_side", "gravity points along"),
    ],
)
def test_logs_of_strangers_are_named(folder, says):
    if not STRANGERS.is_dir():
        pytest.skip("shared/cases/strangers is absent")
    here = STRANGERS / folder
    problem = load_problem(use_task(str(here / "arm.xml")), data=[here / "a.csv", here / "b.csv"], tell=lambda _: None)
    assert re.search(says, " ".join(each.sentence for each in check_log(problem)))


@pytest.mark.parametrize(("repeat", "cut", "flat"), [(1, 1.0, 0), (3, 1.0, 0), (1, 0.8, 77), (3, 0.8, 231)])
def test_a_target_is_cut_where_it_stays_for_longer_than_commands_are_held(repeat, cut, flat):
    target = np.repeat(np.clip(np.sin(0.1 * np.arange(200)), -cut, cut), repeat)
    assert _flat_ends(target).sum() == flat


@pytest.mark.parametrize(("crossed", "tried"), [(True, 3), (False, 1)])
def test_columns_are_tried_as_swapped_alone_where_positions_follow_the_other_target(crossed, tried):
    """Of a log with fewer rows than commands: their numbers differed, and the check ended the fit."""
    commands = np.stack([np.sin(0.1 * np.arange(100)), np.cos(0.07 * np.arange(100))], axis=1)
    steps = np.arange(0, 100, 2)
    position = 0.9 * commands[steps][:, [1, 0] if crossed else [0, 1]]
    given = {each.name: None for each in fields(View) if each.init and each.default is MISSING}
    view = View(**given | {
        "joints": ("a", "b"), "steps": steps, "position": position,
        "target": commands, "target_vel": 0 * commands, "feed_forward": 0 * commands,
    })  # fmt: skip
    evidence = SimpleNamespace(view=view, doubted={0}, balance={0: None, 1: None})
    assert len(list(swapped(evidence))) == tried
