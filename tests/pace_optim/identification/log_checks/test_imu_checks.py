"""An IMU in other units, turned or late, and a contact that sticks are found before a fit."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import says
from walking import DT, walking_problem

from pace_optim.identification.log_checks.balance import views_of
from pace_optim.identification.log_checks.checks import checked, explained


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    """A trot."""
    return walking_problem(tmp_path_factory.mktemp("walk"), duration=1.5)[0]


@pytest.fixture(scope="module")
def view(problem):
    """The same, as the balance of torques sees it."""
    return views_of(problem)[0]


@pytest.mark.slow
def test_nothing_is_wrong_with_an_imu_that_is_right(view):
    assert explained(view) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("matrix", "check", "words"),
    [
        (np.diag([1, 1, 1, 1 / 9.81, 1 / 9.81, 1 / 9.81]), "IMU units", ("base_lin_acc is in g", "9.81")),
        (np.diag([180 / np.pi] * 3 + [1] * 3), "IMU units", ("base_ang_vel is in degrees per second",)),
        (np.diag([1, -1, -1, 1, -1, -1]), "IMU axes", ("the IMU has other axes", "y is -y, z is -z")),
        (np.eye(6)[[1, 0, 2, 4, 3, 5]], "IMU axes", ("x is y, y is x, z is z",)),
        (np.diag([1, -1, 1, 1, 1, 1]), "IMU axes", ("base_ang_vel has other axes", "y is -y")),
    ],
)
def test_an_imu_in_other_units_or_axes_is_found(view, matrix, check, words):
    (found, *_) = explained(replace(view, frame=view.frame @ matrix.T))
    assert found.check == check and found.stops
    with pytest.raises(ValueError, match=says(*words)):
        raise ValueError(found.sentence)


@pytest.mark.slow
def test_an_imu_that_is_late_is_found_with_its_delay(view):
    steps = 3
    frame = np.concatenate([view.frame[:1].repeat(steps, axis=0), view.frame[:-steps]])
    found = explained(replace(view, frame=frame))
    assert [each.check for each in found] == ["IMU delay"] and not found[0].stops
    assert float(found[0].text.split(" ms")[0].split()[-1]) == pytest.approx(1e3 * DT * steps, abs=1.0)


@pytest.mark.slow
def test_an_imu_that_is_late_is_shifted_for_the_fit(problem):
    late = replace(problem.with_imu_delays({"walk": -3 * DT}), imu_delays={})
    found = checked(late)
    assert found.imu_delays["walk"] == pytest.approx(3 * DT, abs=1e-3)
    assert "[W3]" in found.contradictions[-1] and "shifted" in found.contradictions[-1]
    off = [float((each.dataset.carried.base - problem.dataset.carried.base).square().mean()) for each in (late, found)]
    assert off[1] < 0.3 * off[0]
    assert checked(problem).imu_delays == {}


@pytest.mark.slow
def test_a_contact_that_sticks_is_found(view):
    stuck = view.standing.copy()
    stuck[:, 1] = True
    free = view.free.copy()
    free[:, 2:4] = False
    (found,) = explained(replace(view, standing=stuck, free=free))
    assert found.check == "contacts" and found.joints == ("fr_hip", "fr_knee") and not found.stops
    stuck[:, 1], free[:, 2:4] = False, True
    assert any(
        "contact of fr is 0 throughout" in each.text for each in explained(replace(view, standing=stuck, free=free))
    )
