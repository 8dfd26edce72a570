"""Fits that leave out windows in which the model is far worse than in the others."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from diagnoses import FITS, joint_alone
from problems import DT

from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import BASE, JointModel
from pace_optim.recording import windows

ALL = torch.tensor([True])


@pytest.fixture
def bench(monkeypatch):
    """A short chirp of one joint, cut into short windows; in the last of them the measured joint swings by itself."""
    monkeypatch.setattr(windows, "_LENGTH", 0.5)
    monkeypatch.setattr(windows, "_BEFORE", 0.25)
    bench = SimpleNamespace(**vars(joint_alone()))
    trained = bench.twins.dataset.train.any(dim=0).nonzero()[0, 0]
    steps = int(bench.twins.dataset.train[:, trained].sum())
    last = slice(steps - round(0.5 / DT), steps)
    measured = bench.twins.dataset.measured.clone()
    measured[last, trained] += 0.06 * torch.sin(torch.arange(steps) / 5.0)[last, None]
    bench.swinging = replace(bench.twins, dataset=replace(bench.twins.dataset, measured=measured))
    bench.place = last, trained
    return bench


def away(bench):
    """The base model with too little armature."""
    physical = bench.truth_values.clone()
    physical[:, BASE.index("armature")] *= 0.8
    return Fitted.start(JointModel.base(bench.problem), physical)


def off(bench, fitted):
    """The worst of the parameters, relative to the truth."""
    return float((fitted.model.to_physical(fitted.x) / bench.truth_values - 1).abs().max())


@pytest.mark.slow
def test_a_window_that_swings_by_itself_does_not_lead_the_fit_astray(bench):
    with_all = FITS.over_wide_steps(bench.swinging, away(bench))
    trimmed = FITS.trimmed(bench.swinging, with_all, ALL)
    assert off(bench, with_all) > 0.05
    assert off(bench, trimmed) < 0.02


def test_windows_that_do_not_count_are_as_if_they_were_not_there(bench):
    kept = torch.ones(round(bench.place[0].stop * DT / 0.5), 1, dtype=torch.bool)
    kept[-1] = False
    without = FITS.over_wide_steps(bench.swinging, away(bench), kept)
    train = bench.swinging.dataset.train.clone()
    train[bench.place] = False
    expected = FITS.over_wide_steps(
        replace(bench.swinging, dataset=replace(bench.swinging.dataset, train=train)), away(bench)
    )
    assert torch.allclose(without.x, expected.x, atol=1e-6)
    assert float(without.score) == pytest.approx(float(expected.score), rel=1e-4)


def rounds(*rmse, joints=(True, True)):
    """Which windows were left out in each round, with these errors by window and joint before each."""
    left, out = iter(rmse), []

    class Recorded(Fits):
        def window_rmse(self, windows, now):
            return torch.tensor(next(left))

        def over_wide_steps(self, problem, now, kept=None):
            out.append([tuple(place) for place in (~kept).nonzero().tolist()])
            return now

    problem = SimpleNamespace(in_windows=lambda: None)
    result = Recorded().trimmed(problem, SimpleNamespace(score=torch.zeros(2)), torch.tensor(joints))
    assert (result is None) == (not out)
    return out


def test_each_joint_leaves_out_windows_of_its_own():
    worse = [[1.0, 1.0], [1.0, 1.0], [3.1, 1.0], [2.9, 9.0], [1.0, 1.0]]
    assert rounds(worse, worse) == [[(2, 0), (3, 1)]]
    assert rounds(worse, worse, joints=(True, False)) == [[(2, 0)]]


def test_nothing_is_fitted_where_the_model_is_about_as_good_everywhere():
    even = [[1.0, 2.0], [2.0, 3.0], [2.9, 5.9]]
    assert rounds(even) == []


def test_it_goes_on_as_long_as_the_other_windows_come_down():
    def worst(scale):
        return [[scale, 1.0], [scale, 1.0], [9.0, 1.0]]

    assert len(rounds(worst(1.0), worst(0.9))) == 1
    assert len(rounds(worst(1.0), worst(0.7), worst(0.65))) == 2
    assert len(rounds(worst(1.0), worst(0.5), worst(0.25))) == 3  # at most
