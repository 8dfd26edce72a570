"""What a diagnosis found: ``diagnosis.json``."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pace_actuators.files import checked, read_json, write_json
from pace_actuators.joint_units import JointType

VERSION = 1
FILE = "diagnosis.json"


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """The content of ``diagnosis.json``; field names are the file's keys."""

    version: int = VERSION
    run: str
    verdict: str
    """``link``, ``effect``, ``nothing_missing`` or ``unknown``."""
    summary: str
    """The verdict in a sentence or two."""
    evidence: list[str] = field(default_factory=list)
    """The errors behind it, and what comes nearest where no effect has earned its name; a sentence each."""
    more: dict[str, str] = field(default_factory=dict)
    """Joints on which more is missing: their error ends far above the floor. How much: "0.54 mrad, 5 floors"."""
    explained: float = 1.0
    """Part of the error above the floor that the effects found explain."""
    added: list[str]
    """Effects that are what is missing, as ``fit.py --effects`` takes them, the largest share first; none unless the
    verdict is ``effect``."""
    links: list[dict[str, Any]] = field(default_factory=list)
    """Links whose inertial parameters the model file states wrongly: ``link``, which ``parts``, ``values`` with the
    file's, and ``label`` as ``fit.py --links`` takes it. Effects were sought beside them."""
    paying: list[str] = field(default_factory=list)
    """Effects that the refit has: with the verdict ``unknown`` all that lower the error, otherwise those added."""
    free_form: list[str] = field(default_factory=list)
    """Those in ``paying`` that are curves of any form, where no effect is known."""
    shares: dict[str, float] = field(default_factory=dict)
    """How much of what the effects in ``paying`` explain is due to each, by name; they add up to 1."""
    ranking: list[dict[str, Any]]
    """Every effect that was refitted: those added first, as in ``added``, then round by round by what they explain."""
    hints: list[dict[str, Any]] = field(default_factory=list)
    """On each joint where no effect has earned its name the one that comes nearest: ``effect``, ``joint``, the part
    ``explained`` of what lies above the floor, and the ``doubts``."""
    sizes: list[dict[str, Any]] = field(default_factory=list)
    """Every parameter of the effects found, on each joint: value, standard deviation, unit, the factor of what was
    stated where it is one, and whether it is at a bound; of the refit once that is done."""
    likes: dict[str, list[str]] = field(default_factory=dict)
    """Effects that these recordings cannot separate from one found, by its name."""
    joints: dict[str, dict[str, Any]]
    """For each joint its errors, floor and effects; ``training_rmse`` is that of the refit."""
    data: list[str]
    """What was noticed about the recordings."""
    absorbed: dict[str, str] = field(default_factory=dict)
    """Effects that these recordings would not show, with the base parameter that takes each up."""
    advice: list[str]
    """What to do or to record next."""
    runs: list[str]
    """Folders of the run and of its refit, once that is done."""
    tried: list[str]
    """Names of all candidates."""
    physics_dt: float
    """Physics step of the diagnosis [s]."""
    ladder: list[dict[str, Any]] = field(default_factory=list)
    """Validation RMSE of all joints from the base model to the last effect [rad]."""
    error_map: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Which variable carries what is missing, on each joint whose error effects do not explain: what part of it each
    curve explains by itself, and the best curve."""
    cfg: dict[str, Any] = field(default_factory=dict)
    """The numbers that it was made with."""
    wall_time_s: float = 0.0

    def joint_types(self, joints: Iterable[str]) -> list[JointType]:
        """Whether these joints turn or slide; files of earlier versions do not say it."""
        return [self.joints.get(joint, {}).get("type", "hinge") for joint in joints]

    def save(self, folder: str | Path) -> Path:
        """Write ``diagnosis.json`` to a run's folder, atomically."""
        path = Path(folder) / FILE
        write_json(path, asdict(self))
        return path

    @classmethod
    def load(cls, folder: str | Path) -> Diagnosis:
        """Read it.

        Raises:
            ValueError: If it is missing or of another version.
        """
        path = Path(folder) / FILE
        cure = f"Run scripts/diagnose.py {shlex.quote(str(folder))} first." if not path.exists() else "Diagnose again."
        content = read_json(path, cure)
        if not isinstance(content, dict) or content.get("version") != VERSION:
            raise ValueError(f"{path} is no diagnosis of version {VERSION}. {cure}")
        return checked(cls, content, path, cure)
