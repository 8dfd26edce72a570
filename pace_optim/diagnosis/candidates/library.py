"""Which effects a diagnosis tries."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from pace_actuators.effects import Effect, available_effects, get_effect


def candidate_effects(
    extra: Sequence[str] = (), *, only: bool = False, switched_off: bool = True
) -> list[type[Effect]]:
    """What is tried: all registered effects but curves of any form, and the user's; or only those.

    Args:
        extra: The user's.
        only: Whether only those are tried.
        switched_off: Whether a recording has its drives switched off, so that effects of that show.

    Raises:
        ValueError: If the user names a curve.
    """
    own = [get_effect(name) for name in extra]
    curves = [name for name, effect in zip(extra, own, strict=True) if effect.free_form]
    if curves:
        raise ValueError(
            f"{curves[0]} is a free-form curve, which every diagnosis compares with its effects. "
            f"Omit it, or fit it: scripts/fit.py --effects {shlex.quote(curves[0])}."
        )
    every = [] if only else [get_effect(name) for name in available_effects()]
    every = [effect for effect in every if switched_off or not effect.acts_while_off]
    return list(dict.fromkeys([*(e for e in every if not e.free_form), *own]))
