"""What a user asks of a fit."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pace_actuators.files import checked, read_json
from pace_actuators.own_code import absolute_reference
from pace_optim.problem.unknown_facts import check_unknown
from pace_optim.recording import without_fact_files
from pace_optim.terminal.choices import OPTIMIZERS
from pace_optim.terminal.cli import command


@dataclass(kw_only=True)
class FitSettings:
    """One fit, as on the command line of ``scripts/fit.py``."""

    task: str
    """The environment: a registered name, ``module:Name``, ``/path/to/file.py:Name`` or a model file, which
    :func:`pace_envs.task_source.use_task` has made known."""

    data: list[str] = field(default_factory=list)
    """Recordings to train on; none means the robot's own sample."""

    validation: list[str] = field(default_factory=list)
    """Recordings that are never trained on; none keeps the last 30 % of each for that."""

    effects: list[str] = field(default_factory=list)
    """Physical effects identified beside the base parameters: ``name``, ``name@joints``, ``name@shared`` or
    ``name@joints@shared``."""

    links: list[str] = field(default_factory=list)
    """Links whose inertial parameters are identified, regular expressions of their names: ``name`` or
    ``name@mass,com,inertia`` with some of these."""

    unknown: list[str] = field(default_factory=list)
    """Unknown facts of the drives (``stiffness``, ``damping``, ``effort_limit``, ``saturation_effort``,
    ``velocity_limit``): read from the recordings' torques where they have them, else identified."""

    residual: list[str] = field(default_factory=list)
    """What is fitted: ``position``, or ``position effort`` with the measured torques too; none: positions. A search by
    scores alone (``cmaes``, a custom objective) scores positions."""

    num_envs: int = 512
    """Simulations at once in a search; refining takes as many as it needs."""

    optimizer: str = "hybrid"
    """``hybrid``, ``least_squares`` or ``cmaes``; or a subclass of ``CMAESOptimizer``, itself or as ``module:Class`` or
    ``path/to/file.py:Class``, whose ``tell`` says what is minimised."""

    max_iteration: int | None = None
    """Largest number of generations of the search; ``None`` keeps the robot's."""

    epsilon: float | None = None
    """PACE's stopping rule, (max - min) / min of a generation's scores; ``None`` keeps the robot's."""

    stop: list[str] = field(default_factory=list)
    """Further rules that end the search, as in ``CMAESOptimizerCfg.stop``; none keeps the robot's."""

    sigma: float | None = None
    """Initial standard deviation of the search, normalised; ``None`` keeps the robot's."""

    seed: int = 0
    """Seed of the search."""

    delay_mode: str | None = None
    """``command`` or ``effort``; ``None`` keeps the robot's."""

    physics_dt: float | None = None
    """A finer physics step under the same control rate [s]."""

    drive_dt: float | None = None
    """Time between two runs of the drives' own controllers [s]; 0: continuous; ``None`` keeps the robot's."""

    control_dt: float | None = None
    """Time between two commands [s] of a robot that a model file states; ``None``: 2.5 ms."""

    joint_strategy: bool = False
    """Search all joints with one strategy although they do not influence each other."""

    save_optimization_process: bool = False
    """Keep every generation's parameters and scores in ``progress.pt``."""

    start: dict[str, dict[str, float]] | None = None
    """Parameters to start least squares from, as in ``result.json``; ``None``: from the middle of the bounds."""

    check_consistency: bool = True
    """Whether each of several recordings is fitted alone too, to see whether they agree."""

    joints: str | None = None
    """Regular expression of the joints to identify, the others are held; ``None``: those that recordings command."""

    columns: str | None = None
    """Column map of logs that are not in this project's own form; ``None``: guessed."""

    facts: str | None = None
    """JSON file of gains, limits and loads of all recordings that do not state them; ``None``: no such file."""

    rate: float | None = None
    """Rows per second of logs that have no column of time [Hz]."""

    strict: bool = False
    """Whether one recording that cannot be used refuses all, instead of being set aside."""

    trust_log: bool = False
    """Whether a log that its checks say is faulty is fitted as it is, with a warning."""

    max_duration: float | None = None
    """How much of each recording is fitted at most, where it moves the joints most [s]; ``None``: as much as can be."""

    device: str = "cpu"
    """Where the search simulates: ``cpu``, or a GPU as ``cuda:0``; the rest runs on the processor, in float64."""

    log_dir: str = "logs/pace"
    """Where runs are kept."""

    instead_of: str | None = None
    """The run of positions alone that this one, with torques, replaces if it is better; ``None`` replaces no run."""

    def __post_init__(self) -> None:
        """Check what can be checked without reading anything, and leave out the JSON files beside recordings."""
        if isinstance(self.optimizer, type):
            self.optimizer = f"{self.optimizer.__module__}:{self.optimizer.__qualname__}"
        if self.optimizer not in OPTIMIZERS and ":" not in self.optimizer:
            raise ValueError(
                f"Unknown optimizer {self.optimizer!r}. Available: {', '.join(OPTIMIZERS)}, or module:Class, a "
                "subclass of CMAESOptimizer."
            )
        self.optimizer = absolute_reference(self.optimizer)
        check_unknown(self.unknown)
        if self.links and self.only_searches:
            raise ValueError(
                f"links are identified by least squares, which know their prior, and the optimizer is "
                f"{self.optimizer}. Choose hybrid or least_squares."
            )
        if self.residual and sorted(set(self.residual)) not in (["position"], ["effort", "position"]):
            raise ValueError(
                f"--residual {' '.join(self.residual)} is not understood. Available: position, or position effort."
            )
        if "effort" in self.residual and self.only_searches:
            raise ValueError(
                f"Measured torques are followed by least squares, and the optimizer is {self.optimizer}. Choose hybrid "
                "or least_squares."
            )
        for name, lowest in (("num_envs", 1), ("max_iteration", 1), ("seed", 0)):
            value = getattr(self, name)
            if value is not None and value < lowest:
                raise ValueError(f"{name} is {value}, expected at least {lowest}.")
        for name in ("epsilon", "sigma", "physics_dt", "control_dt", "max_duration", "rate"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise ValueError(f"{name} is {value}, expected a number > 0.")
        if self.drive_dt is not None and not 0 <= self.drive_dt < float("inf"):
            raise ValueError(f"drive_dt is {self.drive_dt}, expected seconds, or 0 for loops that run continuously.")
        self.data = without_fact_files(self.data, self.facts)
        self.validation = without_fact_files(self.validation, self.facts)

    @property
    def has_own_objective(self) -> bool:
        """Whether the optimizer is a class of the user's own."""
        return ":" in self.optimizer

    @property
    def only_searches(self) -> bool:
        """Whether nothing is refined: CMA-ES alone, or an objective that least squares do not minimise."""
        return self.optimizer == "cmaes" or self.has_own_objective

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        return asdict(self)

    @classmethod
    def load(cls, path: Path) -> tuple[FitSettings, SettingsFile]:
        """Settings of a run and the whole content of its ``settings.json``; nothing that it names is imported.

        Raises:
            ValueError: If the file is missing or unreadable.
        """
        if not path.exists():
            raise ValueError(f"{path.parent} is no run: it has no {path.name}.")
        cure = "Start a new fit."
        content = checked(SettingsFile, read_json(path, cure), path, cure)
        settings = checked(cls, content.settings, f"{path}: settings", cure, strict=True)
        return settings, content


@dataclass(kw_only=True)
class SettingsFile:
    """What ``settings.json`` holds."""

    settings: dict[str, Any]
    """Settings of the fit."""

    digests: dict[str, str]
    """SHA-256 of each recording, by its path, in the order of training and validation."""

    environment: dict[str, Any] = field(default_factory=dict)
    """Where the environment comes from; runs of earlier versions have none."""

    inputs: dict[str, str | None] = field(default_factory=dict)
    """SHA-256 of each other file that was read; ``None`` where there was none."""

    resolved: dict[str, Any] = field(default_factory=dict)
    """The whole configuration as data."""


_WITHOUT_FLAG = ("start", "check_consistency", "instead_of")
"""Settings that no flag of the same name makes."""


def command_line(settings: Mapping[str, Any]) -> str:
    """The command line of settings as data; what is left at its default is left out."""
    words = ["python", *command("fit").split()]
    words = words if words[1].endswith(".py") else words[1:]
    usual = FitSettings(task="").to_dict()
    flags = {name: value for name, value in settings.items() if name not in _WITHOUT_FLAG and value != usual.get(name)}
    flags["no_consistency"] = settings.get("check_consistency") is False
    for name, value in flags.items():
        if value is None or value is False:
            continue
        words.append(f"--{name}")
        if isinstance(value, list):
            words += [str(entry) for entry in value]
        elif value is not True:
            words.append(str(value))
    return shlex.join(words)
