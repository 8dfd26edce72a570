"""The low-pass without delay, against its gain over frequency."""

import numpy as np
import pytest

from pace_optim.comparison.low_pass import low_passed

DT, CUTOFF = 0.0025, 10.0


@pytest.mark.parametrize("frequency", [2.0, 10.0, 40.0])
def test_a_sine_keeps_its_phase_and_gets_the_filter_s_gain(frequency):
    time = DT * np.arange(4000)
    sine = np.sin(2 * np.pi * frequency * time)
    gain = 1 / (1 + (np.tan(np.pi * frequency * DT) / np.tan(np.pi * CUTOFF * DT)) ** 6)
    middle = slice(400, -400)
    assert low_passed(sine, DT, CUTOFF)[middle] == pytest.approx(gain * sine[middle], abs=1e-6)


def test_lines_pass_as_they_are_each_series_alone():
    lines = np.linspace(0.0, 1.0, 500)[:, None] * np.array([1.0, -3.0]) + 0.2
    assert low_passed(lines, DT, CUTOFF) == pytest.approx(lines, abs=1e-12)
