"""Joints alone move along a reference: with what was found, along the motion that the robot now has."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from pace_actuators.effects import Effect
from pace_actuators.text import SHOWN, listed
from pace_optim.joints.fits.base_fit import whole_robot
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import COLUMN
from pace_optim.joints.simulation import reference_path, twin_problem
from pace_optim.joints.simulation.path import ReferencePath
from pace_optim.joints.simulation.problem import TwinProblem
from pace_optim.problem.problem import Problem


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceUpdate:
    """Renews the reference of the joints of a robot."""

    fits: Fits
    """Fits models."""
    problem: Problem
    """The whole robot with the base model."""
    candidates: Sequence[type[Effect]]
    """Effects whose influence on the rigid bodies is wanted."""
    enough: torch.Tensor
    """At this RMSE of each joint there is nothing more to gain, (n,) [rad]."""
    say: Callable[[str], None] = lambda _: None
    """Shows how far it is."""

    def follow(self, twins: TwinProblem, now: Fitted) -> tuple[TwinProblem, Fitted]:
        """The joints along the motion of the whole robot with a model, and the model fitted there in windows.

        Args:
            twins: The joints along the present reference.
            now: The model, fitted along it.
        """
        names = listed([effect.name for effect in now.model.effects] or ["the base model"], SHOWN)
        alone, cfg = self.problem.joints_stand_alone, self.fits.cfg
        # what a link's inertia changes is linear in an effect's parameters only near what they have here
        on_links = any(effect.overrides("write_model") for effect in now.model.effects)
        made: list[tuple[TwinProblem, Fitted]] = []
        for k in range(cfg.rounds):
            self.say(f"simulating the whole robot with {names}, round {k + 1} of at most {cfg.rounds}")
            if alone and not on_links and self.away(twins, now) < cfg.near:  # gravity is linear there
                break
            before = now.score
            twins = self.along(self.path(now))
            now = self.fits.side_by_side(twins.in_windows(), [now], cfg.again)[0]
            made.append((twins, now))
            if bool(((now.score <= self.enough**2) | (now.score > cfg.gain * before)).all()):
                break
        # joints that move each other may drive each other away
        return (twins, now) if alone else min(made, key=lambda each: self._left(each[1]))

    def _left(self, now: Fitted) -> float:
        """Logarithm of what the joints' squared errors are above the floor together."""
        return float((now.score / self.enough**2).clamp(min=1.0).log().sum())

    def away(self, twins: TwinProblem, now: Fitted) -> float:
        """RMS distance of joints from their reference with a model [rad]; as in windows at the control step."""
        problem, values = whole_robot(twins.coarse(), now)
        rollout, sampled = problem.evaluator().rollout(1), problem.dataset.sampled
        rollout.start(values[None], sampled)
        square = torch.zeros(())
        for k, _ in enumerate(rollout.simulated(rollout.duration_steps)):
            away = rollout.robot.data.joint_pos - problem.path.position[k]  # type: ignore[attr-defined]
            square = square + away[sampled[k]].square().sum()
        rollout.env.close()
        return math.sqrt(float(square) / (int(sampled.sum()) * len(problem.joint_names)))

    def along(self, path: ReferencePath) -> TwinProblem:
        """The joints along a reference."""
        return twin_problem(self.problem, path)

    def path(self, now: Fitted) -> ReferencePath:
        """The motion of the whole robot with a model."""
        every = dict.fromkeys([*self.candidates, *now.model.effects])
        changing = [effect.name for effect in every if effect.overrides("write_model")]
        held = ~now.model.free[:, COLUMN["delay"]]
        return reference_path(*whole_robot(self.problem, now), changing, late=held, away=self.fits.cfg.away)
