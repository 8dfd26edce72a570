"""From parameter vectors to residuals: what an optimizer sees of the simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch

from pace_envs.tasks.pace import TORQUE_OFFSET, TORQUE_SCALE
from pace_optim.problem.free_phases import FreePhases, PhaseProbes, free_phases
from pace_optim.problem.parameter_space import Colouring, ParameterSpace, colour
from pace_optim.problem.rollout import Rollout
from pace_optim.recording.dataset import Dataset, Torques
from pace_optim.recording.noise import LEAST_NOISE, noise_variance

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv

_WIDEST = 512


@dataclass(frozen=True, kw_only=True, eq=False)
class Prior:
    """What is known of parameters before the recordings, of m candidates: Gaussians around 0, normalised.

    With the noise σ of a sample, Σ_samples error² + σ² Σ_i (x_i / std_i)² is least at the most probable parameters.
    """

    x: torch.Tensor
    """The candidates, normalised (m, size)."""
    precision: torch.Tensor
    """1/std², (size,); 0 where there is no prior."""
    noise: float
    """σ² [rad²]."""

    @property
    def penalty(self) -> torch.Tensor:
        """What it adds to the sum of squared errors, (m,) [rad²]."""
        return self.noise * (self.x.square() @ self.precision)

    def gradient_at(self, x: torch.Tensor) -> torch.Tensor:
        """Half of its derivative, (size,) [rad²], at a candidate (size,)."""
        return self.noise * self.precision * x

    @property
    def hessian(self) -> torch.Tensor:
        """Half of its second derivative, (size, size) [rad²]."""
        return self.noise * torch.diag(self.precision)


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals:
    """Errors q_sim - bias - q_measured of m candidates at K steps of R recordings and n joints.

    Where torques are followed too, R more columns have their errors, s τ_sim + o - τ_measured, times
    :attr:`~pace_optim.recording.dataset.Torques.weight`: all that looks at columns weighs both by their noise.
    """

    error: torch.Tensor
    """(m, K, R or 2 R, n) [rad]; zero where a recording has no sample."""
    where: torch.Tensor
    """Where there is a sample, (K, R or 2 R) bool."""
    step: torch.Tensor
    """Control step of each of the K steps, (K,)."""
    weight: torch.Tensor | None = None
    """What errors were multiplied by, (K, R, n): see :attr:`~pace_optim.recording.dataset.Dataset.weight`."""
    prior: Prior | None = None
    """Of the candidates; ``None``: no parameter has one."""
    with_torques: bool = False
    """Whether the second half of the columns are torques."""

    @property
    def num_recordings(self) -> int:
        """R."""
        return self.where.shape[1] // (1 + self.with_torques)

    @property
    def positions(self) -> Residuals:
        """Without torques."""
        count = self.num_recordings
        return replace(self, error=self.error[:, :, :count], where=self.where[:, :count], with_torques=False)

    def torque_errors(self, torques: Torques) -> tuple[torch.Tensor, torch.Tensor]:
        """Errors of the first candidate's torques [N m], and where they are known, (K, R, n) each."""
        count = self.num_recordings
        known = torques.known[self.step] & self.where[:, count:, None] & (torques.weight > 0)
        return self.error[0, :, count:] / torques.weight.clamp(min=1e-300) * known, known

    def columns_of(self, recording: int) -> list[int]:
        """Columns of a recording: its positions, and its torques."""
        return list(range(recording, self.where.shape[1], self.num_recordings))

    def rows(self, begin: int, end: int) -> Residuals:
        """Those of some of the candidates."""
        prior = None if self.prior is None else replace(self.prior, x=self.prior.x[begin:end])
        return replace(self, error=self.error[begin:end], prior=prior)

    @property
    def score(self) -> torch.Tensor:
        """Mean over the samples of Σ_joints error², (m,) [rad²], with the prior's penalty; infinite if it diverged."""
        score = self.joint_score.sum(dim=1)
        return score if self.prior is None else score + self.prior.penalty / self.where.sum()

    @property
    def joint_score(self) -> torch.Tensor:
        """Mean over the samples of error² per joint, (m, n) [rad²]."""
        total = self.error.square().sum(dim=(1, 2)) / self.where.sum()
        return total.nan_to_num(nan=torch.inf)


class Evaluator:
    """Simulates any number of candidates; environments of each batch size are built once and kept."""

    def __init__(
        self,
        make_env: Callable[[int], ManagerBasedEnv],
        dataset: Dataset,
        space: ParameterSpace,
        trees: Sequence[Sequence[str]] = (),
        phases: FreePhases | None = None,
        nearby: Evaluator | None = None,
    ):
        """Keep what is needed to build environments.

        Args:
            make_env: Builds the environment with a given number of environments.
            trees: Groups of joints that do not influence each other; none: all are one.
            phases: What is not known of free phases; ``None``: what the candidates themselves show of that.
            nearby: Simulates candidates whose differences count, at a longer physics step; ``None``: this one.
        """
        self.dataset = dataset
        self.space = space
        names = dataset.recordings[0].joint_names
        self._tree_names = trees or [names]
        self._trees = [[names.index(name) for name in tree] for tree in self._tree_names]
        self.phases = phases
        """What is not known of free phases; ``None`` where no base moves, or no candidate has been simulated yet."""
        self._phases_at: torch.Tensor | None = None
        self._noise: float | None = None
        self._make_env = make_env
        self._nearby = nearby
        self._rollouts: dict[int, Rollout] = {}

    @cached_property
    def colouring(self) -> Colouring:
        """Which entries are perturbed together."""
        return colour(self.space, self._tree_names, self.dataset.recordings[0].joint_names)

    @property
    def looks_coarser(self) -> bool:
        """Whether :meth:`look_around` simulates at a longer physics step."""
        return self._nearby is not None

    @property
    def simulated_steps(self) -> int:
        """Control steps simulated so far, over all environments."""
        own = sum(rollout.simulated_steps for rollout in self._rollouts.values())
        return own if self._nearby is None else own + self._nearby.simulated_steps

    def rollout(self, num_candidates: int) -> Rollout:
        """The rollout of that many candidates."""
        if num_candidates not in self._rollouts:
            env = self._make_env(num_candidates * self.dataset.num_recordings)
            self._rollouts[num_candidates] = Rollout(env, self.dataset, self.space)
        return self._rollouts[num_candidates]

    def look_around(
        self,
        physical: torch.Tensor,
        *,
        own_step: bool,
        initial_offset: torch.Tensor | None = None,
    ) -> tuple[Residuals, Residuals]:
        """The residuals of the first candidate (m = 1), and those of all whose differences count.

        The latter are simulated at a longer physics step where there is one, and the first candidate does not diverge.

        Args:
            own_step: Whether they are not.
            initial_offset: As for :meth:`residuals`; none for the first candidate.
        """
        if self._nearby is not None and not own_step:
            here = self.residuals(physical[:1])
            self._nearby.phases, self._nearby._phases_at = self.phases, self._phases_at
            every = self._nearby.residuals(physical, initial_offset=initial_offset)
            if bool(every.error[0].isfinite().all()):
                return here, every
        every = self.residuals(physical, initial_offset=initial_offset)
        return every.rows(0, 1), every

    def residuals(
        self,
        physical: torch.Tensor,
        where: torch.Tensor | None = None,
        initial_offset: torch.Tensor | None = None,
    ) -> Residuals:
        """Simulate candidates and keep their errors.

        Args:
            where: Which samples count, (T, R) bool; ``None`` means those to train on.
            initial_offset: Added to each recording's first position, (m, n) [rad].
        """
        self.look_at_phases(physical[0])
        widest = max(1, _WIDEST // self.dataset.num_recordings)
        offsets = [None] * len(physical) if initial_offset is None else initial_offset.split(widest)
        parts = [
            self._residuals(part, where, offset) for part, offset in zip(physical.split(widest), offsets, strict=False)
        ]
        if len(parts) == 1:
            return parts[0]
        return replace(parts[0], error=torch.cat([part.error for part in parts]), prior=self._prior(physical))

    def look_at_phases(self, physical: torch.Tensor, anew: bool = False) -> bool:
        """See how errors depend on what is not known of free phases, at a candidate: it is taken out of them.

        Nothing where no base moves. The first candidate that is simulated is one.

        Args:
            anew: Whether to do it although that is known of another candidate.

        Returns:
            Whether errors are others from now on.
        """
        at = self._phases_at
        known = self.phases is not None and (at is None or not anew)
        if self.dataset.carried is None or known or (anew and at is not None and torch.equal(at, physical)):
            return False
        for each in (self, self._nearby):
            if each is not None:
                each.phases = None  # before the next: they take much memory
        self.phases, self._phases_at = self.free_phases(physical), physical.clone()
        return True

    def free_phases(self, physical: torch.Tensor) -> FreePhases:
        """What is not known of free phases, by its influence at a candidate (size,).

        Raises:
            ValueError: If no base moves.
        """
        carried = self.dataset.carried
        if carried is None:
            raise ValueError("No base moves in these recordings: they have no free phases.")
        probes = PhaseProbes.of(carried, self._trees)
        shift, push = (torch.cat([torch.zeros_like(each[:1]), each]) for each in (probes.shift, probes.push))
        rollout = self.rollout(len(shift))
        rollout.start(physical.expand(len(shift), -1), self.dataset.sampled, shift=shift, push=push)
        shown = rollout.positions(torch.arange(rollout.duration_steps))
        shown = shown.view(len(shown), len(shift), self.dataset.num_recordings, -1)
        change = (shown[:, 1:] - shown[:, :1]).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0).permute(1, 0, 2, 3)
        bias = physical[self.space["encoder_bias"]]
        error = shown[:, 0].to("cpu", torch.float64) - bias - self.dataset.measured[: len(shown)]
        return free_phases(carried, self._trees, change, error, rollout.env.step_dt)

    def _residuals(
        self, physical: torch.Tensor, where: torch.Tensor | None, initial_offset: torch.Tensor | None
    ) -> Residuals:
        data = self.dataset
        mask = data.train if where is None else where
        step = mask.any(dim=1).nonzero()[:, 0]
        if data.torques is not None and TORQUE_SCALE in self.space.slices:
            return self._with_torques(physical, mask, step, initial_offset, data.torques)
        rollout = self.rollout(len(physical))
        rollout.start(physical, mask, initial_offset=initial_offset)
        bias = rollout.physical[:, self.space["encoder_bias"]]
        m, count, n = len(physical), data.num_recordings, bias.shape[1]
        error = rollout.positions(step).sub_(bias)
        error.view(len(step), m, count, n).sub_(rollout.dataset.measured[step][:, None])
        kept = mask[step]
        error = error.to("cpu", torch.float64).view(len(step), m, count, n)
        if not bool(kept.all()):
            error.mul_(kept[:, None, :, None])
        error = error.permute(1, 0, 2, 3)
        if data.weight is None or self.phases is None:
            return Residuals(error=error, where=kept, step=step, prior=self._prior(physical))
        weight = data.weight[step]
        error = self.phases.taken_out(error, step, mask).mul_(weight)
        return Residuals(error=error, where=kept, step=step, weight=weight, prior=self._prior(physical))

    def _with_torques(
        self,
        physical: torch.Tensor,
        mask: torch.Tensor,
        step: torch.Tensor,
        initial_offset: torch.Tensor | None,
        torques: Torques,
    ) -> Residuals:
        """Errors of positions and torques; candidates that differ in their sensors alone are simulated once."""
        motion = physical * self.space.moves
        keys = motion if initial_offset is None else torch.cat([motion, initial_offset], dim=1)
        place: dict[tuple[float, ...], int] = {}
        of = [place.setdefault(tuple(key), len(place)) for key in keys.tolist()]
        rows = [of.index(i) for i in range(len(place))]
        rollout = self.rollout(len(rows))
        rollout.start(physical[rows], mask, initial_offset=None if initial_offset is None else initial_offset[rows])
        scale, offset = self._sensors(physical)
        both = rollout.positions_and_torques(step, torques)
        shown, given = (each.view(len(step), len(rows), self.dataset.num_recordings, -1)[:, of] for each in both)
        error = shown - physical[:, None, self.space["encoder_bias"]] - self.dataset.measured[step][:, None]
        off = given.mul_(scale).add_(offset).sub_(torques.measured[step][:, None]).mul_(torques.weight)
        kept, known = mask[step], torques.known[step] & mask[step][..., None]
        parts = error.mul_(kept[:, None, :, None]), torch.where(known[:, None], off, 0.0)
        return Residuals(
            error=torch.cat(parts, dim=2).permute(1, 0, 2, 3),
            where=torch.cat([kept, known.any(dim=2)], dim=1),
            step=step,
            prior=self._prior(physical),
            with_torques=True,
        )

    def _sensors(self, physical: torch.Tensor) -> list[torch.Tensor]:
        """Scale and offset [N m] of the torques of candidates (m, size), (m, 1, n) each."""
        parameter = next(p for p in self.space.parameters if p.name == TORQUE_SCALE)
        names, result = self.dataset.recordings[0].joint_names, []
        joints = [names.index(key) for key in parameter.keys]
        for name in (TORQUE_SCALE, TORQUE_OFFSET):
            values = torch.zeros(len(physical), 1, len(names), dtype=physical.dtype)
            values[..., joints] = physical[:, None, self.space[name]]
            result.append(values)
        return result

    def _prior(self, physical: torch.Tensor) -> Prior | None:
        """What is known of candidates (m, size) beforehand."""
        std = self.space.prior
        if not bool(std.isfinite().any()):
            return None
        if self._noise is None:
            recordings = self.dataset.recordings
            trained = [recordings[r] for r in self.dataset.trained()] or recordings
            self._noise = max(noise_variance(trained), LEAST_NOISE**2)
        x = self.space.to_normalised(physical.to("cpu", torch.float64))
        return Prior(x=x, precision=std.pow(-2), noise=self._noise)
