"""An effect that has another size in each recording stands in for something that is not known."""

import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from diagnoses import hidden_run
from problems import CALM, DT

from pace_actuators.effects import get_effect
from pace_actuators.joint_units import all_hinges
from pace_optim.diagnosis import Diagnosis, DiagnosisSettings, diagnose, search_effects
from pace_optim.diagnosis.beginning.data_check import DataCheck
from pace_optim.diagnosis.judging.size_consistency import unevenness
from pace_optim.diagnosis.search.state import Outcome
from pace_optim.diagnosis.telling import findings
from pace_optim.diagnosis.telling.findings import Findings, summary_of
from pace_optim.diagnosis.verdict.proxy_effects import proxies, varying
from pace_optim.diagnosis.verdict.verdict import verdict
from pace_optim.report import write_report
from pace_optim.single_joint_fits.block_errors import BlockErrors
from pace_optim.single_joint_fits.fitted import Fitted
from pace_optim.single_joint_fits.model import BASE, JointModel

SPRING, QUADRATIC = get_effect("parallel_spring"), get_effect("quadratic_friction")
FLOOR, YES = torch.tensor([1e-4]), torch.tensor([True])
SAID = "parallel_spring (servo) needs a different value in each recording, so it is probably a proxy."


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return hidden_run(tmp_path_factory.mktemp("run"), None, duration=3.0)


def fitted_to(problem, *sizes, noise=0.3):
    """A model with a spring, fitted to recordings that would each have the spring in another size, and a friction."""
    model, values = JointModel.base(problem), torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64)
    for effect, own in ((SPRING, [2.0, 0.1]), (QUADRATIC, [0.1])):
        model, values = model.extended(values, effect, YES, torch.tensor([own], dtype=torch.float64))
    now, generator = Fitted.start(model, values), torch.Generator().manual_seed(0)
    jacobian = torch.randn(model.size, 500, len(sizes), 1, generator=generator)
    error = jacobian[model.columns(SPRING).start] * (torch.tensor(sizes) - sum(sizes) / len(sizes))[:, None]
    error += noise * torch.randn(500, len(sizes), 1, generator=generator)
    return replace(now, jacobian=jacobian, error=error)


def ended(problem, rmse, friction=False, noise=0.67):
    """A search that came from 10 mrad to an RMSE [rad] with a spring that differs between recordings."""
    now = fitted_to(problem, 1.0, 1.1, 0.9, 2.0, noise=noise)
    final = now if friction else replace(now, model=now.model.without_effect(QUADRATIC, YES))
    before, after = (
        BlockErrors(square=torch.tensor([[each**2]]).double(), weight=torch.ones(1).double()) for each in (1e-2, rmse)
    )
    return Outcome(
        problem=None,
        base=now,
        base_errors=before,
        final=final,
        final_errors=after,
        unevenness=unevenness(final),
    )


def test_an_effect_whose_size_differs_between_recordings_is_seen(run):
    sizes = torch.tensor([1.0, 1.1, 0.9, 2.0])
    spring, friction = unevenness(fitted_to(run.problem, *sizes))[:, 0].tolist()
    varied = sizes.var(correction=0)
    assert spring == pytest.approx(float(varied / (varied + 0.3**2)), abs=0.05) and abs(friction) < 0.05
    assert float(unevenness(fitted_to(run.problem, 1.0, 1.0, 1.0, 1.0)).max()) < 0.05
    assert not unevenness(fitted_to(run.problem, 1.0, 2.0)).any()  # which of two is right?
    with pytest.raises(ValueError, match="keep_jacobian"):
        unevenness(replace(fitted_to(run.problem, 1.0), jacobian=None))


def test_parameters_at_a_bound_do_not_count(run):
    """Least squares has not brought the error to a right angle with them."""
    even = fitted_to(run.problem, 1.0, 1.0, 1.0, 1.0)
    armature = BASE.index("armature")
    even.x[0, armature] = -1.0
    even.error.add_(0.5 * even.jacobian[armature])
    assert float(unevenness(even).max()) < 0.05
    even.x[0, even.model.columns(SPRING).start] = 1.0
    even = replace(even, error=fitted_to(run.problem, 1.0, 1.1, 0.9, 2.0).error)
    assert float(unevenness(even).max()) < 0.05  # that it is at its bound says enough


def test_it_is_not_what_is_missing_unless_it_explains_nearly_all(run):
    far = ended(run.problem, 5e-3)
    assert verdict(far, FLOOR)[0] == "unknown" and proxies(far, ["servo"], FLOOR) == [SAID]
    assert verdict(ended(run.problem, 2e-3), FLOOR)[0] == "effect"
    assert verdict(ended(run.problem, 5e-3, friction=True), FLOOR)[0] == "effect"  # beside another that does not differ


def test_an_effect_that_leaves_little_once_its_size_may_differ_is_there_and_depends_on_something(run):
    right = ended(run.problem, 5e-3, noise=0.3)
    assert verdict(right, FLOOR)[0] == "effect" and proxies(right, ["servo"], FLOOR) == []
    told = "Its size differs between recordings, so it depends on something more: parallel_spring (servo)."
    assert varying(right, ["servo"], FLOOR) == [told] and varying(ended(run.problem, 5e-3), ["servo"], FLOOR) == []
    found = Findings(
        outcome=right,
        data=DataCheck(floor=FLOOR, noise=FLOOR, numerical=FLOOR),
        absorbed={},
        verdict="effect",
        explained=0.75,
        paying=["parallel_spring"],
        shares={SPRING: 1.0},
    )
    assert summary_of(found, run.problem).endswith(told)


def four_joints(problem):
    """A search on joints near the floor, one of which got a spring that brings it there."""
    one = JointModel.base(problem)
    four = {side: getattr(one, side).expand(4, -1) for side in ("lower", "upper", "ranges")}
    four["slides"] = one.slides.expand(4)
    model = replace(one, has=torch.zeros(0, 4, dtype=torch.bool), **four)
    values = torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64).expand(4, -1)
    base = Fitted.start(model, values)
    spring = torch.tensor([[2.0, 0.1]], dtype=torch.float64).expand(4, -1)
    final = Fitted.start(*model.extended(values, SPRING, torch.arange(4) == 0, spring))
    before, after = (
        BlockErrors(square=1e-8 * torch.tensor([rmse]).double() ** 2, weight=torch.ones(1).double())
        for rmse in ([1.9, 2.9, 2.9, 2.9], [1.2, 2.9, 2.9, 2.9])
    )
    even = torch.zeros(1, 4)
    return Outcome(problem=None, base=base, base_errors=before, final=final, final_errors=after, unevenness=even)


def test_where_nothing_is_missing_no_effect_is_kept(run, monkeypatch):
    outcome, floor = four_joints(run.problem), FLOOR.expand(4)
    module = sys.modules[search_effects.__module__]
    twins = SimpleNamespace(with_physics_dt=lambda _: None, coarsest_dt=0.0025, control_dt=0.0025)
    for name, made in (
        ("fit_base", (twins, outcome.base, FLOOR)),
        ("check_data", DataCheck(floor=floor, noise=floor, numerical=floor)),
        ("absorbed_effects", {}),
        ("add_effects", outcome),
        ("pool", outcome),
    ):
        monkeypatch.setattr(module, name, lambda *_, made=made, **__: made)
    joints = SimpleNamespace(
        joint_names=("a", "b", "c", "d"),
        joint_types=all_hinges(4),
        trees=(),
        dataset=run.problem.dataset,
        control_dt=DT,
    )
    found = search_effects(joints, None, [SPRING], 3)
    assert (found.verdict, found.paying, found.added) == ("nothing_missing", [], [])
    assert found.outcome.final_errors.mse.tolist() == pytest.approx(outcome.base_errors.mse.tolist())


@pytest.mark.parametrize("stopped", ["converged", "interrupted"])
def test_it_is_fitted_to_the_whole_robot_all_the_same(run, monkeypatch, stopped):
    found = Findings(
        outcome=ended(run.problem, 5e-3),
        data=DataCheck(floor=FLOOR, noise=FLOOR, numerical=FLOOR),
        absorbed={},
        verdict="unknown",
        explained=0.75,
        paying=["parallel_spring"],
        shares={SPRING: 1.0},
    )
    refits, said, seen, told = [], [], [], []

    refit = run.folder.parent / "refit"

    def fit(settings, progress, on_start, assess_interrupted, before):
        refits.append(settings)
        told.append(len(seen))
        on_start(refit)
        if stopped == "interrupted":
            raise KeyboardInterrupt
        shutil.copytree(run.folder, refit, dirs_exist_ok=True)
        return SimpleNamespace(stop_reasons=[stopped]), refit

    (run.folder.parent / "refit").mkdir(exist_ok=True)
    module = sys.modules[diagnose.__module__]
    for name, made in (("advise", []), ("error_map", {}), ("sizes", [])):
        monkeypatch.setattr(findings, name, lambda *_, made=made, **__: made)
    monkeypatch.setattr(module, "search_effects", lambda *_, **__: found)
    monkeypatch.setattr(module, "fit", fit)
    line = SimpleNamespace(say=said.append, restart=lambda: None, close=lambda: None)
    assert diagnose(DiagnosisSettings(run=run.folder), line).runs == [str(run.folder)] and not refits
    diagnosis = diagnose(DiagnosisSettings(run=run.folder, refit=True), line, seen.append)
    assert told == [1] and seen[0].runs == [str(run.folder)]  # the verdict is told before the robot is fitted
    broken_off = stopped == "interrupted"
    assert any(f"scripts/fit.py --resume {refit}" in text for text in said) is broken_off
    assert refits[0].effects == ["parallel_spring"]
    assert diagnosis.runs == [str(run.folder), str(refit)][: 1 if broken_off else 2]
    assert Diagnosis.load(refit).verdict == "unknown"
    assert diagnosis.verdict == "unknown" and diagnosis.added == [] and diagnosis.paying == ["parallel_spring"]
    assert SAID in diagnosis.summary and "75 %" in diagnosis.summary
    assert Diagnosis.load(run.folder) == diagnosis
    page = write_report(run.folder).read_text("utf-8")
    assert "this lowers the error: <code>scripts/fit.py … --effects parallel_spring</code>" in page
    assert "Something is missing, and known effects explain 75 % of it" in page
