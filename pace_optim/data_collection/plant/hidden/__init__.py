"""Hidden effects by name: those of the library, and others that no diagnosis can name."""

from . import command, drive, friction, measurement, transmission  # noqa: F401  (they register)
from .effect import EFFECTS, Draw, HiddenEffect, effect_named, hidden, library_effects, outside_effects

__all__ = ["EFFECTS", "Draw", "HiddenEffect", "effect_named", "hidden", "library_effects", "outside_effects"]
