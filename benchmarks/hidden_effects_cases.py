"""The cases of hidden_effects.py, and what is done with one."""

from __future__ import annotations

import dataclasses
import json
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pace_optim.fit import fit
from pace_optim.fit_settings import FitSettings
from pace_optim.plant import Case, CaseFiles, library_effects, outside_effects, write_case

GROUPS = ("effects", "clean", "outside", "pairs", "background", "harmonic")
ROBOTS = {"bench": ("Pace-TestBench-v0", ".*"), "leg": ("Pace-AnymalD-v0", "LF_.*")}
PAIRS = (
    ("stribeck_friction", "backlash"),
    ("joint_elasticity", "torque_gain"),
    ("load_dependent_friction", "measurement_delay"),
)
_BACKGROUNDS = (1 / 3, 1.0)  # share of the effect's own size, seed by seed in turn


@dataclass(frozen=True, kw_only=True)
class Job:
    """A case, and how it is judged."""

    group: str
    """Which of ``GROUPS``."""
    case: Case
    """What is hidden."""
    folder: Path
    """Where its recordings and runs go."""
    physics_dt: float = 0.0005
    """Of the model [s]."""
    max_effects: int = 3
    """How many effects the diagnosis may add."""
    fits_only: bool = False
    """Whether only the base model and the true model are fitted."""


def make_jobs(
    groups: Sequence[str], seeds: int, robot: str, recordings: str, folder: Path, **settings: Any
) -> list[Job]:
    """All cases of some groups.

    Raises:
        ValueError: If a group or the robot is unknown.
    """
    if unknown := [group for group in groups if group not in GROUPS]:
        raise ValueError(f"There is no group of cases {unknown[0]!r}. Available: {', '.join(GROUPS)}.")
    if robot not in ROBOTS:
        raise ValueError(f"There is no robot {robot!r}. Available: {', '.join(ROBOTS)}.")
    task, joints = ROBOTS[robot]
    hidden: dict[str, list[tuple[str, ...]]] = {
        "effects": [(name,) for name in library_effects()],
        "clean": [()],
        "outside": [(name,) for name in outside_effects()],
        "pairs": list(PAIRS),
        "background": [(name,) for name in library_effects()],
        "harmonic": [()],
    }
    jobs = []
    for seed in range(seeds):
        for group in groups:
            for effects in hidden[group]:
                case = Case(effects=effects, seed=seed, task=task, kind=recordings, joints=joints)  # type: ignore[arg-type]
                if group == "background":
                    case = replace(case, background=_BACKGROUNDS[seed % len(_BACKGROUNDS)])
                if group == "harmonic":
                    case = replace(case, harmonic_drive=True)
                jobs.append(Job(group=group, case=case, folder=folder / case.name, **settings))
    return jobs


def run_job(job: Job) -> dict[str, Any]:
    """One case from its recordings to its line in the results; an error becomes part of the line."""
    line = {
        "case": job.case.name,
        "group": job.group,
        "effects": list(job.case.effects) or (["joint_elasticity"] if job.case.harmonic_drive else []),
        "seed": job.case.seed,
    }
    try:
        return {**line, **run_case(job)}
    except Exception as error:  # one case must not end the others
        return {**line, "error": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()}


def run_case(job: Job) -> dict[str, Any]:
    """Make the recordings, fit the base model, diagnose, and fit the model that has the true effects."""
    start = time.perf_counter()
    files = write_case(job.case, job.folder)
    truth = json.loads(files.truth.read_text())
    made = time.perf_counter()
    settings = _fit_settings(job, files)
    base, run = fit(settings)
    fitted = time.perf_counter()
    found = {} if job.fits_only else _diagnose(run, job.max_effects)
    diagnosed = time.perf_counter()
    before = base.rmse["validation"]["all"]
    true_effects = [name for name in truth["effects"] if name in library_effects()]
    with_truth = None
    if true_effects and not job.case.background:
        with_truth = fit(replace(settings, effects=true_effects))[0].rmse["validation"]["all"]
    return {
        "size": truth["size"],
        "noise": job.case.noise,
        "at_bound": list(base.at_bound),
        **found,
        "rmse": {"before": before, "after": _rmse_after(found, before), "truth": with_truth},
        "seconds": {
            "recordings": made - start,
            "base_fit": fitted - made,
            "diagnosis": diagnosed - fitted,
            "true_fit": time.perf_counter() - diagnosed,
        },
    }


def _diagnose(run: Path, max_effects: int) -> dict[str, Any]:
    """The one place that knows the diagnosis: the fields of diagnosis.json that are judged."""
    from pace_optim.diagnosis import DiagnosisSettings, diagnose

    result = diagnose(DiagnosisSettings(run=run, max_effects=max_effects))
    result = result[0] if isinstance(result, tuple) else result
    if dataclasses.is_dataclass(result) and not isinstance(result, type):
        result = dataclasses.asdict(result)
    return {key: result[key] for key in ("verdict", "added", "ranking", "advice")} | {
        "runs": [str(path) for path in result["runs"]]
    }


def _rmse_after(found: dict[str, Any], before: float) -> float:
    """Validation error of the model with all that was added [rad]."""
    if not found.get("added"):
        return before
    after = [
        entry["validation_rmse_after"]
        for entry in found["ranking"]
        if entry["effect"].partition("@")[0] in {name.partition("@")[0] for name in found["added"]}
    ]
    return min(after, default=before)


def _fit_settings(job: Job, files: CaseFiles) -> FitSettings:
    return FitSettings(
        task=job.case.task,
        data=[str(path) for path in files.train],
        validation=[str(path) for path in files.validation],
        optimizer="least_squares",
        physics_dt=job.physics_dt,
        log_dir=str(job.folder / "runs"),
    )
