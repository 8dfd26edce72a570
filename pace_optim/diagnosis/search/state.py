"""What a search looks for and with what, and the branches that it follows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg
from pace_optim.diagnosis.selection.candidate_results import Round
from pace_optim.diagnosis.selection.decisions import Decision, Log, unlogged
from pace_optim.diagnosis.selection.rules import decide
from pace_optim.joints.fits.block_errors import BlockErrors
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.simulation.problem import TwinProblem


@dataclass(frozen=True, kw_only=True, eq=False)
class Branch:
    """A model on the way, and the rounds that led to it."""

    problem: TwinProblem
    """The joints along the motion of the robot with the model."""
    now: Fitted
    errors: BlockErrors
    rounds: tuple[Round, ...] = ()

    def on_joints(self, joints: torch.Tensor) -> Branch:
        """The model of some joints, (n,) bool, without what led to it."""
        problem, now = self.problem.on_joints(joints), self.now.on_joints(joints)
        return Branch(problem=problem, now=now, errors=self.errors.on_joints(joints))


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """What is looked for, and the steps that every move is made of."""

    effects: Sequence[type[Effect]]
    """Candidates."""
    effort: torch.Tensor
    """Typical torque of each joint, (n,) [N m]."""
    floor: torch.Tensor
    """RMSE of each joint that no model can go below, (n,) [rad]."""
    max_effects: int
    """Most effects of a joint."""
    fits: Fits
    """Fits models."""
    try_effects: Callable[[Search, Branch, bool], Round | None]
    """Tries what could be missing beside a model; the last says whether over wide steps."""
    cfg: DiagnosisCfg = DEFAULT
    """By what numbers it is decided."""
    say: Callable[[str], None] = lambda _: None
    """Shows how far it is."""
    log: Log = unlogged
    """Gets every decision."""
    own: frozenset[type[Effect]] = frozenset()
    """Effects that the base model has."""
    begun: Sequence[type[Effect]] = ()
    """Candidates that are refitted in every round."""
    trees: Sequence[Sequence[int]] = ()
    """Joints that move each other, by index; none: each moves itself alone."""
    follow: Callable[[TwinProblem, Fitted], tuple[TwinProblem, Fitted]] = lambda problem, now: (problem, now)
    """Gives the joints along the motion of the robot with a model, and the model fitted there."""

    @property
    def at_floor(self) -> torch.Tensor:
        """Below this RMSE of each joint there is nothing to find, (n,) [rad]."""
        return self.cfg.judging.alike * self.floor

    @property
    def tried_over_joints(self) -> int:
        """How many candidates were tried, over all joints."""
        return len(self.effects) * len(self.floor)

    def far(self, errors: BlockErrors) -> torch.Tensor:
        """Joints that are far from the floor, (n,) bool."""
        return errors.mse.sqrt() > self.cfg.judging.far * self.floor

    def tried(self, branch: Branch) -> Round | None:
        """What could come next; ``None`` if there is nothing to try."""
        cfg, depth, far = self.cfg, len(branch.rounds), self.far(branch.errors)
        missed = torch.zeros(len(self.floor))
        for each in branch.rounds:
            missed += torch.tensor([chosen is None for chosen in each.chosen])
        # how neighbours moved may have hidden it: each joint gets a second attempt
        open_joints = missed <= int(cfg.has("second_try"))
        # beside a joint that is far from the floor, another's last tenths may come from how that one moves
        alone = depth == 0 and not bool(far.any())
        above = branch.errors.mse.sqrt() > (1.0 if alone else cfg.judging.next_effect) * self.at_floor
        has = torch.zeros_like(far)
        for effect, own in zip(branch.now.model.effects, branch.now.model.has, strict=True):
            has |= own & (effect not in self.own)
        open_joints &= torch.where(has, far, above)
        untried = [e for e in self.effects if bool((branch.now.model.allowed_joints(e) & open_joints).any())]
        if depth == self.max_effects or not bool(open_joints.any()) or not untried:
            return None
        self.say(f"looking for effect {depth + 1} of at most {self.max_effects}: screening {len(untried)} candidates")
        places = open_joints.nonzero()[:, 0].tolist()

        def log(own: Decision) -> None:
            facts = own.facts | {"effect": depth + 1}
            self.log(replace(own, joints=[places[j] for j in own.joints], facts=facts))

        rough = bool(self._rough(branch.now, branch.errors.mse, cfg.judging.far).any())
        effort, floor = self.effort[open_joints], self.floor[open_joints]
        part = replace(self, effects=untried, effort=effort, floor=floor, log=log)
        found = self.try_effects(part, branch.on_joints(open_joints), rough)
        return None if found is None else found.among_all(open_joints, branch.now)

    def along_own_motion(self, branch: Branch, now: Fitted) -> Branch:
        """A branch with another model, along the motion that the robot then has."""
        problem, now = self.follow(branch.problem, now)
        now, errors = self.settled(problem, now)
        return replace(branch, problem=problem, now=now, errors=errors)

    def settled(self, problem: TwinProblem, now: Fitted) -> tuple[Fitted, BlockErrors]:
        """A model fitted to whole recordings, as well as it can be before another effect is sought; its errors."""
        fits, near = self.fits, self.cfg.judging.next_effect
        if bool(self._rough(now, now.score, near).any()) and self.cfg.has("wide_steps"):
            now = fits.over_wide_steps(problem, now)
        now = fits.to_the_end(problem, now)
        errors = fits.validation_errors(problem, [now])[0]
        rough = self._rough(now, now.score, near)
        if not bool(rough.any()) or not self.cfg.has("trim"):
            return now, errors
        if (trimmed := fits.trimmed(problem, now, rough)) is None:
            return now, errors
        other = fits.to_whole(problem, [trimmed])[0]
        others = fits.validation_errors(problem, [other])[0]
        joints = rough.nonzero()[:, 0].tolist()
        taken = decide("trim", joints, errors, {"trimmed": others}, cfg=self.cfg, log=self.log)
        better = torch.tensor([j in taken for j in range(len(rough))])
        return now.with_joints(better, other), errors.with_joints(better, others)

    def _rough(self, now: Fitted, mse: torch.Tensor, times: float) -> torch.Tensor:
        """Joints above so many times the floor, where contacts or springs may keep narrow derivatives back, (n,)."""
        stiff = [has for effect, has in zip(now.model.effects, now.model.has, strict=True) if effect.is_stiff]
        has_stiff = torch.stack(stiff).any(dim=0) if stiff else torch.zeros_like(self.floor, dtype=torch.bool)
        return has_stiff & (mse.sqrt() > times * self.at_floor)


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """Where a search ended."""

    problem: TwinProblem
    """The joints along the motion of the robot with the final model."""
    base: Fitted
    base_errors: BlockErrors
    final: Fitted
    final_errors: BlockErrors
    trees: Sequence[Sequence[int]] = ()
    """Joints that move each other, by index; none: each moves itself alone."""
    rounds: Sequence[Round] = ()
    cfg: DiagnosisCfg = DEFAULT
    """The numbers that it was found with, and is judged by."""

    def far(self, floor: torch.Tensor) -> torch.Tensor:
        """Joints that end far from a floor (n,) [rad], (n,) bool."""
        return self.final_errors.mse.sqrt() > self.cfg.judging.far * floor
