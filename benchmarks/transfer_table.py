"""The table and the picture of transfer.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt

_FIGURES = {
    "velocity_error": ("velocity error [m/s]", 1.0, "{:.3f}"),
    "falls_per_episode": ("falls in 20 s [%]", 100.0, "{:.1f}"),
    "cost_of_transport": ("cost of transport", 1.0, "{:.2f}"),
}
"""Key -> heading, factor, format."""
_WORLDS = {"own": "its own world", "real": 'the "real" robot'}


def make_table(lines: list[dict[str, Any]]) -> str:
    """Mean and range over seeds of every policy in both worlds, and the gap between them, as Markdown."""
    rows = ["| policy | seeds | " + " | ".join(f"{f[0]}: own, real, gap" for f in _FIGURES.values()) + " |"]
    rows.append("|---" * (2 + len(_FIGURES)) + "|")
    for policy, values in _by_policy(lines).items():
        cells = [
            f"{_range(v['own'], form)}, {_range(v['real'], form)}, {form.format(v['real'].mean() - v['own'].mean())}"
            for key, (_, _, form) in _FIGURES.items()
            for v in [values[key]]
        ]
        count = len(next(iter(values.values()))["own"])
        rows.append(f"| {policy} | {count} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def plot_transfer(lines: list[dict[str, Any]], path: Path) -> None:
    """Every policy's figures in both worlds: a dot per seed, a bar for their mean."""
    values = _by_policy(lines)
    figure, axes = plt.subplots(1, len(_FIGURES), figsize=(11, 3.6), layout="constrained")
    for axis, (key, (heading, _, _)) in zip(axes, _FIGURES.items(), strict=True):
        for side, (world, label) in enumerate(_WORLDS.items()):
            at = np.arange(len(values)) + 0.38 * (side - 0.5)
            numbers = [values[policy][key][world] for policy in values]
            axis.bar(at, [n.mean() for n in numbers], 0.34, label=label, color=("#9db7d5", "#d1495b")[side])
            for x, each in zip(at, numbers, strict=True):
                axis.plot(np.full(len(each), x), each, "o", color="black", markersize=3)
        axis.set_xticks(range(len(values)), [policy.replace(" ", "\n", 1) for policy in values])
        axis.set_title(heading, fontsize=10)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _by_policy(lines: list[dict[str, Any]]) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """{policy: {figure: {world: values of all seeds}}}."""
    return {
        policy: {
            key: {
                world: factor * np.array([line[world][key] for line in lines if line["policy"] == policy])
                for world in _WORLDS
            }
            for key, (_, factor, _) in _FIGURES.items()
        }
        for policy in sorted({line["policy"] for line in lines})
    }


def _range(values: np.ndarray, form: str) -> str:
    """The mean and, of several, smallest to largest."""
    mean = form.format(values.mean())
    return mean if len(values) < 2 else f"{mean} ({form.format(values.min())} to {form.format(values.max())})"
