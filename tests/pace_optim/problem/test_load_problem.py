"""A problem is loaded in steps: facts of the robot, its logs, then the problem that they pose."""

import pytest
from problems import ANYMAL, BENCH

from pace_optim.problem import problem as module
from pace_optim.problem.problem import Facts, load_problem
from pace_optim.problem.recordings import Logs
from pace_optim.run.resolved import as_data


def test_logs_give_other_facts_and_leave_these_as_they_are():
    facts = Facts.read(ANYMAL, delay_mode="effort", drive_dt=0.00125)
    before = as_data(facts.cfg)
    names = facts.cfg.sim2real.joint_order
    narrowed = facts.with_logs(Logs(groups=((), ()), joints=names[1:], held={names[0]: 0.1}, note="One joint is held."))
    assert as_data(facts.cfg) == before
    assert narrowed.cfg.sim2real.joint_order == names[1:]
    assert narrowed.cfg.scene.robot.held_joints == {names[0]: 0.1}
    assert narrowed.cfg.sim2real.notes[-1] == "One joint is held."
    (drive,) = narrowed.cfg.scene.robot.actuators.values()
    assert (drive.delay_mode, drive.drive_dt) == ("effort", 0.00125)
    assert facts.with_logs(Logs(groups=((), ()), joints=names)) is facts


@pytest.mark.parametrize("options", [{}, {"unknown": ["effort_limit"]}, {"effects": ["stribeck_friction"]}], ids=str)
def test_one_environment_serves_all_checks(monkeypatch, options):
    built = []

    class Counted(module.ManagerBasedRLEnv):
        def __init__(self, *args, **kwargs):
            built.append(self)
            super().__init__(*args, **kwargs)

    monkeypatch.setattr(module, "ManagerBasedRLEnv", Counted)
    problem = load_problem(BENCH, max_duration=1.0, tell=lambda _: None, **options)
    assert len(built) == 1
    assert problem.effects == [*options.get("effects", ()), *(["torque_limit"] if "unknown" in options else [])]
