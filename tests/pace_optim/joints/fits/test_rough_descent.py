"""Contacts and sticking make an error rough: derivatives over wide steps see the slope below."""

from types import SimpleNamespace

import pytest
import torch

from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.fitting_cfg import FittingCfg
from pace_optim.joints.fits.model import BASE, JointModel

SAMPLES, TRUTH = 400, torch.tensor([0.3, -0.2, 0.5, 0.1, -0.4], dtype=torch.float64)


class Landscape:
    """A problem of one joint, rough on the scale of a thousandth of each parameter's range, or bent."""

    def __init__(self, roughness, bend):
        rng = torch.Generator().manual_seed(0)
        shape = (SAMPLES, len(BASE))
        self.slope = torch.randn(shape, generator=rng, dtype=torch.float64)
        self.waves = 2000 * torch.randn(shape, generator=rng, dtype=torch.float64)
        self.curve = torch.randn(shape, generator=rng, dtype=torch.float64)
        self.left = torch.randn(SAMPLES, generator=rng, dtype=torch.float64)  # what no parameters explain
        self.roughness, self.bend, self.rounds = roughness, bend, 0

    def __call__(self, problem, slots, training):
        self.model = slots[0].model
        self.dataset = SimpleNamespace(train=torch.ones(SAMPLES, 1, dtype=torch.bool))
        return self

    def simulate(self, physical, where, stride):
        self.rounds += 1
        away = self.model.to_normalised(physical[0])[:, 0] - TRUTH
        self.step = float((away[1] - away[0]).abs().max())  # of the derivatives
        error = away @ self.slope.T + self.roughness * torch.sin(away @ self.waves.T)
        error = error + self.bend * ((away @ self.curve.T) ** 2 + self.left)
        return error[:, ::stride, None, None].float()

    def split(self, errors):
        return [errors]


@pytest.fixture
def fitted():
    def fit(roughness, rough, bend=0.0):
        landscape = Landscape(roughness, bend)
        bounds = torch.ones(1, len(BASE)).double()
        model = JointModel(
            effects=(),
            has=torch.zeros(0, 1, dtype=torch.bool),
            lower=-bounds,
            upper=bounds,
            log=torch.zeros(len(BASE), dtype=torch.bool),
            slides=torch.zeros(1, dtype=torch.bool),
            ranges=torch.zeros(1, 2),
            efforts=torch.full((1,), torch.inf),
            loops=torch.full((1,), 85.0),
        )
        start = Fitted.start(model, 0 * bounds)
        result = Fits(batch=landscape).side_by_side(None, [start], 25, rough=rough)[0]
        return result.x[0] - TRUTH, landscape

    return fit


def test_wide_derivatives_lead_where_narrow_ones_do_not(fitted):
    narrow, _ = fitted(0.05, rough=False)
    wide, _ = fitted(0.05, rough=True)
    assert float(narrow.abs().max()) > 0.4 and float(wide.abs().max()) < 0.1


def test_on_smooth_ground_both_end_at_the_same_place_and_stop(fitted):
    for rough in (False, True):
        away, landscape = fitted(0.0, rough=rough)
        assert float(away.abs().max()) < 1e-6 and landscape.rounds < 16


def test_steps_end_narrow_where_the_ground_is_bent(fitted):
    narrow, _ = fitted(0.0, rough=False, bend=0.5)
    wide, landscape = fitted(0.0, rough=True, bend=0.5)
    assert landscape.step == pytest.approx(FittingCfg().narrow)
    assert float((narrow - wide).abs().max()) < 1e-3  # both end where less than a 3000th of the score is to be gained
