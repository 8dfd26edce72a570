"""Everything about one joint: its error, its floor, and where what lies above the floor sits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from pace_actuators.joint_units import JointType
from pace_optim.recording.noise import NoiseFloor, noise_floor, with_repetitions
from pace_optim.run.tensors import rms

from .dimensions import Dimension, Motion, dimensions_of, motion_of
from .error_regions import AT_THE_FLOOR, NEGLIGIBLE, Place, joint_sentence, places_of
from .regions import lay_out
from .tracks import Track
from .words import band_text

_BANDS_PER_OCTAVE = 3
_FEWEST_LINES = 5
_COHERENT = 0.8
_LEAST_POWER = 1e-4
"""Of the strongest band of the command."""


def band_edges(duration: float, dt: float) -> np.ndarray:
    """Edges of thirds of octaves from the slowest to the fastest frequency that recordings hold, (B + 1,) [Hz]."""
    low, high = 1 / duration, 0.5 / dt
    count = max(1, int(np.ceil(_BANDS_PER_OCTAVE * np.log2(high / low))))
    edges = high * 2.0 ** (np.arange(-count, 1) / _BANDS_PER_OCTAVE)
    edges[0] = 0.0
    return edges


def band_power(values: np.ndarray, dt: float, edges: np.ndarray) -> np.ndarray:
    """Σ values² by band, (B,): it sums to that of all samples (Parseval), the mean being in the lowest.

    Args:
        values: (K,).
        dt: Sample time [s].
        edges: (B + 1,) [Hz].
    """
    spectrum = np.fft.rfft(values)
    power = np.abs(spectrum) ** 2 / len(values)
    power[1 : (len(values) + 1) // 2] *= 2  # a line stands for its mirror image, too
    which = np.searchsorted(edges[1:-1], np.fft.rfftfreq(len(values), dt), side="right")
    return np.bincount(which, weights=power, minlength=len(edges) - 1)


def response(command: np.ndarray, measured: np.ndarray, simulated: np.ndarray, dt: float) -> dict[str, Any] | None:
    """From command to position, of the measurement and of the model.

        H₁(f) = S_dq / S_dd,  coherence γ² = |S_dq|² / (S_dd S_qq)

    with spectra averaged over a sixth of an octave, at least five lines. Only where the command has power; phases are
    unwrapped along the frequency.

    Args:
        command: (K,) [rad].
        measured: (K,) [rad].
        simulated: (K,) [rad].
        dt: Sample time [s].
    """
    spectrum = _periodic_spectrum(command)
    if len(spectrum) < 2 * _FEWEST_LINES or not np.abs(spectrum).max() > 0:
        return None
    power = np.abs(spectrum) ** 2
    starts = _band_starts(len(spectrum))
    mean_power = np.add.reduceat(power, starts) / np.diff([*starts, len(spectrum)])
    keep = mean_power > _LEAST_POWER * mean_power.max()
    frequency = np.add.reduceat(np.arange(1, len(spectrum) + 1) * power, starts) / np.add.reduceat(power, starts)
    result: dict[str, Any] = {"frequency": (frequency / (len(command) * dt))[keep]}
    for name, position in (("measured", measured), ("model", simulated)):
        other = _periodic_spectrum(position)
        cross = np.add.reduceat(np.conj(spectrum) * other, starts)[keep]
        own, its = (np.add.reduceat(p, starts)[keep] for p in (power, np.abs(other) ** 2))
        gain = cross / own
        result[name] = {
            "magnitude_db": 20 * np.log10(np.maximum(np.abs(gain), 1e-12)),
            "phase_deg": np.degrees(np.unwrap(np.angle(gain))),
            "coherence": np.abs(cross) ** 2 / np.maximum(own * its, 1e-300),
        }
    if not len(result["frequency"]):
        return None
    difference = result["model"]["phase_deg"] - result["measured"]["phase_deg"]
    result["model"]["phase_deg"] = result["model"]["phase_deg"] - 360 * np.round(difference.mean() / 360)
    return result | {"largest": _largest_differences(result)}


def _largest_differences(response: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Where the model is the furthest from the measurement, among the frequencies at which both are coherent."""
    measured, model = response["measured"], response["model"]
    sure = np.flatnonzero(np.minimum(measured["coherence"], model["coherence"]) > _COHERENT)
    result = {}
    for name in ("magnitude_db", "phase_deg"):
        if len(sure):
            difference = (model[name] - measured[name])[sure]
            at = int(np.argmax(np.abs(difference)))
            result[name] = {"difference": difference[at], "frequency": response["frequency"][sure[at]]}
    return result


def narrowest_band(share: np.ndarray, least: float = 0.6) -> tuple[int, int] | None:
    """The fewest neighbouring bands, first and last, that hold at least a share; ``None`` if all hold nothing."""
    total = np.concatenate([[0.0], np.cumsum(share)])
    for width in range(1, len(share) + 1):
        held = total[width:] - total[:-width]
        if held.max() >= least:
            first = int(held.argmax())
            return first, first + width - 1
    return None


def _periodic_spectrum(values: np.ndarray) -> np.ndarray:
    """Lines 1, 2, … of what remains without the straight line from the first to the last value: no jump leaks."""
    line = np.linspace(values[0], values[-1], len(values))
    rest = values - line
    return np.fft.rfft(rest - rest.mean())[1:]


def _band_starts(lines: int) -> list[int]:
    """Where bands begin among the lines: a sixth of an octave each, at least five lines."""
    starts, start = [], 0
    while lines - start >= _FEWEST_LINES:
        starts.append(start)
        start = max(start + _FEWEST_LINES, int(np.ceil((start + 1) * 2 ** (1 / 6))) - 1)
    return starts


_LAGS = 20
_DRAWN = 40


def whiteness(error: np.ndarray, dt: float) -> dict[str, Any]:
    """Autocorrelation of an error, and what follows from it.

        ρ_l = Σ e_k e_{k+l} / Σ e_k²
        Q = K (K + 2) Σ_l ρ_l² / (K − l), l = 1 … 20   (Ljung and Box 1978)

    With tens of thousands of samples Q rejects even nearly white errors, so two sizes stand beside it. ``predictable``
    is ρ₁², the share of the variance that the sample before explains. ``correlation_time`` is dt (1 + 2 Σ ρ_l), up to
    the first ρ_l below zero: dt for white noise.

    Args:
        error: (K,) [rad].
        dt: Sample time [s].
    """
    rho = autocorrelation(error)
    lags = min(_LAGS, len(rho) - 1)
    l = np.arange(1, lags + 1)
    q = len(error) * (len(error) + 2) * float(np.sum(rho[1 : lags + 1] ** 2 / (len(error) - l)))
    below = np.flatnonzero(rho < 0)
    end = int(below[0]) if len(below) else len(rho)
    drawn = np.unique(np.round(np.geomspace(1, len(rho), _DRAWN)).astype(int) - 1)
    return {
        "lag_1": float(rho[1]),
        "predictable": float(rho[1] ** 2),
        "correlation_time": dt * (1 + 2 * float(rho[1:end].sum())),
        "ljung_box": {"q": q, "lags": lags, "p": float(stats.chi2.sf(q, lags))},
        "lag": drawn * dt,
        "autocorrelation": rho[drawn],
    }


def autocorrelation(error: np.ndarray) -> np.ndarray:
    """ρ_l for lags up to half of the samples, the mean taken away; 1, 0, 0, … of a constant."""
    rest = error - error.mean()
    size = 1 << (2 * len(rest) - 1).bit_length()
    product = np.fft.irfft(np.abs(np.fft.rfft(rest, size)) ** 2, size)[: max(2, len(rest) // 2)]
    if product[0] <= 0:
        return np.eye(1, len(product))[0]
    return product / product[0]


_BINS = 24
_FEWEST = 8


def hysteresis(motion: Motion, offset: np.ndarray, error: np.ndarray) -> dict[str, Any]:
    """Means by position, on the way up and on the way down.

    Of a proportional controller, the offset q* − q of target and position is its torque by the gain: friction opens
    its loop. Where the loops of measurement and model differ in width, friction differs; where they lean another way,
    gravity, a spring or a gain does.

    Args:
        motion: Of the joint; samples where it stands are left out.
        offset: Measured q* − q, (K,) [rad].
        error: Simulated less measured, (K,) [rad].
    """
    moving = np.abs(motion.speed) > motion.standstill
    if moving.sum() < 2 * _BINS:
        return {}
    low, high = np.quantile(motion.position[moving], (0.005, 0.995))
    if not high > low:
        return {}
    edges = np.linspace(low, high, _BINS + 1)
    bins = np.searchsorted(edges[1:-1], motion.position, side="right")
    within = moving & (motion.position >= low) & (motion.position <= high)
    result: dict[str, Any] = {"position": (edges[1:] + edges[:-1]) / 2}
    for name, values in (("measured", offset), ("model", offset - error), ("error", error)):
        ways = {
            way: _means(values, bins, within & (motion.direction == sign)) for way, sign in (("up", 1), ("down", -1))
        }
        half = (ways["up"] - ways["down"]) / 2
        width = float(np.sqrt(np.nanmean(half**2))) if np.isfinite(half).any() else None
        result[name] = {**ways, "half_width": width}
    return result


def _means(values: np.ndarray, bins: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Mean in each bin; NaN where there is too little."""
    count = np.bincount(bins[where], minlength=_BINS)
    total = np.bincount(bins[where], weights=values[where], minlength=_BINS)
    return np.where(count >= _FEWEST, total / np.maximum(count, 1), np.nan)


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
    is_explained: bool
    """Whether a better model could explain little more."""


def compare_joint(joint: str, j: int, tracks: Sequence[Track], joint_type: JointType = "hinge") -> JointComparison:
    """Analyse joint j of all recordings.

    Args:
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
        swings=None if any(t.swing is None for t in tracks) else [t.swing[:, j] for t in tracks if t.swing is not None],
    )
    kept = [t.counts[:, j] for t in tracks]
    dimensions = [replace(d, bin=d.bin[np.concatenate(kept)]) for d in dimensions]
    error = np.concatenate([t.error[own, j] for t, own in zip(tracks, kept, strict=True)])
    sigma = np.concatenate([np.full(own.sum(), f.sigma) for own, f in zip(kept, floors, strict=True)])
    layouts = [lay_out(error, sigma, d.bin, d.num_bins) for d in dimensions]
    edges = band_edges(max(len(t.time) * t.dt for t in tracks), min(t.dt for t in tracks))
    powers = [_spectra(t, j, f.sigma, edges) for t, f in zip(tracks, floors, strict=True)]
    pooled = {key: np.sum([p[key] for p in powers], axis=0) for key in powers[0]}
    octaves = _octaves(edges, pooled)
    in_bands = _shares(pooled["above"])
    total, floor = rms(error) or 0.0, rms(sigma) or 0.0
    places = places_of(
        joint, error, sigma, dimensions, layouts, (edges, octaves, in_bands), [t.name for t in tracks], joint_type
    )
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
    ends = np.cumsum([0, *(own.sum() for own in kept)])
    for r, (track, own_floor, motion) in enumerate(zip(tracks, floors, motions, strict=True)):
        part = slice(ends[r], ends[r + 1])
        whole, e = track.error[:, j], error[part]
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
                "response": response(track.target[:, j], position, position + whole, track.dt),
                "hysteresis": hysteresis(motion, track.target[:, j] - position, whole),
                "whiteness": whiteness(e, track.dt),
                "over_time": over_time(track.time, whole),
            }
        )
    is_explained = total < NEGLIGIBLE or total <= AT_THE_FLOOR * floor
    return JointComparison(content=content, places=told, is_explained=is_explained)


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
        errors = []
        for track in tracks:
            own = track.train if part == "train" else track.held_out
            errors.append(track.error[own][:, column][track.counts[own][:, column]])
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
    noise = track.counts[:, j].sum() * sigma**2 * lines / lines.sum()
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
