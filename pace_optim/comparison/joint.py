"""Everything about one joint: its error, its floor, and where what lies above the floor sits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pace_actuators.joint_units import JointType
from pace_optim.recording.noise import NoiseFloor, noise_floor, with_repetitions
from pace_optim.run.tensors import rms

from .dimensions import Dimension, dimensions_of
from .frequency import band_edges, band_power, narrowest_band, response
from .hysteresis import hysteresis
from .motion import motion_of
from .places import Place, joint_sentence, places_of
from .regions import lay_out
from .tracks import Track
from .whiteness import whiteness
from .words import band_text

_STRETCHES = 240
_EXCITED = 0.01
"""Bands between the first and the last percent of the motion count when octaves are compared."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JointComparison:
    """One joint."""

    content: dict[str, Any]
    """For comparison.json."""
    places: list[Place]
    """Where its error sits; empty at the noise floor."""


def compare_joint(joint: str, j: int, tracks: Sequence[Track], joint_type: JointType = "hinge") -> JointComparison:
    """Analyse joint j of all recordings.

    Args:
        joint: Its name.
        j: Its index.
        tracks: The recordings.
        joint_type: Whether it turns or slides.
    """
    floors = noise_floors(j, tracks)
    motions = [motion_of(t.measured[:, j], t.dt, f.sigma) for t, f in zip(tracks, floors, strict=True)]
    loads = [t.load[:, j] for t in tracks if t.load is not None]
    dimensions = dimensions_of(
        motions,
        [t.time for t in tracks],
        loads if len(loads) == len(tracks) else None,
        [t.enabled for t in tracks],
        joint_type=joint_type,
    )
    error = np.concatenate([t.error[:, j] for t in tracks])
    sigma = np.concatenate([np.full(len(t.time), f.sigma) for t, f in zip(tracks, floors, strict=True)])
    layouts = [lay_out(error, sigma, d.bin, d.num_bins) for d in dimensions]
    edges = band_edges(max(len(t.time) * t.dt for t in tracks), min(t.dt for t in tracks))
    powers = [_spectra(t, j, f.sigma, edges) for t, f in zip(tracks, floors, strict=True)]
    pooled = {key: np.sum([p[key] for p in powers], axis=0) for key in powers[0]}
    octaves = _octaves(edges, pooled)
    in_bands = _shares(pooled["above"])
    total, floor = rms(error) or 0.0, rms(sigma) or 0.0
    places = places_of(joint, error, sigma, dimensions, layouts, (edges, octaves, in_bands), [t.name for t in tracks])
    sentence = joint_sentence(joint, total, floor, places, joint_type)
    told = places if places and sentence == places[0].sentence else []
    content: dict[str, Any] = {
        "type": joint_type,
        "rmse": rmse_by_part(tracks, j),
        "noise_floor": floor,
        "share_above_floor": share_above(total, floor),
        "sentence": sentence,
        "places": [place_content(place) for place in told],
        "where": _where(dimensions, layouts) | {"frequency": _band_content(edges, pooled, octaves)},
        "recordings": [],
    }
    ends = np.cumsum([0, *(len(t.time) for t in tracks)])
    for r, (track, own_floor, motion) in enumerate(zip(tracks, floors, motions, strict=True)):
        part = slice(ends[r], ends[r + 1])
        e = track.error[:, j]
        own = [lay_out(e, sigma[part], d.bin[part], d.num_bins) for d in dimensions]
        position = track.measured[:, j]
        content["recordings"].append(
            {
                "name": track.name,
                "rmse": rmse_by_part([track], j),
                "noise_floor": own_floor.sigma,
                "noise_source": own_floor.source,
                "lattice": own_floor.lattice,
                "share_above_floor": share_above(rms(e) or 0.0, own_floor.sigma),
                "where": _where(dimensions, own) | {"frequency": _band_content(edges, powers[r], octaves)},
                "response": response(track.target[:, j], position, position + e, track.dt),
                "hysteresis": hysteresis(motion, track.target[:, j] - position, e),
                "whiteness": whiteness(e, track.dt),
                "over_time": over_time(track.time, e),
            }
        )
    return JointComparison(content=content, places=told)


def noise_floors(j: int, tracks: Sequence[Track]) -> list[NoiseFloor]:
    """Of joint j in each recording; from repetitions where there are any."""
    floors = [noise_floor(track.measured[:, j], track.dt) for track in tracks]
    for group in {track.group for track in tracks}:
        members = [r for r, track in enumerate(tracks) if track.group == group]
        if len(members) > 1:
            better = with_repetitions([floors[r] for r in members], [tracks[r].measured[:, j] for r in members])
            for r, floor in zip(members, better, strict=True):
                floors[r] = floor
    return floors


def rmse_by_part(tracks: Sequence[Track], j: int | None = None) -> dict[str, float]:
    """Root mean square error of joint j, or of all joints, on training and validation data [rad]; parts that exist."""
    column = slice(None) if j is None else j
    result = {}
    for part in ("train", "validation"):
        errors = [t.error[t.train if part == "train" else ~t.train][:, column].ravel() for t in tracks]
        if (value := rms(np.concatenate(errors))) is not None:
            result[part] = value
    return result


def share_above(rmse: float, floor: float) -> float:
    """Share of the squared error that noise does not explain: 1 − σ²/MSE, not below 0."""
    return max(0.0, 1.0 - (floor / rmse) ** 2) if rmse > 0 else 0.0


def place_content(place: Place) -> dict[str, Any]:
    """A place for comparison.json."""
    return {
        "joint": place.joint,
        "sentence": place.sentence,
        "by": list(place.by),
        "share_of_error": place.share,
        "share_of_time" if place.by != ("frequency",) else "share_of_octaves": place.base,
    }


def over_time(time: np.ndarray, error: np.ndarray) -> dict[str, np.ndarray]:
    """Lowest and highest error and its root mean square in each of 240 stretches."""
    count = min(_STRETCHES, len(error))
    starts = np.linspace(0, len(error), count, endpoint=False).astype(int)
    size = np.diff([*starts, len(error)])
    return {
        "time": np.add.reduceat(time - time[0], starts) / size,
        "low": np.minimum.reduceat(error, starts),
        "high": np.maximum.reduceat(error, starts),
        "rms": np.sqrt(np.add.reduceat(error**2, starts) / size),
    }


def _spectra(track: Track, j: int, sigma: float, edges: np.ndarray) -> dict[str, np.ndarray]:
    """Σ of squares by band: of the error, of white noise at the floor, of what is above it, of the motion."""
    count = len(track.time)
    error = band_power(track.error[:, j], track.dt, edges)
    lines = np.histogram(np.fft.rfftfreq(count, track.dt), bins=[*edges[:-1], np.inf])[0]
    noise = count * sigma**2 * lines / lines.sum()
    position = track.measured[:, j]
    return {
        "error": error,
        "noise": noise,
        "above": np.maximum(error - noise, 0.0),
        "motion": band_power(position - position.mean(), track.dt, edges),
        "samples": np.array([float(count)]),
    }


def _octaves(edges: np.ndarray, pooled: dict[str, np.ndarray]) -> np.ndarray:
    """Share of each band in the octaves that count: those that hold the motion or the error."""
    use = np.zeros(len(edges) - 1, dtype=bool)
    for key in ("motion", "above"):
        inner = np.cumsum(_shares(pooled[key]))
        use |= (inner >= _EXCITED) & (np.concatenate([[0.0], inner[:-1]]) <= 1 - _EXCITED)
    held = np.flatnonzero(use)
    octaves = np.zeros(len(use))
    if len(held):
        octaves[held[0] : held[-1] + 1] = 1.0
    return _shares(octaves)


def _shares(values: np.ndarray) -> np.ndarray:
    return values / values.sum() if values.sum() > 0 else np.zeros_like(values)


def _where(dimensions: Sequence[Dimension], layouts: Sequence[Any]) -> dict[str, Any]:
    return {
        d.name: {
            "title": d.title,
            "unit": d.unit,
            "edges": list(d.edges),
            "time": layout.time,
            "error": layout.error,
            "rms": layout.rms,
            "mean": layout.mean,
        }
        for d, layout in zip(dimensions, layouts, strict=True)
    }


def _band_content(edges: np.ndarray, power: dict[str, np.ndarray], octaves: np.ndarray) -> dict[str, Any]:
    count = float(power["samples"].sum())
    share = _shares(power["above"])
    held = narrowest_band(share)
    return {
        "most": None if held is None else band_text(edges[held[0]], edges[held[1] + 1], edges[-1]),
        "most_share": None if held is None else float(share[held[0] : held[1] + 1].sum()),
        "title": "frequency",
        "unit": "Hz",
        "edges": edges,
        "octaves": octaves,
        "error": share,
        "motion": _shares(power["motion"]),
        "rms": np.sqrt(power["error"] / count),
        "noise_rms": np.sqrt(power["noise"] / count),
    }
