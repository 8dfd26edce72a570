"""Adding effects one after another, each joint by itself, as long as they pay on validation recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.judging.acceptance import BlockErrors
from pace_optim.diagnosis.judging.candidate_results import FAR, Round, Trial, near_trials
from pace_optim.diagnosis.judging.size_consistency import unevenness
from pace_optim.diagnosis.judging.validation import validation_errors
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.diagnosis.search.pruning import Without
from pace_optim.diagnosis.search.steps import Branch, Steps, combined
from pace_optim.single_joint_model.problem import TwinProblem


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
    steps = Steps(effects=effects, effort=effort, floor=floor, max_effects=max_effects, say=say, follow=follow)
    errors = validation_errors(problem, [base])[0]
    branch = Branch(problem=problem, now=base, errors=errors, rounds=[])
    found = steps.tried(branch)
    while found is not None:
        together = _at_once(steps, branch, found)
        if together is not None:
            branch, found = together, steps.tried(together)
        elif any(effect is not None for effect in found.chosen):
            branch, found = _led_on(steps, branch, found)
        elif (guessed := _guessed(steps, branch, found)) is not None:
            branch, found = guessed, steps.tried(guessed)
        else:
            break
    branch = steps.simplified(branch)
    return Outcome(
        problem=branch.problem,
        base=base,
        base_errors=errors,
        final=branch.now,
        final_errors=branch.errors,
        unevenness=unevenness(branch.now),
        rounds=[*branch.rounds, *([] if found is None else [found])],
    )


def _at_once(steps: Steps, branch: Branch, found: Round) -> Branch | None:
    """The branch with an effect of other joints on those far from the floor; ``None`` if it does not pay on each.

    Neighbours that all lack the same hide it from each other: while one joint is tried, the others move wrongly. So
    they are judged together, along the motion that the robot then has.
    """
    far = branch.errors.mse.sqrt() > FAR * steps.floor
    lacking = [j for j in far.nonzero()[:, 0].tolist() if found.chosen[j] is None]
    in_use = [e for e, has in zip(branch.now.model.effects, branch.now.model.has, strict=True) if bool(has.any())]
    in_use.sort(key=branch.fall_with, reverse=True)
    for effect in [e for e in in_use if e in found.models and not e.shared]:
        joints = [j for j in lacking if any(t.effect is effect for t in found.trials[j])]
        while joints:
            steps.say(f"trying {effect.name} on {len(joints)} more joint{'' if len(joints) == 1 else 's'} at once")
            chosen = [effect if j in joints else old for j, old in enumerate(found.chosen)]
            grown = steps.grown(branch, found.choosing(chosen))
            trials = _judged_again(steps, effect, joints, found, grown)
            if all(trial.significant for trial in trials.values()):
                return replace(grown, rounds=[*grown.rounds[:-1], grown.rounds[-1].with_trials(trials)])
            joints = [j for j, trial in trials.items() if trial.significant]
    return None


def _guessed(steps: Steps, branch: Branch, found: Round) -> Branch | None:
    """The branch two rounds on, by effects that are likely only; ``None`` if they do not pay beside the next ones.

    Where several effects of a size are missing, what one of them brings is uneven: the others cover it here and there.
    """
    far = branch.errors.mse.sqrt() > FAR * steps.floor
    likely = [next((t.effect for t in own if t.likely), None) for own in found.trials]
    guesses = [effect if yes else None for effect, yes in zip(likely, far.tolist(), strict=True)]
    if not any(guesses) or len(branch.rounds) + 2 > steps.max_effects:
        return None
    wanted = list(dict.fromkeys(effect for effect in guesses if effect is not None))
    steps.say(f"looking beyond what is likely: {', '.join(effect.name for effect in wanted)}")
    one = steps.grown(branch, found.choosing(guesses))
    ahead = steps.tried(one)
    if ahead is None or not any(ahead.chosen):
        return None
    two = steps.grown(one, ahead)
    trials: dict[int, Trial] = {}
    for effect in wanted:
        joints = [j for j, guess in enumerate(guesses) if guess is effect]
        if effect not in two.now.model.effects:  # another has taken its place
            return None
        trials |= _judged_again(steps, effect, joints, found, two)
    if not all(trial.significant for trial in trials.values()):
        return None
    at = len(branch.rounds)
    return replace(two, rounds=[*two.rounds[:at], two.rounds[at].with_trials(trials), *two.rounds[at + 1 :]])


def _judged_again(
    steps: Steps, effect: type[Effect], joints: Sequence[int], found: Round, grown: Branch
) -> dict[int, Trial]:
    """What an effect brings each of several joints, held against them without it along the same motion."""
    model = grown.now.model
    here = torch.zeros(model.num_joints, dtype=torch.bool)
    here[list(joints)] = True
    has = model.has[model.effects.index(effect)]
    without = Without(grown.problem, grown.now, grown.errors, {effect: here & has}).errors
    before = without.get(effect, grown.errors)  # nothing is gained where it is not there any more
    trials = {j: next(t for t in found.trials[j] if t.effect is effect) for j in joints}
    return {j: trial.judged(before, grown.errors, steps.tried_over_joints, first=False) for j, trial in trials.items()}


def _led_on(steps: Steps, branch: Branch, found: Round) -> tuple[Branch, Round | None]:
    """The branch with the effects that lead furthest, and what could come next.

    The best effect of the first round may stand in for two others, each of which is worse alone. Where it leaves
    much unexplained, the next one of each joint leads on for a round too, and is taken if it ends lower, or as low with
    fewer numbers: the others that are missing give much to whatever has numbers to spare.
    """
    first = steps.grown(branch, found)
    ahead = steps.tried(first)
    ends, enough = first.ends(ahead), (FAR * steps.floor) ** 2
    unexplained = (first.errors.mse > enough) & (torch.tensor([end.mse for end in ends]) > enough)
    other = _next_choice(found, unexplained)
    if branch.rounds or ahead is None or other is None:
        return first, ahead
    steps.say(f"looking ahead with {', '.join(dict.fromkeys(e.name for e in other.chosen if e is not None))}")
    # along the present reference, which is near enough for a look
    now, errors = steps.settled(branch.problem, combined(branch.problem, branch.now, other))
    way = Branch(problem=branch.problem, now=now, errors=errors, rounds=[other])
    beyond = steps.tried(way)
    others = zip(way.ends(beyond), ends, unexplained.tolist(), strict=True)
    better = [yes and end.beats(one) for end, one, yes in others]
    if not any(better):
        return first, ahead
    chosen = [two if yes else one for one, two, yes in zip(found.chosen, other.chosen, better, strict=True)]
    taken = steps.grown(branch, found.choosing(chosen))
    return taken, beyond if _is_same(taken, way) else steps.tried(taken)


def _is_same(one: Branch, two: Branch) -> bool:
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
    return None if chosen == found.chosen else found.choosing(chosen)
