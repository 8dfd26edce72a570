"""Resolve configuration values, given as numbers or by regular expression, to joints."""

import re
from collections.abc import Mapping, Sequence

import torch

from pace_actuators.text import listed

JointValue = float | Mapping[str, float] | Sequence[float] | torch.Tensor
"""A number for every joint, a dict of regular expression to value, or one value per joint."""


def match_names(patterns: str | Sequence[str], names: Sequence[str], *, what: str = "joint") -> list[list[int]]:
    """For each pattern the indices of the names it matches in full.

    Args:
        patterns: One regular expression or several.
        what: What the names are called in messages.

    Returns:
        One list of indices per pattern, in the order of ``names``.

    Raises:
        ValueError: If a pattern is no regular expression, or matches nothing.
    """
    matches = []
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        try:
            expression = re.compile(pattern)
        except re.error as error:
            raise ValueError(f"{pattern!r} is not a regular expression ({error}). Correct the pattern.") from None
        found = [i for i, name in enumerate(names) if expression.fullmatch(name)]
        if not found:
            raise ValueError(
                f"The pattern {pattern!r} matches no {what}. Available: {listed(names)}. "
                "Correct the pattern or remove it."
            )
        matches.append(found)
    return matches


def resolve_joint_values(
    value: JointValue,
    joint_names: Sequence[str],
    *,
    field: str,
    default: float | None = None,
    dtype: torch.dtype = torch.float64,
) -> torch.Tensor:
    """Turn a configuration value into one number per joint.

    Args:
        value: A number (all joints), a dict of regular expression to number, or one number per joint.
        field: The configuration field, for messages.
        default: The value of joints that no pattern of a dict covers; ``None`` makes that an error.
        dtype: Type of the result.

    Returns:
        Values per joint, shape (num_joints,), on the CPU.

    Raises:
        ValueError: If a pattern matches no joint, a joint is matched twice or not at all, or the number
            of values differs from the number of joints.
    """
    if isinstance(value, Mapping):
        owner: dict[int, str] = {}
        result = torch.full((len(joint_names),), float("nan"), dtype=dtype)
        for pattern, indices in zip(value, match_names(list(value), joint_names), strict=True):
            for i in indices:
                if i in owner:
                    raise ValueError(
                        f"{field}: the joint {joint_names[i]!r} is matched twice, by {owner[i]!r} and by "
                        f"{pattern!r}. Make the patterns exclusive."
                    )
                owner[i] = pattern
                result[i] = float(value[pattern])
        missing = [i for i in range(len(joint_names)) if i not in owner]
        if missing and default is None:
            raise ValueError(
                f"{field}: no value for {', '.join(joint_names[i] for i in missing)}. "
                f"Patterns given: {', '.join(value) or 'none'}. Add a pattern that matches them."
            )
        result[missing] = float("nan") if default is None else default
        return result
    if isinstance(value, (int, float)):
        return torch.full((len(joint_names),), float(value), dtype=dtype)
    result = torch.as_tensor(value, dtype=dtype, device="cpu").clone()
    if result.ndim == 0:
        return result.expand(len(joint_names)).clone()
    if result.shape != (len(joint_names),):
        raise ValueError(
            f"{field}: got {tuple(result.shape)} values, expected one per joint ({len(joint_names)}: "
            f"{', '.join(joint_names)}). Give a number, a dict of patterns, or that many values."
        )
    return result
