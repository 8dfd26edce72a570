"""The steps of the search: trying what could come next, growing a model by it, and making it simple in the end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.fitting.coarse_to_fine import fit_over_wide_steps, fit_side_by_side, fit_to_whole
from pace_optim.diagnosis.fitting.trimmed_fit import fit_trimmed
from pace_optim.diagnosis.judging.acceptance import BlockErrors
from pace_optim.diagnosis.judging.candidate_results import ALIKE, FAR, NEXT_FLOOR, RIVAL, Round
from pace_optim.diagnosis.judging.some_joints import SomeJoints
from pace_optim.diagnosis.judging.validation import validation_errors
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.diagnosis.search.merge_effects import one_for_several
from pace_optim.diagnosis.search.one_round import try_effects
from pace_optim.diagnosis.search.pruning import pruned, pruned_at_last
from pace_optim.diagnosis.search.replace_effect import exchanged, swapped
from pace_optim.single_joint_model.problem import TwinProblem


@dataclass(frozen=True, kw_only=True, eq=False)
class Branch:
    """A model on the way, and the rounds that led to it."""

    problem: TwinProblem
    now: Fitted
    errors: BlockErrors
    rounds: list[Round]

    def fall_with(self, effect: type[Effect]) -> float:
        """By how much an effect lowered the squared error of the joints that chose it [rad²]."""
        trials = [t for this in self.rounds for own in this.trials for t in own if this.chosen[t.joint] is effect]
        return sum(trial.mse_before - trial.mse_after for trial in trials if trial.effect is effect)

    def ends(self, found: Round | None) -> list[End]:
        """Where the best of what could come next leads each joint."""
        model, mse, ends = self.now.model, self.errors.mse, []
        for j in range(model.num_joints):
            own = {effect for effect, has in zip(model.effects, model.has, strict=True) if has[j]}
            trials = [] if found is None else [t for t in found.trials[j] if t.significant and t.mse_after < mse[j]]
            best = min(trials, key=lambda trial: trial.mse_after, default=None)
            ends.append(
                End(effects=frozenset(own), mse=float(mse[j]))
                if best is None
                else End(effects=frozenset({*own, best.effect}), mse=best.mse_after)
            )
        return ends


@dataclass(frozen=True, kw_only=True)
class End:
    """Where a way leads a joint."""

    effects: frozenset[type[Effect]]
    mse: float
    """On validation [rad²]."""

    def beats(self, other: End) -> bool:
        """Whether to go this way in place of another: for less error, or for as little with fewer numbers."""
        numbers, others = (sum(len(e.parameters) for e in end.effects) for end in (self, other))
        if self.effects == other.effects or numbers > others:
            return self.mse * RIVAL**2 < other.mse
        return self.mse < (ALIKE**2 if numbers < others else 1.0) * other.mse


@dataclass(frozen=True, kw_only=True, eq=False)
class Steps:
    """One step at a time, on whatever branch; fields as in :func:`pace_optim.diagnosis.search.search.add_effects`."""

    effects: Sequence[type[Effect]]
    effort: torch.Tensor
    floor: torch.Tensor
    max_effects: int
    say: Callable[[str], None]
    follow: Callable[[TwinProblem, Fitted], tuple[TwinProblem, Fitted]]

    @property
    def tried_over_joints(self) -> int:
        """How many candidates were tried, over all joints."""
        return len(self.effects) * len(self.floor)

    def tried(self, branch: Branch) -> Round | None:
        """What could come next; ``None`` if there is nothing to try."""
        depth = len(branch.rounds)
        missed = torch.zeros(len(self.floor))
        for each in branch.rounds:
            missed += torch.tensor([chosen is None for chosen in each.chosen])
        above = branch.errors.mse.sqrt() / self.floor
        # how the neighbours moved may have hidden what is missing: once they are explained, a second try
        open_joints = missed <= (above > FAR)
        # beside a joint that is far from the floor, another's last tenths may come from how that one moves
        alike = depth == 0 and bool((above <= FAR).all())
        open_joints &= above > (1.0 if alike else NEXT_FLOOR)
        untried = [e for e in self.effects if bool((branch.now.model.may_get(e) & open_joints).any())]
        if depth == self.max_effects or not bool(open_joints.any()) or not untried:
            return None
        self.say(f"looking for effect {depth + 1}: screening {len(untried)} candidates")
        part = SomeJoints(open_joints)
        now, errors = part.of_fit(branch.now), part.of_errors(branch.errors)
        found = try_effects(
            part.of_problem(branch.problem),
            now,
            errors,
            untried,
            self.effort[open_joints],
            self.floor[open_joints],
            self.say,
            rough=bool(self._rough(branch.now, branch.errors.mse, FAR).any()),
        )
        return None if found is None else part.round_of_all(found, branch.now)

    def _rough(self, now: Fitted, mse: torch.Tensor, times: float) -> torch.Tensor:
        """Joints above so many times the floor, where contacts or springs may keep narrow derivatives back, (n,)."""
        stiff = [has for effect, has in zip(now.model.effects, now.model.has, strict=True) if effect.is_stiff]
        has_stiff = torch.stack(stiff).any(dim=0) if stiff else torch.zeros_like(self.floor, dtype=torch.bool)
        return has_stiff & (mse.sqrt() > times * self.floor)

    def settled(self, problem: TwinProblem, now: Fitted) -> tuple[Fitted, BlockErrors]:
        """A model fitted to whole recordings, as well as it can be before another effect is sought; its errors."""
        if bool(self._rough(now, now.score, NEXT_FLOOR).any()):
            now = fit_over_wide_steps(problem, now)
        if now.jacobian is None:  # it was fitted in windows
            now = fit_to_whole(problem, [now])[0]
        errors = validation_errors(problem, [now])[0]
        rough = self._rough(now, now.score, NEXT_FLOOR)
        if bool(rough.any()) and (trimmed := fit_trimmed(problem, now, rough)) is not None:
            other = fit_to_whole(problem, [trimmed])[0]
            other_errors = validation_errors(problem, [other])[0]
            better = other_errors.mse < errors.mse
            now.take(other, better)
            errors = replace(errors, square=torch.where(better, other_errors.square, errors.square))
        return now, errors

    def along_own_motion(self, problem: TwinProblem, now: Fitted) -> tuple[TwinProblem, Fitted, BlockErrors]:
        """The joints along the motion of the robot with a model, the model fitted there, and its errors."""
        problem, now = self.follow(problem, now)
        return problem, *self.settled(problem, now)

    def grown(self, branch: Branch, found: Round) -> Branch:
        """The branch with each joint's chosen effect, and what that changes of the older ones."""
        rounds = [each.copy() for each in [*branch.rounds, found]]
        problem, now, errors = self.along_own_motion(branch.problem, combined(branch.problem, branch.now, found))
        self.say("trying others in place of what was found")
        if (other := swapped(problem, now, errors, rounds, self.floor)) is not None:
            problem, now, errors = self.along_own_motion(problem, other)
        if branch.rounds:
            self.say("trying to do without what was found earlier")
        now, errors = pruned(problem, now, errors, found.chosen)
        return Branch(problem=problem, now=now, errors=errors, rounds=rounds)

    def simplified(self, branch: Branch) -> Branch:
        """The branch with no more effects than pay, along the motion that follows."""
        rounds = [each.copy() for each in branch.rounds]
        problem, now, errors = branch.problem, branch.now, branch.errors
        if (one := one_for_several(problem, now, errors, rounds, self.tried_over_joints)) is not None:
            problem, now, errors = self.along_own_motion(problem, one)
            if (other := swapped(problem, now, errors, rounds, self.floor)) is not None:
                problem, now, errors = self.along_own_motion(problem, other)
        left, left_errors = pruned_at_last(problem, now, errors, self.tried_over_joints)
        if left is not now:
            problem, left, left_errors = self.along_own_motion(problem, left)
        return Branch(problem=problem, now=left, errors=left_errors, rounds=rounds)


def combined(problem: TwinProblem, now: Fitted, found: Round) -> Fitted:
    """The present model with each joint's chosen effect, refitted unless all joints chose the same."""
    one = found.models[found.chosen[0]] if len(set(found.chosen)) == 1 and found.chosen[0] is not None else None
    if one is not None and one.jacobian is not None:
        return replace(one, tried=None)
    model, physical, size = now.model, now.model.to_physical(now.x), now.model.size
    for effect in dict.fromkeys(e for e in found.chosen if e is not None):
        has = torch.tensor([e is effect for e in found.chosen])
        model, physical = exchanged(model, physical, has, [], found.models[effect], effect, size)
    return fit_side_by_side(problem, [Fitted.start(model, physical)], max_iteration=1, keep_jacobian=True)[0]
