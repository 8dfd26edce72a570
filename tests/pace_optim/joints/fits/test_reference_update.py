"""The motion that joints follow is renewed as long as that pays, and no longer."""

from types import SimpleNamespace

import pytest
import torch

from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.reference_update import ReferenceUpdate

FLOOR = 0.5


def fitted_with(score):
    """A model without effects, by its score."""
    return SimpleNamespace(score=score, model=SimpleNamespace(effects=()))


class Robot:
    """How far its model is from its reference, where it moves, and how well the model fits there, each time one looks.

    Joints with neighbours have no distance that would do.
    """

    def __init__(self, positions, scores, away=None):
        self.positions, self.scores, self.fits = iter(positions), iter(scores), 0
        self.problem = SimpleNamespace(joints_stand_alone=away is not None)
        self.distances = iter(away or ())

    @staticmethod
    def path(position):
        return SimpleNamespace(position=torch.tensor([[position]]))

    @staticmethod
    def twins(path):
        return SimpleNamespace(path=path, in_windows=lambda: "windows")

    def side_by_side(self, problem, starts, max_iteration):
        assert problem == "windows"
        self.fits += 1
        return [fitted_with(torch.tensor(next(self.scores)))]

    def follow(self, position, n=1):
        """Whether it is the same reference and the same model, and where the reference is."""
        robot = self

        class Made(ReferenceUpdate):
            def away(self, twins, now):
                return next(robot.distances)

            def path(self, now):
                return robot.path(next(robot.positions))

            def along(self, path):
                return robot.twins(path)

        class Fake(Fits):
            def side_by_side(self, *args):
                return robot.side_by_side(*args)

        motion = Made(fits=Fake(), problem=self.problem, candidates=(), enough=torch.full((n,), FLOOR))
        twins, now = self.twins(self.path(position)), fitted_with(torch.full((n,), 40.0))
        along, fitted = motion.follow(twins, now)
        return along is twins, fitted is now, float(along.path.position)


def test_a_joint_alone_that_hardly_moves_otherwise_stays_on_its_reference():
    robot = Robot(positions=[], scores=[], away=[0.009])
    assert robot.follow(0.0) == (True, True, 0.0)
    assert robot.fits == 0


def test_a_joint_alone_is_fitted_again_until_its_motion_stays():
    robot = Robot(positions=[0.5, 0.45], scores=[[20.0], [10.0]], away=[0.3, 0.011, 0.005])
    assert robot.follow(0.0) == (False, False, pytest.approx(0.45))
    assert robot.fits == 2


@pytest.mark.parametrize(
    ("scores", "fits"),
    [
        ([[1.0, 1.0], [1.0, 1.0]], 2),  # the second motion gains nothing
        ([[4.0, 1.0], [1.0, 1.0], [0.95, 0.97]], 3),
        ([[8.0, 1.0], [4.0, 1.0], [2.0, 1.0], [1.0, 1.0]], 3),  # at most
        ([[0.2, 0.2]], 1),  # near the floor at once
    ],
)
def test_joints_follow_their_neighbours_as_long_as_that_pays(scores, fits):
    robot = Robot(positions=[0.0] * 4, scores=scores)
    assert robot.follow(0.0, n=2)[:2] == (False, False)
    assert robot.fits == fits


def test_a_motion_with_which_the_joints_fit_worse_together_is_not_followed():
    """A payload of one joint and the biases of those above it drove each other from 0.3 to 20 mrad."""
    robot = Robot(positions=[0.1, 0.2, 0.3], scores=[[4.0, 1.0], [0.6, 90.0], [0.5, 900.0]])
    assert robot.follow(0.0, n=2) == (False, False, pytest.approx(0.1))
    assert robot.fits == 3
