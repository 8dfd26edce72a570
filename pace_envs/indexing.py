"""Rows of environments and columns of joints, however they are named."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from pace_actuators import match_names
from pace_envs.simulation import EnvIds

JointIds = Sequence[int] | torch.Tensor | slice | None


def indices(ids: EnvIds | JointIds) -> torch.Tensor | slice:
    """What selects these rows or columns, in the caller's order: values belong to the ids one by one."""
    if ids is None or isinstance(ids, slice):
        return slice(None) if ids is None else ids
    indices = torch.as_tensor(ids)
    return indices.nonzero()[:, 0] if indices.dtype == torch.bool else indices.long()


def pick(tensor: torch.Tensor | None, ids: Any) -> Any:
    """The columns of a drive's joints; the tensor itself where it drives them all."""
    return tensor if tensor is None or isinstance(ids, slice) else tensor[:, ids]


def mask_of(env_ids: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Environments by index as a mask, (num_envs,) bool, where a tensor (num_envs,) is."""
    return torch.zeros_like(like, dtype=torch.bool).index_fill_(0, env_ids, True)


def zeros_like(tensor: torch.Tensor) -> torch.Tensor:
    """Zeros that can be written in inference mode and outside of it."""
    with torch.inference_mode(False):
        return torch.zeros_like(tensor)


def checked_values(value: Any, shape: tuple[int, int], what: str) -> torch.Tensor | float:
    """A value for every environment and joint: the one rule by which values are spread over them.

    A number is everybody's; of a tensor, each axis is as long as wanted or 1, and (joints,) is (1, joints).

    Args:
        shape: Number of environments and of joints.
    """
    if isinstance(value, bool | int | float):
        return value
    if not isinstance(value, torch.Tensor):
        raise ValueError(
            f"{what} is a {type(value).__module__}.{type(value).__qualname__}, expected a number or a torch.Tensor of "
            f"shape {shape} (environments, joints). Convert it: torch.as_tensor(value)."
        )
    found = tuple(value.shape)
    fits = len(found) <= 2 and all(n in (1, m) for n, m in zip(found[::-1], shape[::-1], strict=False))
    if not fits:
        raise ValueError(
            f"{what} has the shape {found}, expected {shape} (environments, joints), where either may be 1."
        )
    if value.is_complex():
        raise ValueError(f"{what} holds complex numbers, expected real ones.")
    return value


def assign(
    field: torch.Tensor,
    rows: torch.Tensor | slice,
    columns: torch.Tensor | slice,
    value: torch.Tensor | float,
    what: str = "the value",
) -> None:
    """``field[rows][:, columns] = value`` for any mix of slices and indices, spread by :func:`checked_values`."""
    shape = (_count(rows, field.shape[0]), _count(columns, field.shape[1]))
    value = checked_values(value, shape, what)
    if isinstance(rows, slice) or isinstance(columns, slice):
        field[rows, columns] = torch.as_tensor(value, dtype=field.dtype, device=field.device)
    else:
        field[rows[:, None], columns[None, :]] = torch.as_tensor(value, dtype=field.dtype, device=field.device)


def _count(ids: torch.Tensor | slice, length: int) -> int:
    return len(range(length)[ids]) if isinstance(ids, slice) else len(ids)


def find_names(
    keys: str | Sequence[str], names: Sequence[str], preserve_order: bool, what: str
) -> tuple[list[int], list[str]]:
    """Indices and names that match, in the order of the names or of the keys."""
    groups = match_names(keys, names, what=what)
    found = [i for group in groups for i in group]
    found = list(dict.fromkeys(found)) if preserve_order else sorted(set(found))
    return found, [names[i] for i in found]
