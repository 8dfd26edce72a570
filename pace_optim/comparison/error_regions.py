"""The places where a joint's error sits, the one that says most first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pace_actuators.joint_units import JointType
from pace_actuators.text import percent, position_text, position_unit

from .dimensions import Dimension
from .regions import Layout, Region, best_region, evidence, inside, refine
from .words import STANDING, band_text, place_text

AT_THE_FLOOR = 1.1
"""An error up to this many times its floor counts as noise."""
NEGLIGIBLE = 1e-6
"""Errors below this are negligible [rad]."""
MOST_PLACES = 3
_CONSTANT, _STANDING = 0.75, 0.5
"""An error is called nearly constant where its mean holds this part of its square, and one at standstill where that
does: plainer than any region."""
CONSTANT = "constant"
"""Stands in place of a dimension where the mean holds the error."""
_OVERLAP = 0.5
_COARSE = ("recording", "time")
"""Say which data, not what is wrong: named after everything else."""
_PLAINNESS = {
    "recording": 0.1,
    "acceleration": 0.75,
    "acceleration_size": 0.8,
    "velocity": 0.85,
    "load": 0.85,
    "load_size": 0.9,
    "position": 0.9,
    "time": 0.6,
}
"""Of two places that say about as much, the one that is easier to act on comes first; 1 where not listed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """Where a part of one joint's error is."""

    joint: str
    by: tuple[str, ...]
    """Dimensions that bound it; ``frequency`` stands alone."""
    text: str
    """Where it is, in words."""
    share: float
    """Of the joint's squared error above the floor."""
    base: float
    """Of the time; of a frequency band, of the octaves; 0 of a constant."""
    weight: float
    """Squared error that is there beyond its share of the time, mean over all samples [rad²]."""
    mask: np.ndarray | None
    """Samples in it, (K,) bool; ``None`` of a frequency band."""

    @property
    def sentence(self) -> str:
        """For a person."""
        if self.by == (CONSTANT,):
            return f"{self.joint}: {self.text}"
        of = "of the band, in octaves" if self.by == ("frequency",) else "of the time"
        return (
            f"{self.joint}: {percent(self.share)} of the remaining error lies {self.text} ({percent(self.base)} {of})."
        )


def places_of(
    joint: str,
    error: np.ndarray,
    floor: np.ndarray,
    dimensions: Sequence[Dimension],
    layouts: Sequence[Layout],
    bands: tuple[np.ndarray, np.ndarray, np.ndarray],
    recordings: Sequence[str],
    joint_type: JointType = "hinge",
) -> list[Place]:
    """A joint's places, each in other dimensions than the ones before; empty where the error is spread evenly.

    Args:
        error: All recordings', (K,) [rad].
        floor: σ at each sample, (K,) [rad].
        bands: Edges (B + 1,) [Hz], and shares (B,) of the octaves and of the error above the floor.
        recordings: Their names.
        joint_type: Whether the joint turns or slides.
    """
    above = error**2 - floor**2
    total = max(float(above.mean()), 0.0)
    if plain := _plain(joint, error, above, dimensions, joint_type):
        return [plain]
    candidates: list[tuple[float, Place]] = []
    for dimension, layout in zip(dimensions, layouts, strict=True):
        region = best_region(layout.time, layout.error, dimension.neighbours)
        if region is None or not region.is_place:
            continue
        mask, by = inside(dimension, region), {dimension.name: place_text(dimension, region, recordings)}
        others = [
            (_PLAINNESS.get(other.name, 1.0), other)
            for other in dimensions
            if not _akin(other, dimension) and other.name not in _COARSE
        ]
        if dimension.name not in _COARSE and (finer := refine(above, mask, region, others)):
            other, region = finer
            mask = mask & inside(other, region)
            by[other.name] = place_text(other, region, recordings)
        value = evidence(min(region.share, 1.0), region.base) * _PLAINNESS.get(dimension.name, 1.0)
        names = sorted(by, key=lambda name: -_PLAINNESS.get(name, 1.0))
        text = ", ".join(by[name] for name in names)
        candidates.append((value, _place(joint, tuple(names), text, region, total, mask)))
    edges, octaves, share = bands
    held = np.flatnonzero(octaves)
    region = best_region(octaves[held], share[held])
    if region is not None and region.is_place:
        text = band_text(edges[held[region.first]], edges[held[region.last] + 1], edges[-1])
        value = evidence(region.share, region.base)
        candidates.append((value, _place(joint, ("frequency",), text, region, total, None)))
    candidates.sort(key=lambda candidate: -candidate[0])
    chosen: list[Place] = []
    for _, place in candidates:
        if all(_differ(place, other, above) for other in chosen):
            chosen.append(place)
    return chosen[:MOST_PLACES]


def _plain(
    joint: str, error: np.ndarray, above: np.ndarray, dimensions: Sequence[Dimension], joint_type: JointType
) -> Place | None:
    """What says more than any place: the error is nearly constant, or is there while the joint stands still."""
    total, mean = float(above.mean()), float(error.mean())
    if total <= 0:
        return None
    still = next((d.bin == 0 for d in dimensions if d.name == "speed"), np.zeros(len(error), dtype=bool))
    size = position_text(mean, [joint_type]).replace("-", "−")
    constant = (
        f"the error is nearly constant, {size} (simulated less measured): a torque, a friction or an encoder bias is "
        "missing."
    )
    at_rest = float(above[still].sum()) / (total * len(error))
    for by, text, least, share, base, mask in (
        (CONSTANT, constant, _CONSTANT, mean**2 / total, 0.0, None),
        ("speed", STANDING, _STANDING, at_rest, float(still.mean()), still),
    ):
        if share >= least and share > base:
            share = min(share, 1.0)
            return Place(joint=joint, by=(by,), text=text, share=share, base=base, weight=total * share, mask=mask)
    return None


def worst_places(places: Sequence[Sequence[Place]]) -> list[Place]:
    """The three that hold most error out of proportion: one of each joint, more where fewer than three have one.

    Args:
        places: Of each joint, the one that says most first.
    """
    with_places = [own for own in places if own]
    per_joint = 1 if len(with_places) >= MOST_PLACES else MOST_PLACES
    every = [place for own in with_places for place in own[:per_joint]]
    return sorted(every, key=lambda place: -place.weight)[:MOST_PLACES]


def joint_sentence(
    joint: str, rmse: float, floor: float, places: Sequence[Place], joint_type: JointType = "hinge"
) -> str:
    """What is to be said of a joint, honestly where there is little."""
    types = [joint_type]
    if rmse < NEGLIGIBLE:
        return f"{joint}: the error is {position_text(rmse, types)}, below what any encoder shows."
    if rmse <= AT_THE_FLOOR * floor:
        factor, unit = position_unit([rmse], types)
        return (
            f"{joint} is at the noise floor: {factor * rmse:.3g} {unit} against {factor * floor:.3g} {unit} of noise."
        )
    if places:
        return places[0].sentence
    return (
        f"{joint}: the error of {position_text(rmse, types)} ({position_text(floor, types)} of it noise) is spread "
        "evenly; no speed, position, load or frequency holds much more than its share."
    )


def _place(joint: str, by: tuple[str, ...], text: str, region: Region, total: float, mask: np.ndarray | None) -> Place:
    share = min(region.share, 1.0)
    return Place(
        joint=joint,
        by=by,
        text=text,
        share=share,
        base=region.base,
        weight=total * max(share - region.base, 0.0),
        mask=mask,
    )


def _akin(one: Dimension, other: Dimension) -> bool:
    """Whether two dimensions are one quantity, with its sign and without."""
    families = ({"speed", "velocity", "direction"}, {"load", "load_size"}, {"acceleration", "acceleration_size"})
    return one.name == other.name or any({one.name, other.name} <= family for family in families)


def _differ(one: Place, other: Place, above: np.ndarray) -> bool:
    """Whether two places hold different parts of the error."""
    if one.mask is None or other.mask is None:
        return one.mask is not other.mask
    both = float(above[one.mask & other.mask].sum())
    return both < _OVERLAP * min(float(above[one.mask].sum()), float(above[other.mask].sum()))
