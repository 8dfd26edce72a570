"""Effects by name."""

from __future__ import annotations

import difflib
from importlib import import_module

from pace_actuators.effects.effect import Effect

_EFFECTS: dict[str, type[Effect]] = {}


def register_effect(effect: type[Effect]) -> type[Effect]:
    """Make an effect known by its name; use it as a class decorator.

    Raises:
        ValueError: If its declaration is wrong, or another effect has its name.
    """
    effect.check()
    known = _EFFECTS.get(effect.name)
    if known is not None and (known.__module__, known.__qualname__) != (effect.__module__, effect.__qualname__):
        raise ValueError(f"An effect named {effect.name!r} is registered already. Choose another name.")
    _EFFECTS[effect.name] = effect
    return effect


def available_effects() -> list[str]:
    """Names of all registered effects, in the order of their registration."""
    return list(_EFFECTS)


def get_effect(name: str) -> type[Effect]:
    """The effect of that name, or the class that ``module:Class`` names (which registers it).

    Raises:
        ValueError: If there is none.
    """
    if ":" in name:
        return _imported(name)
    if name not in _EFFECTS:
        close = difflib.get_close_matches(name, _EFFECTS, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise ValueError(
            f"There is no effect {name!r}.{hint} Available: {', '.join(_EFFECTS)}; or your own as module:Class."
        )
    return _EFFECTS[name]


def _imported(name: str) -> type[Effect]:
    module, _, attribute = name.partition(":")
    try:
        effect = getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"The effect {name!r} cannot be imported ({error}). Correct module:Class, or put the module's folder on "
            "PYTHONPATH."
        ) from None
    if not (isinstance(effect, type) and issubclass(effect, Effect)):
        raise ValueError(f"{name!r} is no effect: expected a subclass of pace_actuators.effects.Effect.")
    return register_effect(effect)
