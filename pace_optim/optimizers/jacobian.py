"""Derivatives of the residuals by finite differences, coloured by kinematic tree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.parameter_space import ParameterSpace

_STEP = 1e-5
"""Normalised step of the derivatives: as small as rounding allows."""


@dataclass(frozen=True, kw_only=True)
class Colouring:
    """Which entries of the parameter vector are perturbed together, and which joints each of them moves."""

    colours: tuple[tuple[int, ...], ...]
    """Entries perturbed together."""
    joints: tuple[tuple[int, ...], ...]
    """For each entry of the vector, the indices of the joints that it moves."""


def colour(space: ParameterSpace, trees: Sequence[Sequence[str]], joint_names: Sequence[str]) -> Colouring:
    """Group entries that move different joints: the i-th of each tree together, shared ones alone.

    Entries whose bounds are equal are fixed: they belong to no colour and move no joint.

    Args:
        space: The parameters.
        trees: Groups of joints that do not influence each other.
        joint_names: All joints, in order.
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
    return Colouring(colours=(*colours, *((entry,) for entry in alone)), joints=joints)


def perturbed(x: torch.Tensor, colouring: Colouring) -> tuple[torch.Tensor, torch.Tensor]:
    """The vectors whose residuals give the Jacobian at x.

    Args:
        x: Normalised vector, (size,).
        colouring: Which entries go together.

    Returns:
        Normalised vectors (colours, size) and the signed step of every entry (size,); steps point into the bounds.
    """
    step = torch.where(x > 0, -_STEP, _STEP).to(x.dtype)
    vectors = x.repeat(len(colouring.colours), 1)
    for row, entries in zip(vectors, colouring.colours, strict=True):
        row[list(entries)] += step[list(entries)]
    return vectors, step


@dataclass(frozen=True, kw_only=True, eq=False)
class Jacobian:
    """The residuals at x and derivatives there or near it, block by block."""

    residuals: Residuals
    """Of x alone, m = 1."""
    columns: torch.Tensor
    """Derivative by each colour's entries, (colours, K, R, n) [rad per normalised unit]."""
    colouring: Colouring
    is_wide: bool = False
    """Whether the derivatives are taken over steps that are as wide as the error (``wide_derivatives``)."""

    def column(self, entry: int) -> torch.Tensor:
        """Derivative of the error by an entry, (K, R, n); zero for joints that the entry does not move."""
        result = torch.zeros_like(self.residuals.error[0])
        row = next((c for c, entries in enumerate(self.colouring.colours) if entry in entries), None)
        if row is None:  # its bounds are equal
            return result
        joints = list(self.colouring.joints[entry])
        result[..., joints] = self.columns[row][..., joints]
        return result

    def times(self, vector: torch.Tensor) -> torch.Tensor:
        """J v, (K, R, n) [rad], of a normalised change (size,) of the entries."""
        result = torch.zeros_like(self.residuals.error[0])
        for row, entries in zip(self.columns, self.colouring.colours, strict=True):
            for entry in entries:
                joints = list(self.colouring.joints[entry])
                result[..., joints] += float(vector[entry]) * row[..., joints]
        return result

    def transposed_times(self, series: torch.Tensor) -> torch.Tensor:
        """Jᵀ s, (size,), of a series like the residuals, (K, R, n) [rad], divided by the number of samples."""
        result = torch.zeros(len(self.colouring.joints), dtype=torch.float64)
        for row, entries in zip(self.columns, self.colouring.colours, strict=True):
            by_joint = (row * series).sum(dim=(0, 1))
            for entry in entries:
                result[entry] = by_joint[list(self.colouring.joints[entry])].sum()
        return result / self.residuals.where.sum()

    def normal_equations(self) -> tuple[torch.Tensor, torch.Tensor]:
        """JᵀJ (size, size) and Jᵀr (size,), divided by the number of samples as the score is."""
        size = len(self.colouring.joints)
        hessian, gradient = torch.zeros(size, size, dtype=torch.float64), torch.zeros(size, dtype=torch.float64)
        row_of = {entry: c for c, entries in enumerate(self.colouring.colours) for entry in entries}
        for joint in range(self.columns.shape[-1]):
            entries = [entry for entry in range(size) if joint in self.colouring.joints[entry]]
            # laid out alike whatever they are views of: products are rounded by layout, and a resumed fit's are to be
            # those of one that was not interrupted
            block = self.columns[[row_of[entry] for entry in entries], ..., joint].reshape(len(entries), -1)
            block, error = block.contiguous(), self.residuals.error[0, ..., joint].reshape(-1)
            error = error.clone(memory_format=torch.contiguous_format)
            at = torch.tensor(entries)
            hessian[at[:, None], at] += block @ block.T
            gradient[at] += block @ error
        samples = self.residuals.where.sum()
        return hessian / samples, gradient / samples


def jacobian(residuals: Residuals, step: torch.Tensor, colouring: Colouring) -> Jacobian:
    """The Jacobian from the residuals of x (row 0) and of :func:`perturbed` (the rows after it)."""
    columns = residuals.error[1 : 1 + len(colouring.colours)] - residuals.error[:1]
    for column, entries in zip(columns, colouring.colours, strict=True):
        for entry in entries:
            column[..., list(colouring.joints[entry])] /= step[entry]
    return Jacobian(residuals=residuals.rows(0, 1), columns=columns, colouring=colouring)
