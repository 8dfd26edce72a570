"""Joints that are held: taken out of the model, and found by what a log commands."""

import mujoco
import numpy as np
import pytest

from pace_envs.robot_spec import hold_joints
from pace_envs.task_source import EnvironmentRecord, use_task
from pace_optim.problem.problem import load_problem

CHAIN = """
<mujoco>
  <compiler angle="degree" autolimits="true"/>
  <worldbody>
    <frame pos="1 0 0" euler="0 0 90">
      <body name="a" pos="0 1 0" euler="0 30 0">
        <frame pos="0 0 .1" euler="90 0 0"><joint name="j1" axis="0 0 1" pos="0 .1 0" ref="10"/></frame>
        <joint name="j2" axis="1 0 0" pos=".1 .2 .3" ref="5"/>
        <joint name="s" type="slide" axis="0 1 0"/>
        <geom size=".1" pos=".2 0 0"/>
        <body name="b" pos="0 0 1">
          <joint name="k" axis="0 1 0"/>
          <geom size=".1" pos="0 0 .2"/>
          <site name="tip" pos=".1 .2 .3"/>
          <body name="c" pos="0 0 .3"><joint name="m"/><geom size=".1"/></body>
        </body>
      </body>
    </frame>
  </worldbody>
  <equality><joint joint1="m" joint2="k" polycoef="0.1 0.5 0 0 0"/></equality>
  <actuator><position joint="k"/></actuator>
  <sensor><jointpos joint="k"/></sensor>
</mujoco>
"""
AT = {"j1": 0.4, "j2": -0.7, "s": 0.2, "k": 0.9, "m": 0.1 + 0.5 * 0.9}


def forward(model):
    """Data and mass matrix at the posture."""
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    for j in range(model.njnt):
        data.qpos[model.jnt_qposadr[j]] = AT[model.joint(j).name]
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, mass)
    return data, mass


@pytest.mark.parametrize("held", ["j1", "j2", "s", "k", "j1 s", "j2 s k", "j1 j2 s"])
def test_the_other_joints_feel_the_same(held):
    spec = mujoco.MjSpec.from_string(CHAIN)
    whole = spec.compile()
    hold_joints(spec, whole, {name: AT[name] for name in held.split()})
    part = spec.compile()
    names = [part.joint(j).name for j in range(part.njnt)]
    gone = set(held.split()) | ({"m"} if "k" in held else set())  # m follows k
    assert names == [name for name in AT if name not in gone]
    (one, mass), (other, less) = forward(whole), forward(part)
    ids = [whole.joint(name).dofadr[0] for name in names]
    for field in ("site_xpos", "xipos"):
        np.testing.assert_allclose(getattr(other, field), getattr(one, field), atol=1e-12)
    np.testing.assert_allclose(less, mass[np.ix_(ids, ids)], atol=1e-10)
    np.testing.assert_allclose(other.qfrc_bias, one.qfrc_bias[ids], atol=1e-10)


def test_what_a_tendon_ties_is_held_together():
    tied = CHAIN.replace(
        "<equality>", '<tendon><fixed name="t"><joint joint="j1" coef="1"/><joint joint="k" coef="2"/></fixed></tendon>'
        "<equality>"
    )  # fmt: skip
    spec = mujoco.MjSpec.from_string(tied)
    with pytest.raises(ValueError, match=r"'t' ties k, to be held, to j1"):
        hold_joints(spec, spec.compile(), {"k": 0.0})
    hold_joints(spec, spec.compile(), {"k": 0.0, "j1": 0.0})
    assert spec.compile().ntendon == 0


DUO = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body><joint name="waist" axis="0 0 1" range="-1 1"/><geom size=".1" mass="2"/>
      <body pos="0 .2 0"><joint name="left_elbow" axis="0 1 0" range="-2 2"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass=".5"/></body>
      <body pos="0 -.2 0"><joint name="right_elbow" axis="0 1 0" range="-2 2"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass=".5"/></body>
    </body>
  </worldbody>
  <actuator>
    <position joint="waist" kp="80" kv="3" forcerange="-40 40"/>
    <position joint="left_elbow" kp="40" kv="1.5" forcerange="-20 20"/>
    <position joint="right_elbow" kp="40" kv="1.5" forcerange="-20 20"/>
  </actuator>
  <keyframe><key name="home" qpos="0.3 0.2 0.4"/></keyframe>
</mujoco>
"""
TIME = np.arange(0, 2, 0.0025)
MOTION = 0.3 * np.sin(4 * TIME)
WAIST, LEFT, RIGHT = "waist", "left_elbow", "right_elbow"


@pytest.fixture
def duo(tmp_path):
    """The problem of a log of some joints: their positions, and the targets of those that have any."""
    (tmp_path / "duo.xml").write_text(DUO)
    task = use_task(str(tmp_path / "duo.xml"))

    def problem_of(positions, targets=(LEFT,), joints=None, told=None):
        nothing = np.full_like(TIME, np.nan)
        np.savez(
            tmp_path / "log.npz",
            time=TIME,
            dof_pos=np.stack([np.broadcast_to(each, TIME.shape) for each in positions.values()], axis=1),
            des_dof_pos=np.stack([MOTION if name in targets else nothing for name in positions], axis=1),
            joint_names=np.array(list(positions)),
        )
        tell = (told if told is not None else []).append
        return load_problem(task, data=[tmp_path / "log.npz"], joints=joints, tell=tell)

    return problem_of


def held(problem):
    return problem.env_cfg.scene.robot.held_joints


def test_joints_that_the_log_has_not_are_held_at_the_keyframe(duo):
    told = []
    problem = duo({LEFT: MOTION}, told=told)
    assert problem.joint_names == (LEFT,) and held(problem) == {WAIST: 0.3, RIGHT: 0.4}
    (note,) = [line for line in told if "held" in line]
    assert "2 joints are held" in note and "waist at 0.3 rad" in note
    assert any("2 joints are held" in note for note in problem.env_cfg.sim2real.notes)


def test_joints_that_nothing_commands_are_held_where_the_log_has_them(duo):
    problem = duo({RIGHT: 0.7, LEFT: MOTION, WAIST: -0.2})
    assert problem.joint_names == (LEFT,) and held(problem) == pytest.approx({WAIST: -0.2, RIGHT: 0.7})
    (recording,) = problem.dataset.recordings
    assert recording.joint_names == (LEFT,) and recording.dof_pos.shape == (len(TIME), 1)


def test_joints_that_move_without_a_command_are_held_only_if_one_asks_for_it(duo):
    with pytest.raises(ValueError, match=r"joints move without a command: right_elbow by 0\.\d+ rad.*--joints"):
        duo({LEFT: MOTION, RIGHT: MOTION})
    problem = duo({LEFT: MOTION, RIGHT: MOTION}, joints="left.*")
    assert problem.joint_names == (LEFT,)
    assert any("some move (right_elbow" in note for note in problem.env_cfg.sim2real.notes)


def test_a_slide_that_moves_15_mm_without_a_command_is_not_held_silently(duo, tmp_path):
    finger = DUO.replace(
        'name="right_elbow" axis="0 1 0" range="-2 2"', 'name="right_elbow" type="slide" range="0 .04"'
    )
    (tmp_path / "duo.xml").write_text(finger)
    with pytest.raises(ValueError, match=r"log\.npz: joints move without a command: right_elbow by 0\.015 m"):
        duo({LEFT: MOTION, RIGHT: 0.0075 + 0.025 * MOTION})


def test_a_joint_that_rests_in_two_places_is_named_with_both_recordings(duo, tmp_path):
    duo({LEFT: MOTION, RIGHT: 0.0})
    (tmp_path / "log.npz").rename(tmp_path / "a.npz")
    problem = duo({LEFT: MOTION, RIGHT: 0.5})
    files = [tmp_path / "a.npz", tmp_path / "log.npz"]
    with pytest.raises(ValueError, match=r"right_elbow rests at 0 rad in .*a\.npz, at 0\.5 rad in .*log\.npz: .*apart"):
        load_problem(problem.task, data=files, tell=lambda _: None)
    asked = load_problem(problem.task, data=files, joints="left.*", tell=lambda _: None)
    assert held(asked)[RIGHT] == 0.5
    assert any("right_elbow rests at 0 rad" in note for note in asked.env_cfg.sim2real.notes)


def test_of_joints_that_all_move_those_asked_for_are_identified(duo):
    both = {LEFT: MOTION, RIGHT: MOTION + 0.5, WAIST: MOTION}
    problem = duo(both, targets=tuple(both), joints="(left|right)_elbow")
    assert problem.joint_names == (LEFT, RIGHT) and list(held(problem)) == [WAIST]


def test_a_joint_of_another_name_is_not_a_joint_that_the_log_has_not(duo):
    with pytest.raises(ValueError, match=r"unknown joint 'rigth_elbow', did you mean 'right_elbow'\?.*--joints"):
        duo({LEFT: MOTION, WAIST: 0.0, "rigth_elbow": MOTION}, targets=(LEFT, WAIST, "rigth_elbow"))


def test_a_run_knows_where_its_joints_were_held(duo, tmp_path):
    problem = duo({LEFT: MOTION, RIGHT: 0.7})
    record = EnvironmentRecord.of(problem.task, problem.env_cfg)
    again = EnvironmentRecord.read(record.to_dict(), problem.task).load_cfg("settings.json")
    assert again.sim2real.joint_order == (LEFT,)
    assert again.scene.robot.held_joints == held(problem)
    opened = load_problem(problem.task, data=[tmp_path / "log.npz"], env_cfg=again, tell=lambda _: None)
    assert opened.joint_names == (LEFT,) and held(opened) == held(problem)
    assert any("Held as before: " in note and "right_elbow at 0.7" in note for note in opened.env_cfg.sim2real.notes)
    assert again.sim2real.excitation.scale and set(again.sim2real.sample_params["armature"]) == {LEFT}


def test_a_record_whose_joints_are_held_at_no_number_is_damaged(duo):
    problem = duo({LEFT: MOTION})
    content = EnvironmentRecord.of(problem.task, problem.env_cfg).to_dict() | {"held_joints": {WAIST: "here"}}
    with pytest.raises(ValueError, match=f"environment: held_joints/{WAIST} is 'here', expected a finite number"):
        EnvironmentRecord.read(content, problem.task)


def test_names_without_a_side_are_those_asked_for(duo, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where the map to correct is written
    duo({LEFT: MOTION})  # writes the model
    rows = "\n".join(f"{t:.4f},{q:.6f},{q:.6f}" for t, q in zip(TIME, MOTION, strict=True))
    (tmp_path / "log.csv").write_text(f"time,elbow_position,elbow_target\n{rows}\n")
    task = use_task(str(tmp_path / "duo.xml"))
    with pytest.raises(ValueError, match="missing positions"):
        load_problem(task, data=[tmp_path / "log.csv"], tell=lambda _: None)
    problem = load_problem(task, data=[tmp_path / "log.csv"], joints="left.*", tell=lambda _: None)
    assert problem.joint_names == (LEFT,)
