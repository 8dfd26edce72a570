"""The identification problem with joints simulated alone."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import partial

import torch

from pace_envs import ManagerBasedRLEnv
from pace_optim.joints.simulation.path import ReferencePath
from pace_optim.joints.simulation.simulation import TwinSimulation
from pace_optim.problem.evaluator import Evaluator
from pace_optim.problem.problem import Problem
from pace_optim.recording.dataset import Dataset
from pace_optim.recording.windows import Windows


@dataclass(kw_only=True, eq=False)
class TwinProblem(Problem):
    """A problem whose joints are simulated alone along a path; each is a separate tree."""

    path: ReferencePath
    """Of the same recordings."""

    def evaluator(self) -> Evaluator:
        """An evaluator of candidates on all recordings."""
        return self._evaluator(self.dataset, self.path)

    def training_evaluator(self) -> Evaluator:
        """An evaluator of candidates on the recordings that are trained on."""
        trained = self.dataset.trained()
        return self._evaluator(self.dataset.select(trained), self.path.select(trained))

    def on_joints(self, joints: torch.Tensor) -> TwinProblem:
        """The same of some of the joints, (n,) bool, without effects: the others cost nothing."""
        if bool(joints.all()):
            return self
        places = joints.nonzero()[:, 0].tolist()
        cfg = self.plain_cfg.on_joints([self.joint_names[j] for j in places])
        trees, data = [self.trees[j] for j in places], self.dataset.on_joints(places)
        part = replace(self, plain_cfg=cfg, trees=trees, dataset=data, path=self.path.on_joints(places))
        return part.with_effects(()).with_physics_dt(self.physics_dt)

    def in_windows(self) -> TwinProblem:
        """The same with recordings cut into windows: some times as fast, to lead a fit, not to judge by."""
        if self.dataset.carried is not None:  # a free phase is a window already
            return self
        windows = Windows.of(self.dataset, self.control_dt)
        path = self.path.at(windows.step, windows.recording)
        return replace(self, dataset=windows.cut(self.dataset), path=path)

    def coarse(self) -> TwinProblem:
        """The same in windows, and at the longest physics step."""
        return self.in_windows().with_physics_dt(self.coarsest_dt)

    def _evaluator(self, dataset: Dataset, path: ReferencePath) -> Evaluator:
        def make_env(num_envs: int) -> ManagerBasedRLEnv:
            return self.make_env(num_envs, simulation=partial(TwinSimulation, path=path))

        return Evaluator(make_env, dataset, self.space, self.trees, path.phases)


def twin_problem(problem: Problem, path: ReferencePath) -> TwinProblem:
    """The same recordings and parameters, each joint a separate tree.

    Args:
        path: A reference simulation on the same recordings.
    """
    content = {field.name: getattr(problem, field.name) for field in fields(Problem)}
    content["plain_cfg"] = problem.plain_cfg.of_driven_joints()
    content["env_cfg"] = problem.env_cfg.of_driven_joints()
    content["trees"] = [[name] for name in problem.joint_names]
    return TwinProblem(**content, path=path)
