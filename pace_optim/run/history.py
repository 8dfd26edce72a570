"""Scores over iterations, for plots and TensorBoard."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from pace_actuators.files import checked, read_json, refuse


@dataclass(kw_only=True)
class History:
    """What happened: generations of the search, iterations of the refinement; either may come first."""

    search_best: list[float] = field(default_factory=list)
    """Best score so far after each generation [rad²]."""
    search_mean: list[float] = field(default_factory=list)
    """Mean score of each generation [rad²]."""
    search_steps: list[int] = field(default_factory=list)
    """Simulated steps after each generation."""
    search_time_s: list[float] = field(default_factory=list)
    """Wall time after each generation [s]."""
    refine_best: list[float] = field(default_factory=list)
    """Best score so far after each iteration of the refinement [rad²]."""
    refine_steps: list[int] = field(default_factory=list)
    """Simulated steps after each iteration of the refinement."""
    refine_time_s: list[float] = field(default_factory=list)
    """Wall time after each iteration of the refinement [s]."""

    @classmethod
    def load(cls, path: Path) -> History:
        """Read ``history.json``."""
        cure = "Fit again, or go on with the run: it is written anew."
        history = checked(cls, read_json(path, cure), path, cure)
        for stage in ("search", "refine"):
            own = {name: len(value) for name, value in asdict(history).items() if name.startswith(stage)}
            if len(set(own.values())) > 1:
                refuse(path, f"{', '.join(own)} differ in length ({', '.join(map(str, own.values()))})", cure)
        return history

    @property
    def iterations(self) -> int:
        """Generations of the search and iterations of the refinement so far, together."""
        return len(self.search_best) + len(self.refine_best)

    def places(self) -> tuple[list[int], list[int]]:
        """Which of all iterations, counted from 1 by simulated steps, those of the search and of the refinement are."""
        search = [(steps, 0, i) for i, steps in enumerate(self.search_steps)]
        refine = [(steps, 1, i) for i, steps in enumerate(self.refine_steps)]
        place = {entry: number for number, entry in enumerate(sorted(search + refine), start=1)}
        return [place[entry] for entry in search], [place[entry] for entry in refine]

    def to_dict(self) -> dict[str, list]:
        """For a JSON file."""
        return asdict(self)
