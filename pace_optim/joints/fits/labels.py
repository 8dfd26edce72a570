"""The effects of a model as configurations, and in the words of the command line."""

from __future__ import annotations

from collections.abc import Sequence

from pace_actuators.effects import Effect, EffectCfg
from pace_optim.joints.fits.model import JointModel


def found_effects(model: JointModel, joint_names: Sequence[str], order: Sequence[type[Effect]] = ()) -> list[EffectCfg]:
    """The effects that joints have.

    Args:
        model: The model that has them.
        joint_names: Its joints.
        order: Which comes first; none keeps the model's order.
    """
    result = []
    for effect in order or model.effects:
        has = model.has[model.effects.index(effect)]
        own = [name for name, yes in zip(joint_names, has.tolist(), strict=True) if yes]
        if not own:
            continue
        everywhere = len(own) == len(joint_names)
        cfg = EffectCfg(
            effect=effect.name,
            joint_names_expr=".*" if effect.shared or everywhere else "|".join(own),
            shared=effect.shared or effect in model.shared,
            wide=bool(model.is_wide(effect).any()),
        )
        result.append(cfg)
    return result


def labels(model: JointModel, joint_names: Sequence[str], order: Sequence[type[Effect]] = ()) -> list[str]:
    """The same as ``fit.py --effects`` takes them."""
    return [cfg.label for cfg in found_effects(model, joint_names, order)]
