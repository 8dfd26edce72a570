"""Other models of some joints, each fitted and held against the present one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from pace_actuators.effects import Effect
from pace_optim.diagnosis.judging.rules import decide
from pace_optim.diagnosis.search.state import Branch, Search
from pace_optim.single_joint_fits.block_errors import BlockErrors
from pace_optim.single_joint_fits.fitted import Fitted
from pace_optim.single_joint_fits.model import BASE


@dataclass(frozen=True, kw_only=True, eq=False)
class Alternatives:
    """Models with, or without, an effect in which they differ from a branch's own, by that effect."""

    branch: Branch
    joints: Mapping[type[Effect], Sequence[int]]
    """On which joints each was tried; there only it was fitted."""
    models: Mapping[type[Effect], Fitted]
    errors: Mapping[type[Effect], BlockErrors]

    @classmethod
    def fitted(
        cls,
        search: Search,
        branch: Branch,
        starts: Mapping[type[Effect], Fitted],
        joints: Mapping[type[Effect], Sequence[int]],
    ) -> Alternatives:
        """Fit models from where they start, on the joints that each is tried on."""
        which = torch.zeros(branch.now.model.num_joints, dtype=torch.bool)
        which[[j for own in joints.values() for j in own]] = True
        if not starts:
            return cls(branch=branch, joints={}, models={}, errors={})
        models, errors = search.fits.on_joints(branch.problem, list(starts.values()), which, branch.errors)
        by_effect = dict(zip(starts, models, strict=True)), dict(zip(starts, errors, strict=True))
        return cls(branch=branch, joints=joints, models=by_effect[0], errors=by_effect[1])

    @classmethod
    def without(cls, search: Search, branch: Branch, effects: Mapping[type[Effect], torch.Tensor]) -> Alternatives:
        """A branch's model without each of some effects, the rest fitted again; where each is left out, (n,) bool."""
        now, effects = branch.now, {effect: here for effect, here in effects.items() if bool(here.any())}
        starts = {e: Fitted.start(now.model.without_effect(e, here), now.physical, e) for e, here in effects.items()}
        joints = {effect: here.nonzero()[:, 0].tolist() for effect, here in effects.items()}
        return cls.fitted(search, branch, starts, joints)

    def taken(self, search: Search, rule: str, **facts: Any) -> dict[int, type[Effect]]:
        """Which joints take what by a rule."""
        every, names = sorted({j for own in self.joints.values() for j in own}), {e.name: e for e in self.models}
        if not every:
            return {}
        taken = decide(
            rule,
            every,
            self.branch.errors,
            {effect.name: own for effect, own in self.errors.items()},
            {effect.name: own for effect, own in self.joints.items()},
            cfg=search.cfg,
            log=search.log,
            candidates=search.tried_over_joints,
            **facts,
        )
        return {j: names[name] for j, name in taken.items()}

    def with_taken(self, taken: Mapping[int, type[Effect]]) -> Fitted:
        """The branch's model with what joints took."""
        now = self.branch.now
        for j, effect in taken.items():
            now = now.with_joints(torch.arange(len(now.x)) == j, self.models[effect])
        return now


def exchanged(
    now: Fitted, joints: torch.Tensor, old: Sequence[type[Effect]], source: Fitted, effect: type[Effect]
) -> Fitted:
    """A start with an effect in place of others on some joints, and the base parameters that it was fitted with.

    Args:
        now: The present model.
        joints: Which joints, (n,) bool.
        old: Effects that they lose.
        source: A model of all joints with the effect, fitted.
        effect: What they get.
    """
    model, values = now.model, source.physical
    for each in old:
        model = model.without_effect(each, joints)
    model, physical = model.extended(now.physical, effect, joints, values[:, source.model.columns(effect)])
    physical[joints, : len(BASE)] = values[joints, : len(BASE)]
    return Fitted.start(model.structure_held(effect, physical), physical, tried=effect)
