"""What is compared: each recording, measured and simulated, with what is known of its load and its repetitions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from pace_optim.estimate.error_bars.assessment import trajectories
from pace_optim.problem.evaluator import Evaluator
from pace_optim.problem.problem import Problem
from pace_optim.recording import Drive, Recording
from pace_optim.recording.carried import part_of_phase
from pace_optim.run.open import open_problem
from pace_optim.run.result import FitResult
from pace_optim.run.tensors import RecordingData, Trajectories, read_trajectory

from .drive_loads import load_torques

_SAME = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """One recording as a run simulates it: K samples of n joints."""

    name: str
    time: np.ndarray
    """(K,) [s]."""
    target: np.ndarray
    """(K, n) [rad]."""
    measured: np.ndarray
    """Encoder positions, (K, n) [rad]."""
    error: np.ndarray
    """Simulated less measured, (K, n) [rad]."""
    train: np.ndarray
    """Whether a sample was trained on, (K,) bool."""
    held_out: np.ndarray
    """Whether it was kept for validation, (K,) bool. A beginning that settles is neither."""
    load: np.ndarray | None
    """Load torque, (K, n) [N m], if it could be computed."""
    enabled: np.ndarray
    """Whether the drive gives torque, (K,) bool."""
    group: int
    """Recordings of one group repeat each other: same commands, drive and load."""
    swing: np.ndarray | None = None
    """How much of its swing each joint has behind it, 0 to 1, (K, n); NaN where the ground holds it. ``None``: the base
    rests."""

    @property
    def counts(self) -> np.ndarray:
        """Where joints are compared, (K, n) bool: where they are free (or never are), less what settles."""
        result = np.ones(self.error.shape, dtype=bool)
        if self.swing is not None:
            free = ~np.isnan(self.swing)
            result = free | ~free.any(axis=0)
        return result & (self.train | self.held_out)[:, None]

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class RunTracks:
    """A run and what it is compared on."""

    folder: Path
    result: FitResult
    physics_dt: float
    """Of the simulation [s]."""
    data: tuple[str, ...]
    """Files in place of the run's own; empty for its own."""
    tracks: tuple[Track, ...]
    notes: tuple[str, ...]
    """What could not be done."""


def load_tracks(
    folder: Path,
    data: Sequence[str] = (),
    physics_dt: float | None = None,
    task: str | None = None,
    columns: str | None = None,
    strict: bool = False,
    device: str = "cpu",
) -> RunTracks:
    """A run's best parameters on its own recordings, or on others.

    Args:
        data: Recordings to simulate in place of the run's own.
        physics_dt: Simulate at this physics step in place of the run's [s].
        task: Another environment in place of the run's.
        columns: Column map of logs among ``data``; ``None``: guessed.
        strict: Whether one of ``data`` that cannot be used refuses all, instead of being set aside.
        device: Where it is simulated; on a GPU in any case, in float32.
    """
    result = FitResult.load(folder)
    simulate = bool(data) or physics_dt is not None or task is not None or device != "cpu"
    notes: list[str] = []
    problem: Problem | None = None
    try:
        # the torque of the load does not depend on effects
        effects = None if simulate else ()
        problem = open_problem(
            folder, task=task, data=data, physics_dt=physics_dt, effects=effects, columns=columns, strict=strict
        )
    except (ValueError, KeyError, OSError) as error:
        if simulate:
            raise
        message = str(error.args[0] if isinstance(error, KeyError) else error)
        notes.append(f"The run's recordings cannot be read again, so there is no load torque: {message}")
    if simulate and problem is not None:
        evaluator = replace(problem, device=device).evaluator()
        physical = problem.space.from_dict(result.parameters)
        own = Trajectories.of(trajectories(problem, evaluator.residuals(physical[None], problem.dataset.sampled)))
    else:
        own = read_trajectory(folder)
    simulated = own.recordings
    _check_finite(folder if simulate else folder / "best_trajectory.pt", simulated)
    recordings = None if problem is None else problem.dataset.recordings
    if recordings is not None and not _are_those(recordings, simulated):
        notes.append("The run's recordings have changed since it was fitted: there is no load torque.")
        recordings = problem = None
    loads: list[np.ndarray] | None = None
    if problem is not None:
        bias = np.array([result.parameters["encoder_bias"][name] for name in problem.joint_names])
        loads = load_torques(Evaluator(problem.make_env, problem.dataset, problem.space), bias)
    groups = _groups(simulated, recordings)
    before = read_trajectory(folder).recordings if data and (folder / "best_trajectory.pt").is_file() else ()
    trained = [_trained(each, before) if data else each.train for each in simulated]
    tracks = tuple(
        Track(
            name=each.name,
            time=each.time,
            target=each.target,
            measured=each.measured,
            error=each.error,
            train=trained[r],
            held_out=(each.train | each.held_out) & ~trained[r],
            load=None if loads is None else loads[r],
            enabled=each.enabled,
            group=groups[r],
            swing=None if problem is None else _swing(problem, r, len(each.time)),
        )
        for r, each in enumerate(simulated)
    )
    return RunTracks(
        folder=folder,
        result=result,
        physics_dt=physics_dt or result.physics_dt,
        data=tuple(str(path) for path in data),
        tracks=tracks,
        notes=tuple(notes),
    )


def _swing(problem: Problem, r: int, count: int) -> np.ndarray | None:
    """How much of its swing each joint of a recording has behind it, (count, n); ``None``: its base rests."""
    recording, carried = problem.dataset.recordings[r], problem.dataset.carried
    if carried is None or not recording.base_moves:
        return None
    parts = np.stack([part_of_phase(free) for free in carried.free[:, r].numpy().T], axis=1)
    return parts[recording.sample_steps[:count]]


def _check_finite(source: Path, simulated: Sequence[RecordingData]) -> None:
    for each in simulated:
        if not np.isfinite(each.simulated).all():
            raise ValueError(
                f"{source}: the simulation of {each.name} diverges with the run's parameters, so there is nothing "
                "to compare. Fit again, with narrower bounds or a finer --physics_dt."
            )


def _are_those(recordings: Sequence[Recording], simulated: Sequence[RecordingData]) -> bool:
    """Whether files read again hold what the run was fitted to."""
    return len(recordings) == len(simulated) and all(
        _are_same(one.dof_pos, other.measured) for one, other in zip(recordings, simulated, strict=True)
    )


def _are_same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two recordings' positions are the same."""
    return one.shape == other.shape and np.allclose(one, other, rtol=0, atol=_SAME)


def _trained(one: RecordingData, before: Sequence[RecordingData]) -> np.ndarray:
    """Which samples of a recording a run was trained on: those of the same one among its own recordings."""
    same = (own.train for own in before if _are_same(one.measured, own.measured))
    return next(same, np.zeros_like(one.train))


def _groups(simulated: Sequence[RecordingData], recordings: Sequence[Recording] | None) -> list[int]:
    """A number for each recording; the same number for those that repeat each other."""
    result: list[int] = []
    for r, one in enumerate(simulated):
        twin = next((s for s in range(r) if _repeats(one, simulated[s]) and _alike(recordings, r, s)), None)
        result.append(r if twin is None else result[twin])
    return result


def _repeats(one: RecordingData, other: RecordingData) -> bool:
    length = min(len(one.time), len(other.time))
    if max(len(one.time), len(other.time)) > 1.02 * length + 1:
        return False
    pairs = ((one.time, other.time), (one.target, other.target))
    return all(np.allclose(a[:length], b[:length], rtol=0, atol=1e-6) for a, b in pairs)


def _alike(recordings: Sequence[Recording] | None, r: int, s: int) -> bool:
    """Whether two recordings state the same drive and load; without the files, the commands alone must do."""
    if recordings is None:
        return True
    one, other = recordings[r], recordings[s]
    drives = all(
        (a is None and b is None) or (a is not None and b is not None and np.array_equal(a, b))
        for a, b in ((getattr(one.drive, f.name), getattr(other.drive, f.name)) for f in fields(Drive))
    )
    return drives and vars(one.load) == vars(other.load)
