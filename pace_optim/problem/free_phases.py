"""The unknowns of a free phase, taken out of its errors: where it begins, and what the accelerometer misses.

A foot leaves the ground. From there on its leg moves freely, from a position and a speed that encoders measure with an
error, under a specific force that an accelerometer measures with another. Errors e of the right model then have the
covariance

    C = σ² + A Aᵀ + B Bᵀ

with σ the encoders' noise, A the derivatives of e by the beginning, each times the standard deviation of that part of
it, and B those by the specific force in each control step, times a root of its covariance. Least squares of

    e' = s L⁻¹ e / σ,    C = σ² L Lᵀ

with s the recording's noise floor, is the estimate that knows of this (Aitken, Proceedings of the Royal Society of
Edinburgh 55, 1936). L is lower triangular in time: e' is what a sample says beyond all those before it. The beginnings
cost no parameter.

What an accelerometer misses lasts. A drive holds its torque between two control steps, and the accelerometer shows the
force at one instant of that time: its error repeats from step to step, and has a part that is a delay. So the force's
error has, along each axis, the covariance

    s_i s_k ((1 - w) δ_ik + w exp(-|i - k| / m)) + d² f'_i f'_k

with s the standard deviation that the log shows, and f' the slope of the force. On robots that trot in simulation, the
mean force less the mean of its two samples has this correlation. The angular acceleration is a slope of the
gyroscope's. It has a delay, too, and differences of white noise. Error bars know of all this. C itself has white noise
of the force and no more: to a fit that gives less weight to what is slow or late, a spring is an offset or a delay.

A phase whose errors are far above those of the leg's other phases is disturbed: a foot touched the ground, and no
contact was logged. Its covariance is multiplied by the square of the ratio of its mean square to theirs, so that it
hardly counts (iteratively reweighted least squares, Holland and Welsch, Communications in Statistics 6, 1977). Missing
physics differs from swing to swing, too, by a few times: such phases keep their weight.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy import ndimage

from pace_optim.recording.carried import Carried

_BLOCK = 160
"""Control steps of a phase whose errors are looked at together: those further apart are taken for independent."""
_FEWEST = 64
"""Samples from which the encoders' noise is estimated."""
_KEPT = 3
"""Masks of samples that are remembered."""
_LATE = 0.001
"""d: standard deviation of the force's delay [s]: one of twice that is found in the log, and warned of."""
_ALIKE = 0.85
"""w: part of the variance of the force's error that lasts ..."""
_LASTS = 10.0
"""... m: for so many control steps."""
_GROUP = 4
"""Control steps whose part that lasts is taken for one."""
_DISTURBED = 8.0
"""Times the usual mean square of a leg's phases from which one is disturbed."""
PUSH = 0.1
"""Change of the angular acceleration [rad/s²] and of the specific force [m/s²] for a derivative."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """A part of a free phase of joints that move each other."""

    recording: int
    joints: list[int]
    begin: int
    """Control step at which the phase begins: joints are there where they were measured."""
    first: int
    """First control step of the part."""
    end: int
    """One after its last."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FreePhases:
    """The free phases of a dataset, and the covariance of their errors."""

    blocks: tuple[Block, ...]
    factors: tuple[torch.Tensor, ...]
    """Of each, L with C = σ² L Lᵀ, (steps joints, steps joints)."""
    noise: torch.Tensor
    """σ, (R, n) [rad]."""
    floor: torch.Tensor
    """Noise floor of the recordings s, (R, n) [rad]: errors of the right model are brought to it."""
    expected: Callable[[int], torch.Tensor] | None = None
    """Of the block of an index, what error bars take for C / σ²: with all that lasts; ``None``: not known."""
    _known: list[tuple[torch.Tensor, torch.Tensor, list[tuple[int, int, torch.Tensor]]]] = field(default_factory=list)
    """Steps, a mask, and L there, of the last few."""

    def of_single_joints(self) -> FreePhases:
        """The same of each joint by itself, without its neighbours."""
        blocks, factors = [], []
        for block, factor in zip(self.blocks, self.factors, strict=True):
            for i, joint in enumerate(block.joints):
                own = factor[i :: len(block.joints)]
                blocks.append(replace(block, joints=[joint]))
                factors.append(torch.linalg.cholesky(own @ own.T))
        return replace(self, blocks=tuple(blocks), factors=tuple(factors), expected=None, _known=[])

    def select(self, recordings: Sequence[int]) -> FreePhases:
        """Those of some of the recordings, by index."""
        chosen = list(recordings)
        kept = [
            (replace(block, recording=chosen.index(block.recording)), factor)
            for block, factor in zip(self.blocks, self.factors, strict=True)
            if block.recording in chosen
        ]
        return self._of(kept, self.noise[chosen], self.floor[chosen])

    def on_joints(self, joints: Sequence[int]) -> FreePhases:
        """Those of some joints, by index, each by itself."""
        chosen = list(joints)
        kept = [
            (replace(block, joints=[chosen.index(block.joints[0])]), factor)
            for block, factor in zip(self.blocks, self.factors, strict=True)
            if block.joints[0] in chosen
        ]
        return self._of(kept, self.noise[:, chosen], self.floor[:, chosen])

    def _of(self, kept: Sequence[tuple[Block, torch.Tensor]], noise: torch.Tensor, floor: torch.Tensor) -> FreePhases:
        blocks, factors = zip(*kept, strict=True) if kept else ((), ())
        return replace(self, blocks=blocks, factors=factors, expected=None, noise=noise, floor=floor, _known=[])

    def taken_out(self, error: torch.Tensor, step: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
        """Errors without what beginnings and the specific force explain; changed in place.

        Args:
            error: (m, K, R, n) [rad].
            step: Control step of each of the K, ascending, (K,).
        """
        for block, (begin, end, factor) in zip(self.blocks, self._where(step, where), strict=True):
            if begin < end:
                part = error[:, begin:end, block.recording][..., block.joints]
                sigma = self.noise[block.recording, block.joints]
                left = _whitened((part / sigma).flatten(1).T, factor).T.reshape(part.shape)
                left *= self.floor[block.recording, block.joints]
                error[:, begin:end, block.recording, block.joints] = left
        return error

    def expected_of(self, step: torch.Tensor, where: torch.Tensor) -> Iterator[tuple[Block, int, int, torch.Tensor]]:
        """Of each block that counts, its rows among the steps, and the covariance of L⁻¹ e / σ for error bars.

        Args:
            step: Control step of each of the K, ascending, (K,).
        """
        if self.expected is None:
            return
        for i, (block, (begin, end, factor)) in enumerate(zip(self.blocks, self._where(step, where), strict=True)):
            if begin < end:
                own = _entries(block, step[begin:end])
                yield block, begin, end, _whitened(_whitened(self.expected(i)[own][:, own], factor).T, factor)

    def _where(self, step: torch.Tensor, where: torch.Tensor) -> list[tuple[int, int, torch.Tensor]]:
        """For each block, its rows among the steps, none where no sample counts, and L of those that count."""
        for steps, mask, known in self._known:
            if (mask is where or torch.equal(mask, where)) and torch.equal(steps, step):
                return known
        result = []
        for block, whole in zip(self.blocks, self.factors, strict=True):
            begin, end = np.searchsorted(step.numpy(), [block.first, block.end])
            at, factor = step[begin:end], whole
            counts = where[at, block.recording]
            if not bool(counts.any()):
                end = begin
            elif len(at) < block.end - block.first or not bool(counts.all()):
                own, every = _entries(block, at), counts.repeat_interleave(len(block.joints))
                part = whole[own] @ whole[own].T
                factor = torch.linalg.cholesky(torch.where(every[:, None] & every, part, torch.eye(len(own)).to(part)))
            result.append((int(begin), int(end), factor))
        self._known.append((step, where, result))
        del self._known[:-_KEPT]
        return result


def _entries(block: Block, at: torch.Tensor) -> torch.Tensor:
    """Rows of a block's matrices at control steps, joint by joint."""
    joints = len(block.joints)
    return ((at - block.first)[:, None] * joints + torch.arange(joints)).flatten()


def _whitened(columns: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
    """L⁻¹ times columns."""
    return torch.linalg.solve_triangular(factor, columns, upper=False)


def blocks_of(carried: Carried, trees: Sequence[Sequence[int]]) -> tuple[Block, ...]:
    """The free phases of joints that move each other, where all of them are free, in parts."""
    result = []
    for r in carried.moves.nonzero()[:, 0].tolist():
        for tree in trees:
            free = carried.free[:, r, list(tree)].all(dim=1).numpy()
            for (phase,) in ndimage.find_objects(ndimage.label(free)[0]):
                first, end = phase.start, phase.stop
                parts = max(1, round((end - first) / _BLOCK))
                cuts = [first + (end - first) * i // parts for i in range(parts + 1)]
                result += [
                    Block(recording=r, joints=list(tree), begin=max(0, first - 1), first=a, end=b)
                    for a, b in itertools.pairwise(cuts)
                ]
    return tuple(result)


@dataclass(frozen=True, kw_only=True, eq=False)
class PhaseProbes:
    """What to simulate to see how errors depend on beginnings and on the specific force; a row each."""

    shift: torch.Tensor
    """Changes of where joints are held: those of one joint of each tree at a time, first of positions, then of speeds;
    then none, (2 depth + 6, n, 2)."""
    push: torch.Tensor
    """Changes of the base's angular acceleration and specific force: none, then along each axis, (2 depth + 6, 6)."""

    @classmethod
    def of(cls, carried: Carried, trees: Sequence[Sequence[int]]) -> PhaseProbes:
        """As wide as what is not known of beginnings."""
        std, depth = carried.start_std.amax(dim=0), max(len(tree) for tree in trees)
        shift = torch.zeros(2 * depth + 6, *std.shape, dtype=std.dtype)
        push = torch.zeros(2 * depth + 6, 6, dtype=std.dtype)
        for kind in range(2):
            for i in range(depth):
                own = [tree[i] for tree in trees if i < len(tree)]
                shift[kind * depth + i, own, kind] = std[own, kind]
        push[2 * depth :] = PUSH * torch.eye(6, dtype=std.dtype)
        return cls(shift=shift, push=push)


def _lasting(white: torch.Tensor) -> torch.Tensor:
    """What the part of the force's error that lasts does, a root of its covariance, (3 groups, count joints).

    Args:
        white: What the force's error in each control step does, (3, steps, count joints).
    """
    groups = torch.nn.functional.pad(white, (0, 0, 0, -white.shape[1] % _GROUP))
    groups = groups.unflatten(1, (-1, _GROUP)).sum(dim=2)
    at = _GROUP * torch.arange(groups.shape[1], dtype=white.dtype)
    root = torch.linalg.cholesky(_ALIKE * torch.exp(-(at[:, None] - at).abs() / _LASTS))
    return (root.T @ groups).flatten(0, 1)


def _felt(kick: torch.Tensor, history: int, count: int) -> torch.Tensor:
    """What a push in each control step does later, (6, steps, count joints).

    Args:
        kick: What one does in the steps after it, (6, steps, joints).
        history: Steps before the first of ``count``.
        count: Steps at which it is felt; a push in the last of them is not.
    """
    steps, (axes, known, joints) = history + count - 1, kick.shape
    padded = kick.new_zeros(axes, count - 1 + max(known, history + count - 1), joints)
    padded[:, count - 1 : count - 1 + known] = kick  # the row of a step is that of the one after it, a step later
    row, column = padded.stride(1), padded.stride(2)
    rows = padded.as_strided((axes, steps, count, joints), (padded.stride(0), row, row, column))
    return rows.flip(1).flatten(2)


def _white(series: torch.Tensor) -> torch.Tensor:
    """Standard deviation of the white noise on series (T, …), by the median size of fourth differences; NaN: left out.

    White noise of standard deviation σ leaves √70 σ. A foot that hits the ground leaves a few large ones.
    """
    return 1.4826 / 70**0.5 * series.diff(n=4, dim=0).abs().nanmedian(dim=0).values


def encoder_noise(carried: Carried, error: torch.Tensor) -> torch.Tensor:
    """The encoders' noise, by what errors of free joints have that no motion has, (R, n) [rad].

    Args:
        error: Of a candidate, at all control steps, (T, R, n) [rad].
    """
    free, usual = carried.free[: len(error)], carried.start_std[..., 0]
    noise = _white(torch.where(free, error, torch.nan))
    known = (free.sum(dim=0) >= _FEWEST) & (noise > 0) & (usual > 0)
    return torch.where(known, noise, usual)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Influence:
    """What beginnings and the base's motion do to errors."""

    carried: Carried
    change: torch.Tensor
    """What :class:`PhaseProbes` change of what encoders show, (2 depth + 6, T, R, n)."""
    noise: torch.Tensor
    """Of the encoders, (R, n) [rad]."""
    gyroscope: torch.Tensor
    """Its noise, (R, 3) [rad/s]."""
    slope: torch.Tensor
    """Change of the angular acceleration and the specific force in a control step, (T - 1, R, 6)."""
    control_dt: float
    """[s]."""

    def covariances(self, block: Block) -> tuple[torch.Tensor, torch.Tensor]:
        """C / σ² of a block, and what error bars take for it."""
        carried, r, joints = self.carried, block.recording, block.joints
        depth, sigma, most = (len(self.change) - 6) // 2, self.noise[r, joints], carried.start_std.amax(dim=0)
        rows = [kind * depth + i for kind in range(2) for i in range(len(joints))]
        scale = torch.cat([carried.start_std[r, joints, kind] / most[joints, kind] for kind in range(2)])
        begun = scale[:, None, None] * self.change[rows][:, block.first : block.end, r][..., joints] / sigma
        response = self.change[2 * depth :, block.begin : block.end, r][..., joints] / (PUSH * sigma)
        kick = response.diff(dim=1)[:, : 2 * _BLOCK]  # of a push that lasts a step, steps after its beginning
        history = min(block.first - block.begin, 2 * _BLOCK)
        steps = torch.arange(block.first - history, block.end - 1)
        felt = _felt(kick, history, block.end - block.first)
        white = felt[3:] * carried.force_std[steps, r].T[:, :, None]
        pushed = white.flatten(0, 1)
        begun, pushed = begun.flatten(1), pushed.T @ pushed
        own = torch.eye(pushed.shape[1], dtype=pushed.dtype) + begun.T @ begun
        gyroscope = self.gyroscope[r, :, None, None] / self.control_dt
        turned = torch.nn.functional.pad(felt[:3], (0, 0, 1, 1)).diff(dim=1) * gyroscope
        late = _LATE / self.control_dt * (felt * self.slope[steps, r].T[:, :, None]).sum(dim=1)
        every = torch.cat([late, turned.flatten(0, 1), _lasting(white)])
        return own + pushed, own + (1 - _ALIKE) * pushed + every.T @ every


def free_phases(
    carried: Carried, trees: Sequence[Sequence[int]], change: torch.Tensor, error: torch.Tensor, control_dt: float
) -> FreePhases:
    """The phases, and the covariances of their errors.

    A push in a control step moves a joint later as one in the first step of the phase does: a leg changes its posture
    little while it remembers a push.

    Args:
        change: What :class:`PhaseProbes` change of what encoders show at all control steps, (2 depth + 6, T, R, n).
        error: Of the candidate without those changes, (T, R, n) [rad].
    """
    turning = carried.base[..., :3].diff(dim=0) / control_dt
    influence = _Influence(
        carried=carried,
        change=change,
        noise=encoder_noise(carried, error),
        gyroscope=_white(carried.base[..., :3]),
        slope=torch.cat([turning.diff(dim=0, append=turning[-1:]), carried.base[..., 3:].diff(dim=0)], dim=-1),
        control_dt=control_dt,
    )
    blocks, factors, square = blocks_of(carried, trees), [], []
    for block in blocks:
        covariance, expected = influence.covariances(block)
        factors.append(torch.linalg.cholesky(covariance))
        square.append(_mean_square(block, expected, error, influence.noise))
    wide = _disturbed(blocks, square)
    return FreePhases(
        blocks=blocks,
        factors=tuple(factor * own**0.5 for factor, own in zip(factors, wide, strict=True)),
        noise=influence.noise,
        floor=carried.start_std[..., 0],
        expected=lambda i: wide[i] * influence.covariances(blocks[i])[1],
    )


def _mean_square(block: Block, covariance: torch.Tensor, error: torch.Tensor, noise: torch.Tensor) -> float:
    """Of a block's errors (T, R, n), over what a covariance C / σ² expects."""
    own = error[block.first : block.end, block.recording][:, block.joints] / noise[block.recording, block.joints]
    own = own.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0).flatten()[:, None]
    return float(_whitened(own, torch.linalg.cholesky(covariance)).square().mean())


def _disturbed(blocks: Sequence[Block], square: Sequence[float]) -> list[float]:
    """What the covariance of each block is multiplied by: more than 1 where its errors are far above its leg's.

    Args:
        square: Of each, the mean square of its errors over what is expected.
    """
    legs: dict[tuple[int, ...], list[float]] = {}
    for block, each in zip(blocks, square, strict=True):
        legs.setdefault(tuple(block.joints), []).append(each)
    usual = {leg: max(1.0, float(np.median(values))) for leg, values in legs.items()}
    return [
        max(1.0, (each / (_DISTURBED * usual[tuple(block.joints)])) ** 2)
        for block, each in zip(blocks, square, strict=True)
    ]
