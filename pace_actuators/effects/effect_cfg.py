"""Which effects a drive has, on which joints, with which values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pace_actuators.effects.effect import Effect
from pace_actuators.effects.registry import get_effect
from pace_actuators.joint_values import JointValue, match_names

SHARED = "shared"
WIDE = "wide"


@dataclass(kw_only=True)
class EffectCfg:
    """An effect of some joints."""

    effect: str
    """Its registered name, or ``module:Class``."""

    joint_names_expr: str | Sequence[str] = ".*"
    """Regular expressions of the joints that have it; the others keep its null values."""

    shared: bool = False
    """Whether identification looks for one value of all those joints."""

    wide: bool = False
    """Whether identification looks for it within bounds as wide as physics allows."""

    values: Mapping[str, JointValue] = field(default_factory=dict)
    """Values by parameter; one left out is at its null, or at its start if it has none."""

    env_rows: Any = None
    """Slice of the environments that have it; ``None`` for all. For many models side by side in one batch."""

    @classmethod
    def parse(cls, text: str) -> EffectCfg:
        """Read ``name``, ``name@joints`` (a regular expression), ``name@shared`` or ``name@joints@shared`` (one value).

        Each may end with ``@wide``, for bounds as wide as physics allows.

        Raises:
            ValueError: If there is no such effect.
        """
        name, *rest = text.split("@")
        effect = get_effect(name)
        wide = rest[-1:] == [WIDE]
        rest = rest[:-1] if wide else rest
        shared = rest[-1:] == [SHARED]
        joints = rest[:-1] if shared else rest
        if len(joints) > 1 or "" in joints:
            raise ValueError(
                f"{text!r} is not understood. Write {name}, {name}@JOINTS, {name}@{SHARED} or {name}@JOINTS@{SHARED}."
            )
        whole = effect.shared or not joints
        expr = ".*" if whole else joints[0]
        return cls(effect=name, joint_names_expr=expr, shared=shared or effect.shared, wide=wide)

    @property
    def effect_class(self) -> type[Effect]:
        """Its class."""
        return get_effect(self.effect)

    @property
    def label(self) -> str:
        """The text that :meth:`parse` reads."""
        expr = self.joint_names_expr
        text = expr if isinstance(expr, str) else "|".join(expr)
        joints = "" if text == ".*" else f"@{text}"
        shared = f"@{SHARED}" if self.shared and not self.effect_class.shared else ""
        return self.effect + joints + shared + (f"@{WIDE}" if self.wide else "")

    def joints(self, joint_names: Sequence[str]) -> list[str]:
        """The joints that have it, in order; none if the expressions match none of these."""
        found = {i for group in match_names(self.joint_names_expr, joint_names) for i in group}
        return [name for i, name in enumerate(joint_names) if i in found]


def effect_cfgs(effects: Sequence[EffectCfg | str]) -> list[EffectCfg]:
    """Configurations of effects given by text or as such."""
    cfgs = [EffectCfg.parse(effect) if isinstance(effect, str) else effect for effect in effects]
    names = [(cfg.effect_class.name, str(cfg.env_rows)) for cfg in cfgs]
    repeated = sorted({name for name, rows in names if names.count((name, rows)) > 1})
    if repeated:
        raise ValueError(f"The effect {repeated[0]!r} is named twice. Name it once, with all its joints (NAME@A|B).")
    return cfgs
