"""A look at the recordings before anything is concluded from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from pace_actuators.joint_units import JOINT_TYPES, JointType, units_for
from pace_actuators.text import plural
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, JudgingCfg
from pace_optim.estimate.error_bars.physics_step import step_error
from pace_optim.joints.fits.base_fit import whole_robot
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.simulation.problem import TwinProblem
from pace_optim.problem.problem import Problem
from pace_optim.recording import Recording
from pace_optim.recording.dataset import session_starts
from pace_optim.recording.noise import NoiseFloor, noise_floor
from pace_optim.run.result import FitResult


@dataclass(frozen=True, kw_only=True, eq=False)
class DataCheck:
    """What the recordings can show."""

    floor: torch.Tensor
    """Noise and step error combined, (n,) [rad]. Where the run's own physics step already reaches this floor it
    is raised to what the base model leaves here: the recording is of a simulation."""
    noise: torch.Tensor
    """(n,) [rad]."""
    sentences: list[str] = field(default_factory=list)
    loads: int = 1
    """Number of different loads."""
    gains: int = 1
    """Number of different gains."""


def noise_floors(recordings: Sequence[Recording]) -> list[list[NoiseFloor]]:
    """The noise of each joint in each recording."""
    every = [(recording.dof_pos.T, float(np.median(np.diff(recording.time)))) for recording in recordings]
    return [[noise_floor(position, dt) for position in positions] for positions, dt in every]


def encoder_steps(floors: Sequence[Sequence[NoiseFloor]], names: Sequence[str]) -> dict[str, float]:
    """The steps of positions, {joint: rad}; those finer than the noise are the last digit of a file."""
    every = ((name, floor) for own in floors for name, floor in zip(names, own, strict=True))
    return {name: floor.lattice for name, floor in every if floor.lattice is not None and floor.lattice > floor.sigma}


def check_data(
    fits: Fits,
    problem: Problem,
    twins: TwinProblem,
    base: Fitted,
    run: FitResult | None = None,
    *,
    cfg: JudgingCfg = DEFAULT.judging,
) -> DataCheck:
    """Noise, encoder steps and the numerical floor of each joint; how many loads and gains there are.

    Args:
        fits: Computes errors.
        problem: The whole robot with the base model.
        twins: Its joints simulated alone.
        base: The base model, fitted to them.
        run: The whole robot's own fit. Where its base model is at the floor with its own physics step, what another
            step leaves comes from the step: recordings of a simulation are such.
        cfg: What is at the floor.
    """
    data, names, types = problem.dataset, problem.joint_names, problem.joint_types
    floors = noise_floors(data.recordings)
    noise = torch.tensor(np.sqrt(np.mean([[each.sigma**2 for each in own] for own in floors], axis=0)))
    numerical = step_error(*whole_robot(problem, base), data.validation)
    sentences = [
        f"Measurement noise: {_by_type(noise, types, _span)}; halving "
        f"the physics step of {1e3 * problem.physics_dt:g} ms changes the simulation by up to "
        f"{_by_type(numerical, types, _largest)}.",
    ]
    if steps := encoder_steps(floors, names):
        coarse = max(steps, key=lambda name: steps[name])
        unit = units_for("mrad", [types[names.index(coarse)]])
        sentences.append(f"The encoders show steps, the largest {1e3 * steps[coarse]:.2g} {unit} ({coarse}).")
    loads = {_key(*vars(r.load).values()) for r in data.recordings}
    gains = {_key(r.drive.stiffness, r.drive.damping) for r in data.recordings}
    sentences.append(
        f"{plural(len(data.recordings), 'recording')} with {plural(len(loads), 'load')} and "
        f"{plural(len(gains), 'set')} of gains."
    )
    sentences += unstamped(data.recordings)
    floor = (noise**2 + numerical**2).sqrt()
    same = run is not None and bool(run.effects) == bool(base.model.effects)
    if run is not None and same and not math.isclose(run.physics_dt, problem.physics_dt):
        by_run = torch.tensor([run.rmse["validation"].get(name, math.inf) for name in names])
        left = fits.validation_errors(twins, [base])[0].mse.sqrt()
        at_floor = cfg.alike * floor
        by_step = (by_run <= at_floor) & (left > at_floor)
        if bool(by_step.any()):
            floor = torch.where(by_step, left, floor)
            sentences.append(
                f"With the run's physics step of {1e3 * run.physics_dt:g} ms its model leaves no more than noise on "
                f"{', '.join(name for name, yes in zip(names, by_step.tolist(), strict=True) if yes)}. What "
                f"{1e3 * problem.physics_dt:g} ms leave there comes from the step and counts as noise: recordings of a "
                "simulation are such."
            )
    return DataCheck(
        floor=floor,
        noise=noise,
        sentences=sentences,
        loads=len(loads),
        gains=len(gains),
    )


def unstamped(recordings: Sequence[Recording]) -> list[str]:
    """What is assumed of when recordings were made, where nothing says it."""
    if len(recordings) < 2 or any(session_starts(recordings)[1]):
        return []
    return [
        "No time stamps state when they were made, so they are taken as made in a row, in this order. If the drives "
        "were cold before each, diagnose one recording alone."
    ]


def _by_type(values: torch.Tensor, types: Sequence[JointType], say: Callable[[torch.Tensor, str], str]) -> str:
    """Values of all joints [rad, of slides m], those that turn and those that slide each for themselves."""
    own = {kind: torch.tensor([each == kind for each in types]) for kind in JOINT_TYPES if kind in types}
    return " and ".join(say(1e3 * values[where], units_for("mrad", [kind])) for kind, where in own.items())


def _span(values: torch.Tensor, unit: str) -> str:
    lowest, highest = f"{float(values.min()):.2g}", f"{float(values.max()):.2g}"
    return f"{lowest} {unit}" if lowest == highest else f"{lowest} to {highest} {unit} by joint"


def _largest(values: torch.Tensor, unit: str) -> str:
    return f"{float(values.max()):.2g} {unit}"


def _key(*values: object) -> str:
    return repr([_plain(value) for value in values])


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return dict(value) if isinstance(value, Mapping) else value
