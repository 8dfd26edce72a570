"""Physical effects of a drive beyond the base model: one small class each, found by name.

:class:`Effect` says how to write one; :func:`available_effects` lists those that come with the package.
"""

from pace_actuators.effects import (
    command,
    conditions,
    drive,
    fading_friction,
    free_form,
    friction,
    measurement,
    model,
    mount,
    transmission,
    two_mass,
)
from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import (
    PROBED_EFFORT,
    PROBED_STIFFNESS,
    Effect,
    EffectParameter,
    comb_grid,
    probe_points,
)
from pace_actuators.effects.effect_cfg import SHARED, WIDE, EffectCfg, effect_cfgs
from pace_actuators.effects.registry import (
    available_effects,
    effect_modules,
    get_effect,
    import_effect,
    register_effect,
    use_recorded_effects,
)
from pace_actuators.effects.stack import EffectStack

__all__ = [
    "PROBED_EFFORT",
    "PROBED_STIFFNESS",
    "SHARED",
    "WIDE",
    "DriveState",
    "Effect",
    "EffectCfg",
    "EffectParameter",
    "EffectStack",
    "available_effects",
    "comb_grid",
    "command",
    "conditions",
    "drive",
    "effect_cfgs",
    "effect_modules",
    "fading_friction",
    "free_form",
    "friction",
    "get_effect",
    "import_effect",
    "measurement",
    "model",
    "mount",
    "probe_points",
    "register_effect",
    "transmission",
    "two_mass",
    "use_recorded_effects",
]
