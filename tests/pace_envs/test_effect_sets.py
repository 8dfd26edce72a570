"""Sets of effects, within their bounds, at once: the motion stays finite, as nothing but drives brings energy in."""

import pytest
import torch
from effect_envs import Bench, long_chirp
from effect_sets import blown_up, rows_of
from problems import BENCH

SO101 = "Pace-SO101-v0"
SIZES = {BENCH: (48, 1.5), SO101: (24, 0.5), "Pace-Go2-v0": (12, 0.25)}
"""Rows and seconds, for a short test; ``python tests/support/effect_sets.py`` is the long one."""


@pytest.mark.slow
@pytest.mark.parametrize("task", SIZES)
def test_random_sets_of_effects_stay_finite(task):
    count, seconds = SIZES[task]
    rows = rows_of(count, seed=0)
    assert [rows[r] for r in blown_up(task, rows, seconds, seed=0, largest=1e3)] == []


@pytest.mark.slow
def test_what_takes_from_friction_never_drives_a_motor_behind_a_spring():
    rows = rows_of(1, seed=0)
    assert rows == [
        {"quadratic_friction.coefficient": -1.0, "joint_elasticity.stiffness": 2e4, "joint_elasticity.damping": 0.0}
    ]
    assert blown_up(BENCH, rows, 1.0, seed=0, largest=1e3) == []


@pytest.mark.slow
def test_elasticity_beside_backlash_is_a_spring_in_series():
    """Two couplings that each took the other's torque for the motor's brought energy in."""
    gap, side = 0.02, 1.0
    both = {
        **{"backlash.gap": gap, "backlash.stiffness": 3000.0, "backlash.damping": 4.0, "backlash.encoder_side": side},
        **{"joint_elasticity.stiffness": 600.0, "joint_elasticity.damping": 1.0},
    }
    k = 1 / (1 / 3000 + 1 / 600)
    c = k**2 * (4.0 / 3000**2 + 1.0 / 600**2)
    one = {"backlash.gap": gap, "backlash.stiffness": k, "backlash.damping": c, "backlash.encoder_side": side}
    names, targets = ("joint_elasticity", "backlash"), 0.4 * long_chirp(0.5)
    expected = Bench(("backlash",), one).follow(targets)
    for effects in (names, names[::-1]):
        torch.testing.assert_close(Bench(effects, both).follow(targets), expected, rtol=1e-9, atol=1e-12)
