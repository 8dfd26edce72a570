"""Where a descent begins with an effect whose error has a valley for every period of its frequency."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pace_actuators.effects import EffectCfg, comb_grid
from pace_optim.problem.evaluator import Evaluator
from pace_optim.problem.parameter_space import ParameterSpace

_RIDGE = 1e-9


def scanned(
    space: ParameterSpace, evaluator: Evaluator, x: torch.Tensor, effects: Sequence[EffectCfg], joints: Sequence[str]
) -> torch.Tensor | None:
    """A vector with the frequencies that explain most of what it leaves; ``None`` without such effects.

    At every frequency of a grid the error e is regressed on what a sine and a cosine change, joint by joint: the
    amplitudes follow from the best one. All joints are moved at once: what one of them does to another counts little.
    """
    result = None
    for cfg in (each for each in effects if each.effect_class.comb is not None):
        comb = cfg.effect_class.comb
        assert comb is not None
        frequency, *amplitudes = (space[f"{cfg.effect_class.name}.{name}"] for name in comb)
        keys = cfg.joints(joints)
        places = torch.tensor([joints.index(joint) for joint in keys])
        physical = space.to_physical(x if result is None else result)
        for each in amplitudes:
            physical[each] = 0.0
        error = evaluator.residuals(physical[None]).error[0][..., places]
        data = evaluator.dataset
        seen = data.measured[data.train][:, places]
        grid = comb_grid(cfg.effect_class, float((seen.amax(dim=0) - seen.amin(dim=0)).max()))
        small = next(p.start for p in cfg.effect_class.parameters if p.name == comb[1])
        rows = physical.repeat(len(grid), 2, 1)
        rows[..., frequency] = grid[:, None, None]
        for k, each in enumerate(amplitudes):
            rows[:, k, each] = small
        errors = evaluator.residuals(rows.flatten(0, 1)).error[..., places].unflatten(0, (len(grid), 2))
        shape = (len(grid), 2, -1, len(keys))
        columns = ((errors - error) / small).reshape(shape)
        gram = torch.einsum("gpkj,gqkj->gjpq", columns, columns)
        moment = torch.einsum("gpkj,kj->gjp", columns, error.reshape(-1, len(keys)))
        if len(physical[frequency]) < len(keys):  # one value for all
            gram, moment = gram.sum(dim=1, keepdim=True), moment.sum(dim=1, keepdim=True)
        ridge = _RIDGE * gram.diagonal(dim1=-2, dim2=-1).mean(dim=-1)[..., None, None] * torch.eye(2).to(gram)
        size = torch.linalg.solve(gram + ridge + 1e-300 * torch.eye(2).to(gram), moment)
        best = (size * moment).sum(dim=-1).argmax(dim=0)
        physical[frequency] = grid[best]
        for k, each in enumerate(amplitudes):
            physical[each] = -size[best, torch.arange(len(best)), k]
        result = space.to_normalised(physical).clamp(-1.0, 1.0)
    return result
