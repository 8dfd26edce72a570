"""Which effects a drive has, on which joints, with which values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pace_actuators.effects.effect import Effect
from pace_actuators.effects.registry import get_effect
from pace_actuators.joint_values import JointValue, match_names

SHARED = "shared"


@dataclass(kw_only=True)
class EffectCfg:
    """An effect of some joints."""

    effect: str
    """Its registered name, or ``module:Class``."""

    joint_names_expr: str | Sequence[str] = ".*"
    """Regular expressions of the joints that have it; the others keep its null values."""

    shared: bool = False
    """Whether identification looks for one value of all those joints."""

    values: Mapping[str, JointValue] = field(default_factory=dict)
    """Values by parameter; one left out is at its null, or at its start if it has none."""

    env_rows: Any = None
    """Slice of the environments that have it; ``None`` for all. For many models side by side in one batch."""

    @classmethod
    def parse(cls, text: str) -> EffectCfg:
        """Read ``name``, ``name@joints`` (a regular expression) or ``name@shared`` (one value for all joints).

        Raises:
            ValueError: If there is no such effect.
        """
        name, at, joints = text.partition("@")
        effect = get_effect(name)
        if at and not joints:
            raise ValueError(f"{text!r} names no joints after '@'. Write {name}@JOINTS or {name}@{SHARED}.")
        shared = effect.shared or joints == SHARED
        return cls(effect=name, joint_names_expr=".*" if shared or not at else joints, shared=shared)

    @property
    def effect_class(self) -> type[Effect]:
        """Its class."""
        return get_effect(self.effect)

    @property
    def label(self) -> str:
        """The text that :meth:`parse` reads."""
        if self.shared:
            return self.effect if self.effect_class.shared else f"{self.effect}@{SHARED}"
        expr = self.joint_names_expr
        text = expr if isinstance(expr, str) else "|".join(expr)
        return self.effect if text == ".*" else f"{self.effect}@{text}"

    def joints(self, joint_names: Sequence[str]) -> list[str]:
        """The joints that have it, in order; none if the expressions match none of these."""
        found = {i for group in match_names(self.joint_names_expr, joint_names) for i in group}
        return [name for i, name in enumerate(joint_names) if i in found]


def effect_cfgs(effects: Sequence[EffectCfg | str]) -> list[EffectCfg]:
    """Configurations of effects given by text or as such.

    Raises:
        ValueError: If one is unknown, or given twice for the same environments.
    """
    cfgs = [EffectCfg.parse(effect) if isinstance(effect, str) else effect for effect in effects]
    names = [(cfg.effect_class.name, str(cfg.env_rows)) for cfg in cfgs]
    repeated = sorted({name for name, rows in names if names.count((name, rows)) > 1})
    if repeated:
        raise ValueError(f"The effect {repeated[0]!r} is named twice. Name it once, with all its joints (NAME@A|B).")
    return cfgs
