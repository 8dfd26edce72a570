"""Contacts and sticking make an error rough: derivatives over wide steps see the slope below."""

from types import SimpleNamespace

import pytest
import torch

from pace_optim.diagnosis import descent
from pace_optim.diagnosis.descent import Fitted, fit_side_by_side
from pace_optim.diagnosis.model import BASE, JointModel

SAMPLES, TRUTH = 400, torch.tensor([0.3, -0.2, 0.5, 0.1, -0.4], dtype=torch.float64)


class Landscape:
    """A linear problem of one joint, rough on the scale of a thousandth of each parameter's range."""

    def __init__(self, roughness):
        rng = torch.Generator().manual_seed(0)
        shape = (SAMPLES, len(BASE))
        self.slope = torch.randn(shape, generator=rng, dtype=torch.float64)
        self.waves = 2000 * torch.randn(shape, generator=rng, dtype=torch.float64)
        self.roughness, self.rounds = roughness, 0

    def __call__(self, problem, slots, training):
        self.model = slots[0].model
        self.dataset = SimpleNamespace(train=torch.ones(SAMPLES, 1, dtype=torch.bool))
        return self

    def simulate(self, physical, where, stride):
        self.rounds += 1
        away = self.model.to_normalised(physical[0])[:, 0] - TRUTH
        error = away @ self.slope.T + self.roughness * torch.sin(away @ self.waves.T)
        return error[:, ::stride, None, None].float()

    def split(self, errors):
        return [errors]


@pytest.fixture
def fitted(monkeypatch):
    def fit(roughness, rough, iterations=25):
        landscape = Landscape(roughness)
        monkeypatch.setattr(descent, "SideBySide", landscape)
        bounds = torch.ones(1, len(BASE)).double()
        model = JointModel(
            effects=(),
            has=torch.zeros(0, 1, dtype=torch.bool),
            lower=-bounds,
            upper=bounds,
            log=torch.zeros(len(BASE), dtype=torch.bool),
        )
        start = Fitted.start(model, 0 * bounds)
        result = fit_side_by_side(None, [start], iterations, rough=rough)[0]
        return float((result.x[0] - TRUTH).abs().max()), landscape.rounds

    return fit


def test_wide_derivatives_lead_where_narrow_ones_do_not(fitted):
    narrow, _ = fitted(0.05, rough=False)
    wide, _ = fitted(0.05, rough=True)
    assert narrow > 0.4 and wide < 0.1


def test_on_smooth_ground_both_end_at_the_same_place_and_stop(fitted):
    for rough in (False, True):
        away, rounds = fitted(0.0, rough=rough)
        assert away < 1e-6 and rounds < 16
