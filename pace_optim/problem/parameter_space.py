"""The vector that is searched: parameters by name, their bounds and their normalised coordinates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch

from pace_envs.tasks.pace import (
    GLOBAL,
    PaceCfg,
    Parameter,
    base_parameters,
    effect_parameters,
    link_parameters,
    torque_parameters,
)

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv


@dataclass(frozen=True, eq=False)
class Box:
    """Normalised coordinates, which run from -1 to 1 between the bounds.

    physical = lower + (x + 1)/2 (upper - lower)              linear scale
    physical = exp(log lower + (x + 1)/2 (log upper - log lower))   logarithmic scale
    """

    lower: torch.Tensor
    """(…, size), physical."""
    upper: torch.Tensor
    """(…, size), physical."""
    log: torch.Tensor
    """Which entries have a logarithmic scale, (size,) bool."""

    def to_physical(self, x: torch.Tensor) -> torch.Tensor:
        """Physical values of normalised ones (…, size)."""
        low, width = self._low_and_width()
        value = low + (x + 1) / 2 * width
        return torch.where(self.log, value.exp(), value).clamp(self.lower, self.upper)

    def to_normalised(self, physical: torch.Tensor) -> torch.Tensor:
        """Normalised values of physical ones (…, size); entries whose bounds are equal become 0."""
        low, width = self._low_and_width()
        value = torch.where(self.log, physical.clamp(min=1e-300).log(), physical)
        return torch.where(width > 0, (value - low) / width.clamp(min=1e-300) * 2 - 1, 0.0)

    def slope(self, x: torch.Tensor) -> torch.Tensor:
        """D physical / d x at normalised values (…, size)."""
        half_width = self._low_and_width()[1] / 2
        return torch.where(self.log, self.to_physical(x) * half_width, half_width)

    def _low_and_width(self) -> tuple[torch.Tensor, torch.Tensor]:
        low, high = (torch.where(self.log, bound.clamp(min=1e-300).log(), bound) for bound in (self.lower, self.upper))
        return low, high - low


_SPANS = 1e-3
"""Part of the upper bound up to which a lower one leaves the magnitude open."""
_SMALLEST = 1e-4
"""Part of the upper bound that stands for none on a logarithmic scale."""


class ParameterSpace:
    """Lays parameters out in one vector, in order, one entry per key; the optimizer's coordinates are a `Box`'s."""

    def __init__(self, parameters: Sequence[Parameter]):
        """Lay out the vector.

        Raises:
            ValueError: If two parameters have the same name.
        """
        names = [parameter.name for parameter in parameters]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(f"The parameter {repeated[0]!r} is declared twice. Give each another name.")
        self.parameters = tuple(parameters)
        self.slices: dict[str, slice] = {}
        start = 0
        for parameter in parameters:
            self.slices[parameter.name] = slice(start, start + len(parameter.keys))
            start += len(parameter.keys)
        self.size = start
        self.lower = torch.tensor([v for p in parameters for v in p.lower], dtype=torch.float64)
        self.upper = torch.tensor([v for p in parameters for v in p.upper], dtype=torch.float64)
        self.labels = tuple(f"{p.name}/{key}" for p in parameters for key in p.keys)
        self.is_logarithmic = torch.tensor([p.scale == "log" for p in parameters for _ in p.keys])
        self.moves = torch.tensor([p.moves for p in parameters for _ in p.keys])
        """Which entries change how the robot moves, (size,) bool."""
        self._box = Box(self.lower, self.upper, self.is_logarithmic)
        self.prior = torch.tensor(
            [float("inf") if p.prior is None else p.prior for p in parameters for _ in p.keys], dtype=torch.float64
        )
        """Standard deviation of each entry's prior around 0, normalised, (size,); infinite without a prior."""

    @classmethod
    def of(cls, cfg: PaceCfg) -> ParameterSpace:
        """The space of a robot's configuration: base parameters, those of effects, links, sensors, and the user's."""
        of_parts = effect_parameters(cfg), link_parameters(cfg), torque_parameters(cfg)
        return cls((*base_parameters(cfg), *(each for part in of_parts for each in part), *cfg.extra_parameters))

    def by_magnitude(self) -> ParameterSpace:
        """The same entries, on a logarithmic scale where no value is negative and the bounds span magnitudes.

        Armatures and frictions are a small part of their bounds, and a search in parts of the bounds passes over them.
        """
        parameters = []
        for p in self.parameters:
            free = [(low, high) for low, high in zip(p.lower, p.upper, strict=True) if high > low]
            if p.scale == "linear" and free and all(0 <= low <= _SPANS * high for low, high in free):
                lower = tuple(
                    max(low, _SMALLEST * high) if high > low else low
                    for low, high in zip(p.lower, p.upper, strict=True)
                )
                p = replace(p, lower=lower, scale="log", start=None)
            parameters.append(p)
        return ParameterSpace(parameters)

    def holding(self, labels: Sequence[str], physical: torch.Tensor) -> ParameterSpace:
        """The same with some entries held at the values of a physical vector (size,)."""
        held, values = set(labels), physical.tolist()
        parameters = []
        for p in self.parameters:
            own = values[self.slices[p.name]]
            at = [f"{p.name}/{key}" in held for key in p.keys]
            lower = tuple(v if yes else low for v, yes, low in zip(own, at, p.lower, strict=True))
            upper = tuple(v if yes else high for v, yes, high in zip(own, at, p.upper, strict=True))
            start = p.start
            if start is not None:
                stated = start if isinstance(start, tuple) else (start,) * len(p.keys)
                start = tuple(v if yes else s for v, yes, s in zip(own, at, stated, strict=True))
            parameters.append(replace(p, lower=lower, upper=upper, start=start))
        return ParameterSpace(parameters)

    @property
    def start(self) -> torch.Tensor:
        """The normalised vector where a search starts, (size,): the middle, or where a parameter says."""
        x = torch.zeros(self.size, dtype=torch.float64)
        for parameter in self.parameters:
            if parameter.start is not None:
                here = self.slices[parameter.name]
                physical = self.to_physical(x)
                physical[here] = torch.as_tensor(parameter.start, dtype=physical.dtype)
                x[here] = self.to_normalised(physical)[here]
        return x

    @property
    def units(self) -> dict[str, str | dict[str, str]]:
        """Unit of each parameter, by name; where hinges and slides have it, the unit of each key."""
        result: dict[str, str | dict[str, str]] = {}
        for p in self.parameters:
            each = {key: p.unit_of(key) for key in p.keys}
            alike = set(each.values())
            result[p.name] = alike.pop() if len(alike) == 1 else each or p.unit
        return result

    def unit_of(self, name: str, key: str) -> str:
        """Unit of a parameter of a joint, or of all (``"all"``)."""
        return next(p for p in self.parameters if p.name == name).unit_of(key)

    def __getitem__(self, name: str) -> slice:
        """Where a parameter's entries are."""
        if name not in self.slices:
            raise KeyError(f"There is no parameter {name!r}. Available: {', '.join(self.slices)}.")
        return self.slices[name]

    def to_physical(self, x: torch.Tensor) -> torch.Tensor:
        """Physical values of normalised vectors (…, size)."""
        return self._box.to_physical(x)

    def to_normalised(self, physical: torch.Tensor) -> torch.Tensor:
        """Normalised vectors of physical values (…, size); entries whose bounds are equal become 0."""
        return self._box.to_normalised(physical)

    def slope(self, x: torch.Tensor) -> torch.Tensor:
        """D physical / d x at normalised vectors (…, size)."""
        return self._box.slope(x)

    def to_dict(self, physical: torch.Tensor) -> dict[str, dict[str, float]]:
        """One vector (size,) as {parameter: {key: value}}."""
        values = physical.tolist()
        return {p.name: dict(zip(p.keys, values[self.slices[p.name]], strict=True)) for p in self.parameters}

    def from_dict(self, values: Mapping[str, float | Mapping[str, float]]) -> torch.Tensor:
        """The vector (size,) of {parameter: value or {key: value}}.

        Raises:
            ValueError: If a parameter or key is missing or unknown.
        """
        unknown = sorted(set(values) - set(self.slices))
        missing = [name for name in self.slices if name not in values]
        if unknown or missing:
            wrong = f"unknown: {', '.join(unknown)}" if unknown else f"missing: {', '.join(missing)}"
            raise ValueError(f"The parameters do not fit ({wrong}). Expected: {', '.join(self.slices)}.")
        entries: list[float] = []
        for parameter in self.parameters:
            value = values[parameter.name]
            if isinstance(value, Mapping):
                if set(value) != set(parameter.keys):
                    raise ValueError(
                        f"{parameter.name} has values for {', '.join(value)}, expected {', '.join(parameter.keys)}."
                    )
                entries += [float(value[key]) for key in parameter.keys]
            else:
                entries += [float(value)] * len(parameter.keys)
        return torch.tensor(entries, dtype=torch.float64)

    def apply(
        self,
        env: ManagerBasedEnv,
        physical: torch.Tensor,
        per_joint: Mapping[str, torch.Tensor] | None = None,
    ) -> None:
        """Write one vector per environment to the simulation and its drives.

        Args:
            per_joint: Values per joint of shared parameters, {name: (num_envs, n)}.
        """
        for parameter in self.parameters:
            values = (per_joint or {}).get(parameter.name)
            parameter.apply(env, physical[:, self.slices[parameter.name]] if values is None else values)

    def owners(self, trees: Sequence[Sequence[str]]) -> list[int | None]:
        """For each entry, which group of joints it influences; ``None`` for entries that all share.

        Args:
            trees: Groups of joint names.
        """
        tree_of = {joint: t for t, joints in enumerate(trees) for joint in joints}
        return [None if key == GLOBAL else tree_of[key] for p in self.parameters for key in p.joints or p.keys]


@dataclass(frozen=True, kw_only=True)
class Colouring:
    """Which entries of the parameter vector are perturbed together, and which joints each of them moves."""

    colours: tuple[tuple[int, ...], ...]
    """Entries perturbed together."""
    joints: tuple[tuple[int, ...], ...]
    """For each entry of the vector, the indices of the joints that it moves."""
    sensors: tuple[int, ...] = ()
    """Entries that change what sensors show, and no motion: each is perturbed without the others of its tree."""

    @cached_property
    def row_of(self) -> dict[int, int]:
        """The colour of each entry that is not fixed, which is its row of a Jacobian."""
        return {entry: c for c, entries in enumerate(self.colours) for entry in entries}

    def moving(self, joints: Iterable[int]) -> list[int]:
        """Entries that move any of some joints."""
        own = set(joints)
        return [entry for entry in self.row_of if own & set(self.joints[entry])]


def colour(space: ParameterSpace, trees: Sequence[Sequence[str]], joint_names: Sequence[str]) -> Colouring:
    """Group entries that move different joints: the i-th of each tree together, shared ones alone.

    Entries whose bounds are equal are fixed: they belong to no colour and move no joint.

    Args:
        trees: Groups of joints that do not influence each other.
    """
    index = {name: i for i, name in enumerate(joint_names)}
    owners = space.owners(trees)
    by_tree: list[list[int]] = [[] for _ in trees]
    alone: list[int] = []
    free = (space.upper > space.lower).tolist()
    for entry, owner in enumerate(owners):
        if free[entry]:
            (alone if owner is None else by_tree[owner]).append(entry)
    depth = max((len(entries) for entries in by_tree), default=0)
    colours = [tuple(entries[i] for entries in by_tree if i < len(entries)) for i in range(depth)]
    joints = tuple(
        tuple(index[name] for name in (joint_names if owner is None else trees[owner])) if free[entry] else ()
        for entry, owner in enumerate(owners)
    )
    sensors = tuple(entry for entry, moves in enumerate(space.moves.tolist()) if not moves)
    return Colouring(colours=(*colours, *((entry,) for entry in alone)), joints=joints, sensors=sensors)
