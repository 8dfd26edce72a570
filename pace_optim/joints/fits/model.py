"""A model of each joint alone: base parameters, effects, and where each is free."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch

from pace_actuators.base_parameters import BASE_PARAMETERS
from pace_actuators.effects import PROBED_STIFFNESS, Effect, EffectCfg, EffectParameter
from pace_actuators.joint_units import JointType
from pace_optim.estimate.error_bars.uncertainty import AT_BOUND
from pace_optim.problem.parameter_space import Box
from pace_optim.problem.problem import Problem

BASE = tuple(BASE_PARAMETERS)
"""The base parameters of a joint, in the order of its vector; here each joint has a separate delay."""

COLUMN = {name: column for column, name in enumerate(BASE)}
"""The column of each base parameter in a joint's vector."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JointModel:
    """The parameters of n joints, each with the same P entries: base, then those of effects."""

    effects: tuple[type[Effect], ...]
    """Effects in the order of their entries."""
    has: torch.Tensor
    """Which joint has which effect, (effects, n) bool; a joint without it keeps its null values."""
    lower: torch.Tensor
    """(n, P), physical."""
    upper: torch.Tensor
    """(n, P), physical."""
    log: torch.Tensor
    """Which entries have a logarithmic scale, (P,) bool."""
    slides: torch.Tensor
    """Which joints slide, (n,) bool: effects that mean nothing there are not tried."""
    ranges: torch.Tensor
    """Between which positions each joint moves, (n, 2) [rad]: effects' positions are sought there."""
    efforts: torch.Tensor
    """The largest torque of each joint's drive, (n,) [N m]; infinite where it is not known."""
    loops: torch.Tensor
    """The stiffness of each joint's position loop, (n,) [N m/rad]."""
    barred: Mapping[type[Effect], torch.Tensor] = field(default_factory=dict)
    """Effects that some joints cannot get, (n,) bool."""
    shared: frozenset[type[Effect]] = frozenset()
    """Effects with one value for all joints that have them, beside those that are so by their nature."""

    @classmethod
    def base(cls, problem: Problem) -> JointModel:
        """The base model with the bounds of a problem."""
        space, n, sim2real = problem.space, len(problem.joint_names), problem.env_cfg.sim2real
        lower = [space.lower[space[name]].expand(n) for name in BASE]
        upper = [space.upper[space[name]].expand(n) for name in BASE]
        return cls(
            effects=(),
            has=torch.zeros(0, n, dtype=torch.bool),
            lower=torch.stack(lower, dim=1),
            upper=torch.stack(upper, dim=1),
            log=torch.zeros(len(BASE), dtype=torch.bool),
            slides=torch.tensor([joint in sim2real.slide_joints for joint in problem.joint_names]),
            ranges=torch.tensor(
                [sim2real.joint_ranges.get(joint, (0.0, 0.0)) for joint in problem.joint_names], dtype=torch.float64
            ),
            efforts=torch.tensor(
                [sim2real.joint_efforts.get(joint, math.inf) for joint in problem.joint_names], dtype=torch.float64
            ),
            loops=torch.tensor(
                [sim2real.joint_stiffness.get(joint, PROBED_STIFFNESS) for joint in problem.joint_names],
                dtype=torch.float64,
            ),
        )

    @property
    def size(self) -> int:
        """Entries P of each joint."""
        return len(self.log)

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.lower)

    @property
    def free(self) -> torch.Tensor:
        """Which entries can be fitted, (n, P) bool."""
        result = self.upper > self.lower
        for effect, has in zip(self.effects, self.has, strict=True):
            result[:, self.columns(effect)] &= has[:, None]
        return result

    @property
    def most_free(self) -> int:
        """How many entries can be fitted on the joint that has most of them."""
        return int(self.free.sum(dim=1).max())

    @property
    def names_of_joints(self) -> list[list[str]]:
        """The effects of each joint, by name."""
        return [
            [effect.name for effect, has in zip(self.effects, own, strict=True) if has] for own in self.has.T.tolist()
        ]

    def columns(self, effect: type[Effect]) -> slice:
        """Where an effect's entries are."""
        start = len(BASE)
        for other in self.effects:
            if other is effect:
                break
            start += len(other.parameters)
        return slice(start, start + len(effect.parameters))

    def on_joints(self, joints: torch.Tensor) -> tuple[JointModel, list[int]]:
        """The same of some joints, (n,) bool, with the effects that any of them has; and which entries those are."""
        kept = [row for row, has in enumerate(self.has) if bool(has[joints].any())]
        entries = list(range(len(BASE)))
        for row in kept:
            columns = self.columns(self.effects[row])
            entries += range(columns.start, columns.stop)
        model = replace(
            self,
            effects=tuple(self.effects[row] for row in kept),
            has=self.has[kept][:, joints],
            lower=self.lower[joints][:, entries],
            upper=self.upper[joints][:, entries],
            log=self.log[entries],
            slides=self.slides[joints],
            ranges=self.ranges[joints],
            efforts=self.efforts[joints],
            loops=self.loops[joints],
            barred={effect: barred[joints] for effect, barred in self.barred.items()},
        )
        return model, entries

    def with_joints(self, joints: torch.Tensor, own: JointModel) -> tuple[JointModel, list[int]]:
        """The same with some joints, (n,) bool, as a model of those alone has them; and where its entries are."""
        model = self
        for effect in own.effects:
            model = model.with_effect(effect, torch.zeros_like(joints))
        has, lower, upper = model.has.clone(), model.lower.clone(), model.upper.clone()
        has[:, joints] = False
        entries = list(range(len(BASE)))
        for row, effect in enumerate(own.effects):
            has[model.effects.index(effect), joints] = own.has[row]
            columns = model.columns(effect)
            entries += range(columns.start, columns.stop)
        at = joints.nonzero(), torch.tensor(entries)
        lower[at], upper[at] = own.lower, own.upper
        return replace(model, has=has, lower=lower, upper=upper), entries

    def with_effect(self, effect: type[Effect], joints: torch.Tensor) -> JointModel:
        """The same with an effect on some joints, (n,) bool, beside those that have it already."""
        if effect in self.effects:
            has = self.has.clone()
            has[self.effects.index(effect)] |= joints
            return replace(self, has=has)
        bounds = self._declared(effect)
        return replace(
            self,
            effects=(*self.effects, effect),
            has=torch.cat([self.has, joints[None]]),
            lower=torch.cat([self.lower, bounds[0]], dim=1),
            upper=torch.cat([self.upper, bounds[1]], dim=1),
            log=torch.cat([self.log, torch.tensor([p.scale == "log" for p in effect.parameters])]),
        )

    def without_effect(self, effect: type[Effect], joints: torch.Tensor) -> JointModel:
        """The same without an effect on some joints, (n,) bool; its entries stay."""
        has = self.has.clone()
        has[self.effects.index(effect)] &= ~joints
        return replace(self, has=has)

    def extended(
        self, physical: torch.Tensor, effect: type[Effect], joints: torch.Tensor, values: torch.Tensor
    ) -> tuple[JointModel, torch.Tensor]:
        """The same with an effect on some more joints, and the physical values (n, P) with those of the effect.

        Args:
            joints: Which joints get it, (n,) bool.
            values: Of the effect, (n, parameters).
        """
        model, columns = self.with_effect(effect, joints), self.columns(effect)
        if effect not in self.effects:
            physical = torch.cat([physical, values], dim=1)
        else:
            physical = physical.clone()
            physical[joints, columns] = values[joints]
        lower, upper = model.lower.clone(), model.upper.clone()
        # what was held for a joint's old values is not held for its new ones
        declared = [each[joints] for each in model._declared(effect)]
        for k, p in enumerate(effect.parameters):
            column, (low, high) = columns.start + k, (each[:, k] for each in declared)
            own, (least, most) = physical[joints, column], model._widest(p, joints)
            lower[joints, column] = torch.where(own < low, least, low)
            upper[joints, column] = torch.where(own > high, most, high)
        return replace(model, lower=lower, upper=upper), physical

    def widened(self, effect: type[Effect], joints: torch.Tensor) -> JointModel:
        """The same with an effect's bounds as wide as physics allows on some joints, (n,) bool."""
        lower, upper = self.lower.clone(), self.upper.clone()
        for column, parameter in enumerate(effect.parameters, start=self.columns(effect).start):
            lower[joints, column], upper[joints, column] = self._widest(parameter, joints)
        return replace(self, lower=lower, upper=upper)

    def _declared(self, effect: type[Effect]) -> tuple[torch.Tensor, torch.Tensor]:
        """The bounds of an effect on each joint, as it declares them, (n, parameters) each."""
        places = zip(self.loops.tolist(), *self.ranges.T.tolist(), self.efforts.tolist(), strict=True)
        bounds = [[p.on_loop(loop).reaching(*place) for p in effect.parameters] for loop, *place in places]
        own = torch.tensor(bounds, dtype=torch.float64).reshape(self.num_joints, -1, 2)
        return own[..., 0], own[..., 1]

    def _widest(self, parameter: EffectParameter, joints: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The widest bounds of an effect's parameter on some joints, (n,) bool; physical, one for each of them."""
        friction = self.upper[joints, COLUMN["friction"]].tolist()
        each = [parameter.on_loop(loop) for loop in self.loops[joints].tolist()]
        widest = [p.widest(level) for p, level in zip(each, friction, strict=True)]
        places = zip(each, *self.ranges[joints].T.tolist(), self.efforts[joints].tolist(), strict=True)
        reaches = [p.reaching(*place) for p, *place in places]
        bounds, own = (torch.tensor(values, dtype=torch.float64).reshape(-1, 2) for values in (widest, reaches))
        return torch.minimum(bounds[:, 0], own[:, 0]), torch.maximum(bounds[:, 1], own[:, 1])

    def is_wide(self, effect: type[Effect]) -> torch.Tensor:
        """Joints on which an effect's bounds are wider than it declares them, (n,) bool."""
        columns, has = self.columns(effect), self.has[self.effects.index(effect)]
        least, most = self._declared(effect)
        return has & ((self.lower[:, columns] < least) | (self.upper[:, columns] > most)).any(dim=1)

    def structure_held(self, effect: type[Effect], physical: torch.Tensor) -> JointModel:
        """Fix the discrete parameter of an effect: it cannot be optimized by gradients."""
        if not effect.structural:
            return self
        return self.held(effect, [effect.structural], physical)

    def held(self, effect: type[Effect], names: Sequence[str], physical: torch.Tensor) -> JointModel:
        """The same with parameters of an effect held where they are, on the joints that have it.

        Args:
            names: Its parameters.
        """
        has, start = self.has[self.effects.index(effect)], self.columns(effect).start
        lower, upper = self.lower.clone(), self.upper.clone()
        for column, parameter in enumerate(effect.parameters, start=start):
            if parameter.name in names:
                lower[has, column] = upper[has, column] = physical[has, column]
        return replace(self, lower=lower, upper=upper)

    def allowed_joints(self, effect: type[Effect]) -> torch.Tensor:
        """Joints that can have an effect beside those that they have, (n,) bool; only one can part motor and link."""
        excluded = self.barred.get(effect, torch.zeros(self.num_joints, dtype=torch.bool)).clone()
        for other, has in zip(self.effects, self.has, strict=True):
            if other is effect or (other.parts_motor_and_link and effect.parts_motor_and_link):
                excluded |= has
        for joint_type, those in (("slide", self.slides), ("hinge", ~self.slides)):
            if joint_type not in effect.joint_types:
                excluded |= those
        return ~excluded

    def joint_type(self, joint: int) -> JointType:
        """Whether a joint turns or slides."""
        return "slide" if bool(self.slides[joint]) else "hinge"

    def at_bounds(self, x: torch.Tensor, moves: torch.Tensor | None = None) -> torch.Tensor:
        """Entries of effects that have run into a bound, (n, P) bool.

        A bound that is the null, or next to an infinite one, does not count; nor does one of a parameter that shapes an
        effect (it has no null) where the parameter moves nothing.

        Args:
            moves: Which entries move their joint, (n, P) bool; ``None``: not known, and only sizes count.
        """
        result = torch.zeros_like(x, dtype=torch.bool)
        low, high = x < AT_BOUND - 1, x > 1 - AT_BOUND
        for effect, has in zip(self.effects, self.has, strict=True):
            for column, parameter in enumerate(effect.parameters, start=self.columns(effect).start):
                if parameter.null is None:
                    stuck = torch.zeros_like(has) if moves is None else (low | high)[:, column] & moves[:, column]
                else:
                    stuck = low[:, column] & (parameter.null > parameter.lower)
                    stuck = stuck | (high[:, column] & (parameter.null < parameter.upper))
                result[:, column] = has & stuck
        return result & self.free

    def has_at_bounds(self, x: torch.Tensor, moves: torch.Tensor | None = None) -> torch.Tensor:
        """Joints with an effect that has run into a bound, (effects, n) bool; arguments as for :meth:`at_bounds`."""
        stuck = self.at_bounds(x, moves)
        own = [stuck[:, self.columns(effect)].any(dim=1) for effect in self.effects]
        return torch.stack(own) if own else torch.zeros_like(self.has)

    def implausible(self, physical: torch.Tensor) -> torch.Tensor:
        """Joints with an effect of a value that no drive has, (effects, n) bool, of physical values (n, P)."""
        result = torch.zeros_like(self.has)
        for row, (effect, has) in enumerate(zip(self.effects, self.has, strict=True)):
            for column, parameter in enumerate(effect.parameters, start=self.columns(effect).start):
                result[row] |= has & ~parameter.is_plausible(physical[:, column])
        return result

    def at_point(self, effect: type[Effect], values: Mapping[str, float]) -> torch.Tensor:
        """Physical entries of an effect at one of its points on each joint, (n, parameters), inside their bounds."""
        follows = torch.tensor([p.follows_loop for p in effect.parameters])
        sizes = (self.loops / PROBED_STIFFNESS)[:, None]
        return start_values(effect, values) * torch.where(follows, sizes, 1.0)

    @property
    def box(self) -> Box:
        """Bounds and scales."""
        return Box(self.lower, self.upper, self.log)

    def to_physical(self, x: torch.Tensor) -> torch.Tensor:
        """Physical values of normalised ones (…, n, P)."""
        return self.box.to_physical(x)

    def to_normalised(self, physical: torch.Tensor) -> torch.Tensor:
        """Normalised values of physical ones (…, n, P); 0 where the bounds are equal."""
        return self.box.to_normalised(physical).clamp(-1.0, 1.0)


def start_values(effect: type[Effect], values: Mapping[str, float]) -> torch.Tensor:
    """Physical entries of an effect, (parameters,), inside their bounds."""
    return torch.tensor(
        [min(max(values.get(p.name, p.start), p.lower), p.upper) for p in effect.parameters], dtype=torch.float64
    )


def whole_values(model: JointModel, x: torch.Tensor, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Normalised values (n, P) as the parameters of the whole robot; the delay is the joints' median."""
    physical = model.to_physical(x)
    values: dict[str, dict[str, float]] = {}
    for k, name in enumerate(BASE):
        column = physical[:, k]
        values[name] = (
            {"all": float(column.median())} if name == "delay" else dict(zip(names, column.tolist(), strict=True))
        )
    for effect, has in zip(model.effects, model.has, strict=True):
        if not bool(has.any()):
            continue
        own = physical[:, model.columns(effect)]
        for k, parameter in enumerate(effect.parameters):
            key = f"{effect.name}.{parameter.name}"
            if effect.shared or effect in model.shared:
                values[key] = {"all": float(own[has][:, k].median())}
            else:
                values[key] = {n: float(own[j, k]) for j, n in enumerate(names) if bool(has[j])}
    return values


def found_effects(model: JointModel, joint_names: Sequence[str], order: Sequence[type[Effect]] = ()) -> list[EffectCfg]:
    """The effects that joints have.

    Args:
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
