"""Sets of effects, within their bounds, at once: the motion stays finite, as nothing but drives brings energy in."""

import pytest
from effect_sets import blown_up, rows_of
from problems import BENCH

SO101 = "Pace-SO101-v0"
SIZES = {BENCH: (48, 1.5), SO101: (24, 0.5), "Pace-Go2-v0": (12, 0.25)}
"""Rows and seconds, for a short test; ``python tests/effect_sets.py`` is the long one."""


@pytest.mark.slow
@pytest.mark.parametrize("task", SIZES)
def test_random_sets_of_effects_stay_finite(task):
    count, seconds = SIZES[task]
    rows = rows_of(count, seed=0, all_at_once=task != SO101)
    assert [rows[r] for r in blown_up(task, rows, seconds, seed=0, largest=1e3)] == []


def test_what_takes_from_friction_never_drives_a_motor_behind_a_spring():
    rows = rows_of(1, seed=0)
    assert rows == [
        {"quadratic_friction.coefficient": -1.0, "joint_elasticity.stiffness": 2e4, "joint_elasticity.damping": 0.0}
    ]
    assert blown_up(BENCH, rows, 1.0, seed=0, largest=1e3) == []
