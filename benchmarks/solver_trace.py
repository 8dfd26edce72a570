"""How a solver got down: what it had reached after how many seconds, iterations and simulated steps."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(kw_only=True)
class Trace:
    """One solver's run; a point is added whenever it knows a better vector."""

    solver: str
    """Its name in tables and legends."""
    seconds: list[float] = field(default_factory=list)
    """Wall time of each point, building the model and its simulations included [s]."""
    score: list[float] = field(default_factory=list)
    """Mean over the samples of Σ_joints error² [rad²]."""
    parameter_error: list[float] = field(default_factory=list)
    """Root mean square over the parameters of |value - truth| / range."""
    largest_error: list[float] = field(default_factory=list)
    """Largest |value - truth| / range."""
    simulated_steps: list[int] = field(default_factory=list)
    """Steps of all simulations together."""
    iterations: int = 0
    """Iterations of the solver."""
    wall_time_s: float = 0.0
    """Until the solver returned [s]."""
    all_steps: int = 0
    """Simulated steps until it returned."""
    start: float = field(default_factory=time.perf_counter)

    def add(self, score: float, relative_error: np.ndarray, simulated_steps: int) -> None:
        """Note a vector, if it is better than those before.

        Args:
            score: Its score [rad²].
            relative_error: (value - truth) / range of each parameter.
            simulated_steps: So far.
        """
        if self.score and score >= self.score[-1]:
            return
        self.seconds.append(time.perf_counter() - self.start)
        self.score.append(float(score))
        self.parameter_error.append(float(np.sqrt(np.mean(np.square(relative_error)))))
        self.largest_error.append(float(np.abs(relative_error).max()))
        self.simulated_steps.append(int(simulated_steps))

    def end(self, iterations: int, simulated_steps: int) -> None:
        """Stop the clock."""
        self.wall_time_s = time.perf_counter() - self.start
        self.iterations, self.all_steps = int(iterations), int(simulated_steps)

    def seconds_to(self, score: float) -> float:
        """Wall time until a score was reached [s]; infinite if it never was."""
        return next((t for t, s in zip(self.seconds, self.score, strict=True) if s <= score), np.inf)

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        content = asdict(self)
        del content["start"]
        return content


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Text in columns, the first flush left."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = [
        "  ".join(
            cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in [header, *rows]
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def machine() -> dict[str, Any]:
    """What the figures were measured on; the load says how busy it was at the start."""
    return {
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "processors": os.cpu_count(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "load_average_1min": os.getloadavg()[0],
    }


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a benchmark's figures."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n")
