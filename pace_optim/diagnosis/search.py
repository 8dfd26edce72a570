"""Adding effects one after another, each joint by itself, as long as they pay on validation recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.acceptance import BlockErrors
from pace_optim.diagnosis.descent import Fitted, fit_over_wide_steps, fit_side_by_side
from pace_optim.diagnosis.evenness import unevenness
from pace_optim.diagnosis.one_for_several import one_for_several
from pace_optim.diagnosis.one_round import try_effects
from pace_optim.diagnosis.pruning import Without, pruned, pruned_at_last
from pace_optim.diagnosis.some_joints import SomeJoints
from pace_optim.diagnosis.swapping import exchanged, swapped
from pace_optim.diagnosis.trials import NEXT_FLOOR, RIVAL, Round, Trial, near_trials
from pace_optim.diagnosis.validation import validation_errors
from pace_optim.joint_twins.problem import TwinProblem

LOOK_AHEAD = 3.0
"""Where an effect leaves more than this many times the floor, the next one leads on for a round too."""


@dataclass(kw_only=True, eq=False)
class Outcome:
    """Where the search ended."""

    problem: TwinProblem
    """The joints along the motion of the robot with the final model."""
    base: Fitted
    base_errors: BlockErrors
    final: Fitted
    final_errors: BlockErrors
    unevenness: torch.Tensor
    """Of the final model's effects, before joints share values, (effects, n)."""
    rounds: list[Round] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Branch:
    """A model on the way, and the rounds that led to it."""

    problem: TwinProblem
    now: Fitted
    errors: BlockErrors
    rounds: list[Round]

    def fall_with(self, effect: type[Effect]) -> float:
        """By how much an effect lowered the squared error of the joints that chose it [rad²]."""
        trials = [t for this in self.rounds for own in this.trials for t in own if this.chosen[t.joint] is effect]
        return sum(trial.mse_before - trial.mse_after for trial in trials if trial.effect is effect)


def add_effects(
    problem: TwinProblem,
    base: Fitted,
    effects: Sequence[type[Effect]],
    effort: torch.Tensor,
    floor: torch.Tensor,
    max_effects: int,
    say: Callable[[str], None] = lambda _: None,
    follow: Callable[[TwinProblem, Fitted], tuple[TwinProblem, Fitted]] = lambda problem, now: (problem, now),
) -> Outcome:
    """Look for the effects that are missing.

    Args:
        problem: The joints simulated alone.
        base: The base model, fitted, with its Jacobian.
        effects: Candidates.
        effort: Typical torque of each joint, (n,) [N m].
        floor: Below this RMSE of each joint there is nothing to find, (n,) [rad].
        max_effects: Most effects of a joint.
        say: Shows how far it is.
        follow: Gives the joints along the motion of the robot with the present model, and the model fitted there.
    """
    search = _Search(effects=effects, effort=effort, floor=floor, max_effects=max_effects, say=say, follow=follow)
    errors = validation_errors(problem, [base])[0]
    branch = _Branch(problem=problem, now=base, errors=errors, rounds=[])
    found = search.tried(branch)
    while found is not None:
        together = search.at_once(branch, found)
        if together is not None:
            branch, found = together, search.tried(together)
        elif any(effect is not None for effect in found.chosen):
            branch, found = search.led_on(branch, found)
        else:
            break
    branch = search.simplified(branch)
    return Outcome(
        problem=branch.problem,
        base=base,
        base_errors=errors,
        final=branch.now,
        final_errors=branch.errors,
        unevenness=unevenness(branch.now),
        rounds=[*branch.rounds, *([] if found is None else [found])],
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """What stays the same from round to round; fields as in :func:`add_effects`."""

    effects: Sequence[type[Effect]]
    effort: torch.Tensor
    floor: torch.Tensor
    max_effects: int
    say: Callable[[str], None]
    follow: Callable[[TwinProblem, Fitted], tuple[TwinProblem, Fitted]]

    @property
    def _tried_over_joints(self) -> int:
        return len(self.effects) * len(self.floor)

    def tried(self, branch: _Branch) -> Round | None:
        """What could come next; ``None`` if there is nothing to try."""
        depth = len(branch.rounds)
        missed = torch.zeros(len(self.floor))
        for each in branch.rounds:
            missed += torch.tensor([chosen is None for chosen in each.chosen])
        above = branch.errors.mse.sqrt() / self.floor
        # how the neighbours moved may have hidden what is missing: once they are explained, a second try
        open_joints = missed <= (above > LOOK_AHEAD)
        # beside a joint that is far from the floor, another's last tenths may come from how that one moves
        alike = depth == 0 and bool((above <= LOOK_AHEAD).all())
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
            rough=self._is_rough(branch.now, branch.errors),
        )
        return None if found is None else part.round_of_all(found, branch.now)

    def _is_rough(self, now: Fitted, errors: BlockErrors) -> bool:
        """Whether contacts or springs of joints far from the floor may keep narrow derivatives from leading on."""
        far = errors.mse.sqrt() > LOOK_AHEAD * self.floor
        return any(
            e.is_stiff and bool((has & far).any()) for e, has in zip(now.model.effects, now.model.has, strict=True)
        )

    def _settled(self, problem: TwinProblem, now: Fitted) -> tuple[Fitted, BlockErrors]:
        """A model and its errors, fitted over wide steps where narrow ones may have led no further."""
        errors = validation_errors(problem, [now])[0]
        if not self._is_rough(now, errors):
            return now, errors
        now = fit_over_wide_steps(problem, now)
        return now, validation_errors(problem, [now])[0]

    def grown(self, branch: _Branch, found: Round) -> _Branch:
        """The branch with each joint's chosen effect, and what that changes of the older ones."""
        rounds = [each.copy() for each in [*branch.rounds, found]]
        problem, now = self.follow(branch.problem, _combined(branch.problem, branch.now, found))
        now, errors = self._settled(problem, now)
        self.say("trying others in place of what was found")
        if (other := swapped(problem, now, errors, rounds, self.floor)) is not None:
            problem, now = self.follow(problem, other)
            errors = validation_errors(problem, [now])[0]
        if branch.rounds:
            self.say("trying to do without what was found earlier")
        now, errors = pruned(problem, now, errors, found.chosen)
        return _Branch(problem=problem, now=now, errors=errors, rounds=rounds)

    def at_once(self, branch: _Branch, found: Round) -> _Branch | None:
        """The branch with an effect of other joints on those far from the floor; ``None`` if it does not pay on each.

        Neighbours that all lack the same hide it from each other: while one joint is tried, the others move wrongly. So
        they are judged together, along the motion that the robot then has.
        """
        far = branch.errors.mse.sqrt() > LOOK_AHEAD * self.floor
        lacking = [j for j in far.nonzero()[:, 0].tolist() if found.chosen[j] is None]
        in_use = [e for e, has in zip(branch.now.model.effects, branch.now.model.has, strict=True) if bool(has.any())]
        in_use.sort(key=branch.fall_with, reverse=True)
        for effect in [e for e in in_use if e in found.models and not e.shared]:
            joints = [j for j in lacking if any(t.effect is effect for t in found.trials[j])]
            while joints:
                self.say(f"trying {effect.name} on {len(joints)} more joint{'' if len(joints) == 1 else 's'} at once")
                chosen = [effect if j in joints else old for j, old in enumerate(found.chosen)]
                grown = self.grown(branch, replace(found, chosen=chosen))
                trials = self._judged_again(effect, joints, found, grown)
                if all(trial.significant for trial in trials.values()):
                    return replace(grown, rounds=[*grown.rounds[:-1], grown.rounds[-1].with_trials(trials)])
                joints = [j for j, trial in trials.items() if trial.significant]
        return None

    def _judged_again(
        self, effect: type[Effect], joints: Sequence[int], found: Round, grown: _Branch
    ) -> dict[int, Trial]:
        """What an effect brings each of several joints, held against them without it along the same motion."""
        model = grown.now.model
        here = torch.zeros(model.num_joints, dtype=torch.bool)
        here[list(joints)] = True
        has = model.has[model.effects.index(effect)]
        without = Without(grown.problem, grown.now, grown.errors, {effect: here & has}).errors
        before = without.get(effect, grown.errors)  # nothing is gained where it is not there any more
        trials = {j: next(t for t in found.trials[j] if t.effect is effect) for j in joints}
        return {
            j: trial.judged(before, grown.errors, self._tried_over_joints, first=False) for j, trial in trials.items()
        }

    def led_on(self, branch: _Branch, found: Round) -> tuple[_Branch, Round | None]:
        """The branch with the effects that lead furthest, and what could come next.

        The best effect of the first round may stand in for two others, each of which is worse alone. Where it leaves
        much unexplained, the next one of each joint leads on for a round too, and is taken if it ends lower.
        """
        first = self.grown(branch, found)
        ahead = self.tried(first)
        reach, enough = _reach(first, ahead), (LOOK_AHEAD * self.floor) ** 2
        unexplained = (first.errors.mse > enough) & (reach > enough)
        other = _next_choice(found, unexplained)
        if branch.rounds or ahead is None or other is None:
            return first, ahead
        self.say(f"looking ahead with {', '.join(dict.fromkeys(e.name for e in other.chosen if e is not None))}")
        # along the present reference, which is near enough for a look
        now, errors = self._settled(branch.problem, _combined(branch.problem, branch.now, other))
        way = _Branch(problem=branch.problem, now=now, errors=errors, rounds=[other])
        beyond = self.tried(way)
        better = unexplained & (RIVAL**2 * _reach(way, beyond) < reach)
        if not bool(better.any()):
            return first, ahead
        chosen = [two if yes else one for one, two, yes in zip(found.chosen, other.chosen, better, strict=True)]
        taken = self.grown(branch, replace(found, chosen=chosen))
        return taken, beyond if _is_same(taken, way) else self.tried(taken)

    def simplified(self, branch: _Branch) -> _Branch:
        """The branch with no more effects than pay, along the motion that follows."""
        rounds = [each.copy() for each in branch.rounds]
        problem, now, errors = branch.problem, branch.now, branch.errors
        if (one := one_for_several(problem, now, errors, rounds, self._tried_over_joints)) is not None:
            problem, now = self.follow(problem, one)
            errors = validation_errors(problem, [now])[0]
            if (other := swapped(problem, now, errors, rounds, self.floor)) is not None:
                problem, now = self.follow(problem, other)
                errors = validation_errors(problem, [now])[0]
        left, left_errors = pruned_at_last(problem, now, errors, self._tried_over_joints)
        if left is not now:
            problem, left = self.follow(problem, left)
            left_errors = validation_errors(problem, [left])[0]
        return _Branch(problem=problem, now=left, errors=left_errors, rounds=rounds)


def _combined(problem: TwinProblem, now: Fitted, found: Round) -> Fitted:
    """The present model with each joint's chosen effect, refitted unless all joints chose the same."""
    one = found.models[found.chosen[0]] if len(set(found.chosen)) == 1 and found.chosen[0] is not None else None
    if one is not None and one.jacobian is not None:
        return replace(one, tried=None)
    model, physical, size = now.model, now.model.to_physical(now.x), now.model.size
    for effect in dict.fromkeys(e for e in found.chosen if e is not None):
        has = torch.tensor([e is effect for e in found.chosen])
        model, physical = exchanged(model, physical, has, [], found.models[effect], effect, size)
    return fit_side_by_side(problem, [Fitted.start(model, physical)], max_iteration=1, keep_jacobian=True)[0]


def _is_same(one: _Branch, two: _Branch) -> bool:
    """Whether two branches end at one model along one reference, so that what was tried on one holds for both."""
    same_effects = one.now.model.effects == two.now.model.effects
    return one.problem is two.problem and same_effects and torch.equal(one.now.x, two.now.x)


def _next_choice(found: Round, unexplained: torch.Tensor) -> Round | None:
    """The round with the effect that came nearest to the best, on unexplained joints that have one."""
    chosen = list(found.chosen)
    for j in unexplained.nonzero()[:, 0].tolist():
        if (best := found.chosen[j]) is not None:
            near = [trial.effect for trial in near_trials(found.trials[j], best) if trial.significant]
            chosen[j] = near[0] if near else best
    return None if chosen == found.chosen else replace(found, chosen=chosen)


def _reach(branch: _Branch, found: Round | None) -> torch.Tensor:
    """Squared validation error of each joint with the best of what could come next, (n,) [rad²]."""
    reach = branch.errors.mse.clone()
    for j, trials in enumerate([] if found is None else found.trials):
        reach[j] = min([float(reach[j]), *(t.mse_after for t in trials if t.significant)])
    return reach
