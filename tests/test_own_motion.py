"""The motion that joints follow is renewed as long as that pays, and no longer."""

from types import SimpleNamespace

import pytest
import torch

from pace_optim.diagnosis import own_motion
from pace_optim.diagnosis.own_motion import OwnMotion

FLOOR = 1e-4


class Robot:
    """Where its model moves it, and how well the model fits along each motion; one entry each time it is looked at."""

    def __init__(self, monkeypatch, positions, scores, trees=(("knee",),)):
        self.positions, self.scores, self.fits = iter(positions), iter(scores), 0
        self.problem = SimpleNamespace(trees=[list(tree) for tree in trees])
        monkeypatch.setattr(OwnMotion, "_path", lambda *_: self.path(next(self.positions)))
        monkeypatch.setattr(own_motion, "twin_problem", lambda _, path: self.twins(path))
        monkeypatch.setattr(own_motion, "fit_side_by_side", self.fit)

    @staticmethod
    def path(position):
        return SimpleNamespace(position=torch.tensor([[position]]))

    @staticmethod
    def twins(path):
        return SimpleNamespace(path=path, in_windows=lambda: "windows")

    def fit(self, problem, starts, max_iteration):
        assert problem == "windows"
        self.fits += 1
        return [SimpleNamespace(score=torch.tensor([next(self.scores) ** 2]))]

    def follow(self, position, score):
        motion = OwnMotion(problem=self.problem, candidates=(), enough=torch.tensor([FLOOR]))
        now = SimpleNamespace(score=torch.tensor([score**2]))
        twins = self.twins(self.path(position))
        along, fitted = motion.follow(twins, now)
        return along is twins, fitted is now, float(along.path.position)


def test_a_joint_alone_that_hardly_moves_otherwise_stays_on_its_reference(monkeypatch):
    robot = Robot(monkeypatch, positions=[0.019], scores=[])
    assert robot.follow(0.0, score=1.0) == (True, True, 0.0)
    assert robot.fits == 0


def test_a_joint_alone_is_fitted_again_until_its_motion_stays(monkeypatch):
    robot = Robot(monkeypatch, positions=[0.5, 0.45, 0.44], scores=[0.5, 0.1])
    assert robot.follow(0.0, score=1.0) == (False, False, pytest.approx(0.45))
    assert robot.fits == 2


@pytest.mark.parametrize(
    ("scores", "fits"),
    [
        ([0.96], 1),  # lowered the squared error by less than a tenth
        ([0.9, 0.86], 2),
        ([0.5 * FLOOR], 1),  # nothing more to gain
        ([0.5, 0.25, 0.12, 0.06], 4),  # at most
    ],
)
def test_a_joint_with_neighbours_follows_them_as_long_as_that_pays(monkeypatch, scores, fits):
    robot = Robot(monkeypatch, positions=[0.0] * 4, scores=scores, trees=[["hip", "knee"]])
    assert robot.follow(0.0, score=1.0)[:2] == (False, False)
    assert robot.fits == fits
