"""How the size of an effect is written."""

from __future__ import annotations

from typing import Any


def size_text(size: dict[str, Any]) -> str:
    """A value of ``diagnosis.json`` with its error bar and unit, or as a factor of what was stated."""
    factor, std = size["factor"], size["std"]
    value = size["value"] if factor is None else factor
    text = f"{value:.4g}" if std is None else f"{value:.4g} ± {std:.1g}"
    if factor is not None:
        text += " times what was stated"
    elif size["unit"] != "1":
        text += f" {size['unit']}"
    return text + (", at its bound" if size["at_bound"] else "")
