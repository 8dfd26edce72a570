"""Joints that are later than the robot's one delay: it is said, and what makes them late is sought."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from diagnoses import FITS
from problems import ANYMAL, DT, env_cfg, legs_chirp, make_problem, physical, replayed

from pace_actuators.effects import get_effect
from pace_envs import set_physics_dt
from pace_optim.diagnosis.candidates.screening import absorbed_effects
from pace_optim.diagnosis.checks.shared_delay import hold_late_joints
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT
from pace_optim.joints.fits.base_fit import fit_base, later_than_most
from pace_optim.joints.fits.model import BASE

LATE_LOG = get_effect("measurement_delay")
TRUTH = {"armature": 0.1, "viscous_friction": 4.5, "friction": 0.1, "encoder_bias": 0.02, "delay": 2.0}
LATE, STEPS = ["LF_HFE", "LF_KFE"], 2


def logged_late(recording):
    """The same with some joints' positions written down two control steps late."""
    position = recording.dof_pos.copy()
    for column in [recording.joint_names.index(name) for name in LATE]:
        position[STEPS:, column] = position[:-STEPS, column]
        position[:STEPS, column] = position[STEPS, column]
    return replace(recording, dof_pos=position)


@pytest.fixture(scope="module")
def legs():
    """A motion of a robot's legs, as it was."""
    cfg = env_cfg(ANYMAL)
    set_physics_dt(cfg, DT / 5)
    target = legs_chirp(cfg, 2.5)
    target = np.concatenate([np.repeat(target[:1], 20, axis=0), target])
    return [replayed(factor * target, TRUTH, cfg, noise=1e-4, seed=i) for i, factor in enumerate((1.0, 0.7))]


def fitted(legs, change=lambda recording: recording):
    train, validation = legs
    problem = make_problem(change(train), cfg=env_cfg(ANYMAL), validation=[change(validation)])
    problem = problem.with_physics_dt(DT / 2)
    return problem, *fit_base(FITS, problem, physical(problem, TRUTH))


@pytest.fixture(scope="module")
def punctual(legs):
    """Joints with one delay, and their base model."""
    _, twins, base, _ = fitted(legs)
    return twins, base


@pytest.mark.parametrize(
    ("delay", "late"),
    [
        ([2.0, 2.01, 1.99, 3.0], [3]),
        ([2.0, 2.1, 1.95, 2.05, 1.9, 2.6, 3.0], [6]),
        ([2.0, 2.01, 1.99, 2.1], []),  # no more than what many effects do to a delay
        ([2.0, 2.01, 1.99, 1.0], []),  # earlier: the robot's delay may be what is late
        ([2.0, 2.4, 1.7, 1.5, 3.0], []),  # no one delay to be later than
        ([2.0, 3.0], []),
        ([2.0], []),
    ],
)
def test_a_joint_is_late_beside_a_delay_that_most_joints_have(delay, late):
    assert later_than_most(torch.tensor(delay)).nonzero()[:, 0].tolist() == late


@pytest.mark.slow
def test_late_joints_get_the_delay_of_the_others_and_something_to_explain(legs):
    problem, twins, base, effort = fitted(legs, logged_late)
    held, (sentence,) = hold_late_joints(FITS, twins, base)
    late = torch.tensor([name in LATE for name in problem.joint_names])
    delay = held.model.to_physical(held.x)[:, BASE.index("delay")]
    assert delay.tolist() == pytest.approx([TRUTH["delay"]] * len(late), abs=0.1)
    assert torch.equal(held.model.free[:, BASE.index("delay")], ~late)
    said = re.fullmatch(r".* of (.*) ms that most have: LF_HFE by (.*) ms, LF_KFE by (.*) ms\. .*", sentence)
    assert [float(ms) for ms in said.groups()] == pytest.approx([5.0, 5.0, 5.0], abs=0.5)
    assert bool((held.score[late] > 20 * base.score[late]).all())
    assert torch.allclose(held.score[~late], base.score[~late], rtol=1e-3)
    absorbed = absorbed_effects(FITS, twins, held, [LATE_LOG], effort, DEFAULT.candidates)
    assert torch.equal(absorbed[LATE_LOG], ~late)


@pytest.mark.slow
def test_where_no_joint_is_late_the_base_model_stays_as_it_is(punctual):
    twins, base = punctual
    assert hold_late_joints(FITS, twins, base) == (base, [])


def test_a_joint_is_not_held_where_its_delay_does_not_matter(punctual, monkeypatch):
    """That of a joint that hardly moves may be anything."""
    twins, base = punctual
    monkeypatch.setattr(
        "pace_optim.diagnosis.checks.shared_delay.later_than_most", lambda delay, cfg: torch.arange(len(delay)) == 4
    )
    assert hold_late_joints(FITS, twins, base) == (base, [])
