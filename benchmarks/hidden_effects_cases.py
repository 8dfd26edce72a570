"""The cases of hidden_effects.py, and what is done with one."""

from __future__ import annotations

import json
import math
import re
import shutil
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from pace_actuators.effects import Effect, get_effect
from pace_optim.data_collection.plant import Case, library_effects, outside_effects, write_case
from pace_optim.data_collection.plant.hidden import effect_named
from pace_optim.diagnosis import candidate_effects, search_effects
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg
from pace_optim.diagnosis.selection.decisions import Decision, as_lines
from pace_optim.diagnosis.verdict.sizes import sizes
from pace_optim.diagnosis.verdict.verdict import ranking
from pace_optim.joints.fits.base_fit import fit_base
from pace_optim.joints.fits.block_errors import BlockErrors
from pace_optim.joints.fits.fits import Fits, fits_on
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.reference_update import ReferenceUpdate
from pace_optim.joints.simulation.problem import TwinProblem
from pace_optim.problem.problem import Problem, load_problem

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
    physics_dt: float = 0.00125
    """Of the model [s]."""
    max_effects: int = 3
    """How many effects the diagnosis may add."""
    cfg: DiagnosisCfg = DEFAULT
    """Its numbers and rules."""
    device: str = "cpu"
    """Where single joints are simulated."""
    ratio: tuple[float, float] | None = None
    """Beside a background: only cases whose effect makes so many times its error are diagnosed; ``None``: all."""

    @property
    def fits(self) -> Fits:
        """What fits models there."""
        return fits_on(self.device, self.cfg.fitting)


def make_jobs(
    groups: Sequence[str], seeds: Sequence[int], robot: str, recordings: str, folder: Path, **settings: Any
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
    for seed in seeds:
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
    """Make the recordings, diagnose, and fit the model that has the true effects and no others."""
    alone = {part: _base_error(job, part) for part in ("effects", "background")} if job.case.background else None
    if job.ratio and alone and not job.ratio[0] <= alone["effects"] / max(alone["background"], 1e-9) <= job.ratio[1]:
        return {"alone": alone}
    start = time.perf_counter()
    problem, truth = _load(job, job.case)
    made = time.perf_counter()
    middle = problem.space.to_physical(problem.space.start)
    decisions: list[Decision] = []
    fits = job.fits
    found = search_effects(
        problem, middle, candidate_effects(), job.max_effects, log=decisions.append, cfg=job.cfg, fits=fits
    )
    diagnosed = time.perf_counter()
    job.folder.parent.mkdir(parents=True, exist_ok=True)
    job.folder.with_name(f"{job.case.name}.jsonl").write_bytes(as_lines(decisions))
    outcome = found.outcome
    base, final = outcome.base, outcome.final
    true_effects = [get_effect(name) for name in truth["effects"] if name in library_effects()]
    with_truth = None
    if true_effects and not job.case.background:
        same = set(true_effects) == set(final.model.effects)
        if not same:
            follow = ReferenceUpdate(
                fits=fits, problem=problem, candidates=candidate_effects(), enough=found.data.floor
            ).follow
            twins, final = follow(outcome.problem, _fit_with(fits, outcome.problem, base, true_effects, truth))
            with_truth = _rms(fits.validation_errors(twins, fits.to_whole(twins, [final]))[0])
        else:
            with_truth = _rms(outcome.final_errors)
    fitted = time.perf_counter()
    return {
        "size": truth["size"],
        "noise": job.case.noise,
        "verdict": found.verdict,
        "added": found.added,
        "absorbed": [effect.name for effect in found.absorbed],
        "explained": found.explained,
        "floor": float(found.data.floor.square().mean().sqrt()),
        "shares": {effect.name: share for effect, share in found.shares.items()},
        "ranking": ranking(outcome, problem.joint_names, found.verdict, list(found.shares)),
        "sizes": [
            {**size, "true": _true(truth["effects"], size)}
            for size in sizes(fits, outcome, found.data.floor, problem.joint_names)
        ],
        "alone": alone,
        "rmse": {"before": _rms(outcome.base_errors), "after": _rms(outcome.final_errors), "truth": with_truth},
        "truth": truth["effects"],
        "seconds": {
            "recordings": made - start,
            "diagnosis": diagnosed - made,
            "true_fit": fitted - diagnosed,
        },
    }


def _true(hidden: Mapping[str, Mapping[str, Mapping[str, float]]], size: Mapping[str, Any]) -> float | None:
    """The true value of a size; the plant has the library's parameters, in order, under its own names."""
    if size["effect"] not in hidden:
        return None
    place = [p.name for p in get_effect(size["effect"]).parameters].index(size["parameter"])
    return hidden[size["effect"]][list(effect_named(size["effect"]).draws)[place]].get(size["joint"])


def _load(job: Job, case: Case) -> tuple[Problem, dict[str, Any]]:
    """Record a case and load it; its files are dropped, as it can be made again from its name."""
    files = write_case(case, job.folder)
    problem = load_problem(
        case.task,
        data=[str(path) for path in files.train],
        validation=[str(path) for path in files.validation],
        physics_dt=job.physics_dt,
    )
    truth = json.loads(files.truth.read_text())
    shutil.rmtree(job.folder, ignore_errors=True)
    return problem, truth


def _base_error(job: Job, part: Literal["effects", "background"]) -> float:
    """Validation RMSE above the noise [rad] of the base model where only one part of what is hidden is there.

    On the joints that have the effect.
    """
    problem, _ = _load(job, replace(job.case, part=part))
    twins, base, _ = fit_base(job.fits, problem, problem.space.to_physical(problem.space.start))
    joints = torch.tensor([bool(re.fullmatch(job.case.joints, name)) for name in problem.joint_names])
    square = job.fits.validation_errors(twins, [base])[0].mse[joints].mean()
    return math.sqrt(max(float(square) - job.case.noise**2, 0.0))


def _fit_with(
    fits: Fits, twins: TwinProblem, base: Fitted, effects: Sequence[type[Effect]], truth: dict[str, Any]
) -> Fitted:
    """The model that knows which effects there are; its search starts at the usual place."""
    model, physical = base.model, base.model.to_physical(base.x)
    for effect in effects:
        has = torch.tensor([name in str(truth["effects"][effect.name]) for name in twins.joint_names])
        model, physical = model.extended(physical, effect, has, model.at_point(effect, {}))
    return fits.coarse_to_fine(twins, [Fitted.start(model, physical)])[0]


def _rms(errors: BlockErrors) -> float:
    return float(errors.mse.mean().sqrt())
