"""Effects by name."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from importlib import import_module

from pace_actuators.effects.effect import Effect
from pace_actuators.own_code import (
    CodeRecord,
    import_recorded,
    import_reference,
    is_path,
    loaded_module,
    split_reference,
)

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
        ValueError: If no effect has this name.
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


def import_effect(text: str) -> str:
    """Import the module of an effect that the user names, and return the effect's text, good from any folder.

    Args:
        text: What :meth:`EffectCfg.parse` reads, with ``module:Class`` or ``path/to/file.py:Class`` for the name; a
            registered name is returned as it is.
    """
    name, at, joints = text.partition("@")
    if not split_reference(name)[0]:
        return text
    name = import_reference(name, f"The effect {name!r}")
    get_effect(name)
    return f"{name}{at}{joints}"


def use_recorded_effects(effects: Sequence[str], code: CodeRecord, where: str) -> None:
    """Register the effects that a file names. Custom effects need the file's record of their code.

    Args:
        effects: What :meth:`EffectCfg.parse` reads.
    """
    for text in effects:
        if module := split_reference(text.partition("@")[0])[0]:
            import_recorded(module, code, where, f"--import {module}, or import it before the file is read")


def effect_modules(effects: Sequence[str]) -> list[str]:
    """The modules of custom effects."""
    return [module for text in effects if (module := split_reference(text.partition("@")[0])[0])]


def _imported(name: str) -> type[Effect]:
    module, attribute = split_reference(name)
    try:
        found = loaded_module(module)
        if found is None and is_path(module):
            raise ImportError(f"{module} has not been imported")
        effect = getattr(found or import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"The effect {name!r} cannot be imported ({error}). Correct module:Class, or put the module's folder on "
            "PYTHONPATH."
        ) from None
    if not (isinstance(effect, type) and issubclass(effect, Effect)):
        raise ValueError(f"{name!r} is no effect: expected a subclass of pace_actuators.effects.Effect.")
    return register_effect(effect)
