"""An effect on a link is judged by what it does to all joints that carry the link."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.search.one_round import round_of
from pace_optim.diagnosis.search.state import Branch, Search
from pace_optim.diagnosis.selection.candidate_results import Round, Trial
from pace_optim.joints.fits.block_errors import BlockErrors


def judged_over_trees(search: Search, end: Branch, choosing: Callable[[Round], Branch]) -> Branch:
    """The branch with what joints take when what it does to the other joints of their trees counts too.

    Other joints carry a joint's link too, and a joint simulated alone does not show that. So an effect on the link that
    is the best, or a rival of the best, is judged again, and so is the best effect that is not on the link. Each is
    judged along the robot's motion with it, against the robot without. The joint's squared error is multiplied by the
    factor of the other joints' squared errors.

    Args:
        search: What is looked for.
        end: The branch with what its last round has chosen.
        choosing: Gives the branch with that round, if it chooses otherwise.
    """
    for joints in _with_effect_on_link(search, end.rounds[-1]):
        end = _judged(search, end, choosing, joints)
    return end


def _with_effect_on_link(search: Search, found: Round) -> Iterator[list[int]]:
    """Joints that may have an effect on a link that others carry too: of each tree one, until all have been."""
    trees = [[j for j in tree if any(map(_on_link, _best(found, j)))] for tree in search.trees if len(tree) > 1]
    for place in range(max(map(len, trees), default=0)):
        yield [tree[place] for tree in trees if place < len(tree)]


def _on_link(effect: type[Effect]) -> bool:
    return effect.overrides("write_model")


def _judged(search: Search, end: Branch, choosing: Callable[[Round], Branch], joints: Sequence[int]) -> Branch:
    """The branch with what some joints take, no two of one tree, when the other joints of their trees count too."""
    found = end.rounds[-1]

    def with_choice(chosen: Mapping[int, type[Effect] | None]) -> Branch:
        this = replace(found, chosen=[chosen.get(j, effect) for j, effect in enumerate(found.chosen)])
        return end if this.chosen == list(found.chosen) else choosing(this)

    trials = [_options(found, j) if j in joints else [] for j in range(len(found.chosen))]
    without = with_choice(dict.fromkeys(joints))
    ways: list[Branch] = []
    after: dict[type[Effect], BlockErrors] = {}
    for k in range(max(map(len, trials))):
        effects = {j: trials[j][k].effect if k < len(trials[j]) else None for j in joints}
        ways.append(with_choice(effects))
        for j, effect in effects.items():
            if effect is not None:
                errors = _over_tree(search, ways[-1].errors, without.errors, j)
                here = torch.arange(len(trials)) == j
                after[effect] = after.get(effect, errors).with_joints(here, errors)
    depth = len(end.rounds)
    again = round_of(search, trials, without.errors, after, depth == 1, effect=depth)
    merged = [again if j in joints else found for j in range(len(trials))]
    taken = replace(
        found,
        trials=[_beside(own, every) for own, every in zip(again.trials, found.trials, strict=True)],
        chosen=[this.chosen[j] for j, this in enumerate(merged)],
        rivals=[[*this.rivals[j], *_other_rivals(found, this, j)] for j, this in enumerate(merged)],
    )
    same = (way for way in (*ways, without) if list(way.rounds[-1].chosen) == taken.chosen)
    branch = next(same, None) or choosing(taken)
    return replace(branch, rounds=(*branch.rounds[:-1], taken))


def _best(found: Round, joint: int) -> list[type[Effect]]:
    """What a joint has chosen, and its rivals."""
    return [effect for effect in (found.chosen[joint], *found.rivals[joint]) if effect is not None]


def _options(found: Round, joint: int) -> list[Trial]:
    """What a joint could take: of the best those on its link, and the best one that is not."""
    best, pay = _best(found, joint), [trial for trial in found.trials[joint] if trial.significant]
    others = [*best, *(trial.effect for trial in pay if not trial.effect.shared)]
    options = [*filter(_on_link, best), *[effect for effect in others if not _on_link(effect)][:1]]
    return [trial for trial in pay if trial.effect in options]


def _other_rivals(found: Round, again: Round, joint: int) -> list[type[Effect]]:
    """Rivals of an effect that is not on the link: those not judged again, and those on the link that pay there too.

    What a mass does to other joints depends on where it sits, which its own joint does not show.
    """
    chosen, trials = again.chosen[joint], again.trials[joint]
    if again is found or chosen is None or _on_link(chosen):
        return []
    refuted = [trial.effect for trial in trials if not trial.significant or trial.effect in again.rivals[joint]]
    return [effect for effect in _best(found, joint) if effect is not chosen and effect not in refuted]


def _over_tree(search: Search, errors: BlockErrors, without: BlockErrors, joint: int) -> BlockErrors:
    """Errors in which those of a joint count what an effect of its does to the others of its tree.

    Near the floor nothing can be compared.
    """
    others = [j for tree in search.trees for j in tree if joint in tree and j != joint]
    least = search.at_floor[others] ** 2
    times = (errors.mse[others].clamp(min=least) / without.mse[others].clamp(min=least)).prod()
    square = errors.square.clone()
    square[:, joint] *= times
    return replace(errors, square=square)


def _beside(own: Sequence[Trial], every: Sequence[Trial]) -> Sequence[Trial]:
    """All trials of a joint, some of them judged again, best first."""
    effects = [trial.effect for trial in own]
    both = [*own, *(trial for trial in every if trial.effect not in effects)]
    return sorted(both, key=lambda trial: trial.mse_after)
