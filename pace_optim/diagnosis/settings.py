"""What a user asks of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from pace_optim.diagnosis.diagnosis_cfg import DiagnosisCfg
from pace_optim.terminal.choices import MEASURED_FACTS


@dataclass(kw_only=True)
class DiagnosisSettings:
    """One diagnosis, as on the command line of ``scripts/diagnose.py``."""

    run: str | Path
    """The run's folder."""

    task: str | None = None
    """Another environment than the run's own."""

    effects: list[str] = field(default_factory=list)
    """More candidates (``module:Class``), beside all registered ones; or, with ``only``, the only ones."""

    only: bool = False
    """Whether only ``effects`` are tried."""

    measured: list[str] = field(default_factory=list)
    """Facts that were measured, of ``MEASURED_FACTS``: effects that would contradict them are not tried."""

    links: bool = True
    """Whether wrong masses, centres and inertias of the model file's links are looked for, before effects: one of them
    moves many joints."""

    max_effects: int = 3
    """Most effects that are added to a joint."""

    physics_dt: float | None = None
    """Physics step of the diagnosis [s]; ``None``: half a control step, or the run's if that is finer."""

    refit: bool | None = None
    """Whether the model with the effects found is fitted to the whole robot, as a new run; ``None``: where they
    are what is missing, or a curve explains it in their place."""

    device: str = "cpu"
    """Where single joints are simulated: ``cpu``, or a GPU as ``cuda:0``; in float64 on both."""

    cfg: DiagnosisCfg = field(default_factory=DiagnosisCfg)
    """Its numbers, and which of its rules are in force."""

    def __post_init__(self) -> None:
        """Check what can be checked without reading anything.

        Raises:
            ValueError: If a value is unusable.
        """
        if self.max_effects < 1:
            raise ValueError(f"max_effects is {self.max_effects}, expected at least 1.")
        if wrong := [fact for fact in self.measured if fact not in MEASURED_FACTS]:
            raise ValueError(f"--measured {wrong[0]} is not understood. Available: {', '.join(MEASURED_FACTS)}.")
        if self.only and not self.effects:
            raise ValueError("--only needs the effects to try: name them with --effects.")
