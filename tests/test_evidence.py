"""Which effect is there where small amounts of others are too."""

import math

import pytest
import torch
from diagnoses import make_trial

from pace_actuators.effects import get_effect
from pace_optim.diagnosis.candidates.evidence import _evidence
from pace_optim.diagnosis.judging.choice import choose, contenders

K, OWN, OTHERS = 200, 2, 6
OFFSET, SPRING, GAIN = (get_effect(name) for name in ("torque_offset", "parallel_spring", "torque_gain"))


def columns(seed):
    """Free columns, others of unit RMS, and white noise."""
    rng = torch.Generator().manual_seed(seed)
    own, others, noise = (
        torch.randn(*shape, K, generator=rng, dtype=torch.float64) for shape in ((OWN,), (OTHERS,), ())
    )
    return own, others / others.square().mean(dim=1, keepdim=True).sqrt(), noise


def test_the_log_evidence_is_the_gaussian_likelihood_of_what_is_left():
    """Up to a constant, largest over the size of the others; free columns are projected out."""
    own, others, noise = columns(0)
    basis = torch.linalg.qr(own.T).Q
    project = torch.eye(K, dtype=torch.float64) - basis @ basis.T
    results, expected = [], []
    for size in (0.0, 0.5):
        error = 2e-3 * (noise + size * others.sum(dim=0)) + 1e-3 * own.sum(dim=0)
        e, s = project @ error, project @ others.T
        likelihoods = []
        for ratio in torch.logspace(-6, 4, 81, dtype=torch.float64):  # s² / (N ρ²)
            shape = torch.eye(K, dtype=torch.float64) + s @ s.T / (K * ratio)
            variance = e @ torch.linalg.solve(shape, e) / K
            likelihoods.append(-0.5 * (K * math.log(variance) + torch.linalg.slogdet(shape).logabsdet))
        expected.append(float(max(likelihoods)))
        results.append(_evidence(own, others, error, torch.ones(OTHERS, dtype=torch.float64), K))
    assert results == pytest.approx(expected, abs=1e-3)


def test_what_others_in_small_amounts_can_leave_speaks_less_against_an_effect_than_what_they_cannot():
    own, others, noise = columns(1)
    main, common, strange, *apart = others
    small = [common + 0.3 * each for each in apart]  # effects that are much alike: together they come to a lot
    rival = 0.7 * main + 0.5 * common + 0.51 * strange
    error = 5 * main + sum(1.3 * each for each in small) + 0.02 * noise

    def left(free):
        basis = torch.linalg.qr(torch.stack([*own, free]).T).Q
        return float((error - basis @ (basis.T @ error)).norm())

    def evidence(free, other):
        every = torch.stack([other, *small])
        return _evidence(torch.stack([*own, free]), every, error, torch.ones(len(every), dtype=torch.float64), K)

    assert left(rival) < left(main)  # by the error alone the rival would be named
    assert evidence(main, rival) > evidence(rival, main) + 3


def test_effects_near_to_each_other_and_far_from_the_floor_are_weighed():
    trials = [
        [make_trial(OFFSET, 0, 1.0e-3), make_trial(SPRING, 0, 1.1e-3), make_trial(GAIN, 0, 1.2e-3)],
        [make_trial(OFFSET, 1, 1.0e-4), make_trial(SPRING, 1, 1.1e-4)],
        [make_trial(OFFSET, 2, 1.0e-3), make_trial(SPRING, 2, 2.0e-3)],
        [
            make_trial(OFFSET, 3, 0.50e-3, False),
            make_trial(SPRING, 3, 0.55e-3, False),
            make_trial(GAIN, 3, 1e-3, False),
        ],
    ]
    found = contenders(trials, torch.full((4,), 1e-4))
    assert found == [[OFFSET, SPRING], [], [], [OFFSET, SPRING]]


@pytest.mark.parametrize(("spring", "chosen", "alike"), [(4.0, SPRING, [OFFSET]), (-4.0, OFFSET, [])])
def test_of_effects_that_were_weighed_the_one_with_the_most_evidence_is_taken(spring, chosen, alike):
    """What leaves 14 % more than it is no rival."""
    choice = choose([[make_trial(OFFSET, 0, 1.0e-3), make_trial(SPRING, 0, 1.14e-3)]], [{OFFSET: 0.0, SPRING: spring}])
    assert choice.chosen == [chosen] and choice.rivals == [alike]
