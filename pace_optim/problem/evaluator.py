"""From parameter vectors to residuals: what an optimizer sees of the simulation."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch

from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.rollout import Rollout
from pace_optim.recording.dataset import Dataset

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv

_WIDEST = 512


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals:
    """Errors q_sim - bias - q_measured of m candidates at K steps of R recordings and n joints."""

    error: torch.Tensor
    """(m, K, R, n) [rad]; zero where a recording has no sample."""
    where: torch.Tensor
    """Where there is a sample, (K, R) bool."""
    step: torch.Tensor
    """Control step of each of the K steps, (K,)."""

    def rows(self, begin: int, end: int) -> Residuals:
        """Those of some of the candidates."""
        return replace(self, error=self.error[begin:end])

    @property
    def score(self) -> torch.Tensor:
        """Mean over the samples of Σ_joints error², (m,) [rad²]; infinite where a simulation diverged."""
        return self.joint_score.sum(dim=1)

    @property
    def joint_score(self) -> torch.Tensor:
        """Mean over the samples of error² per joint, (m, n) [rad²]."""
        total = self.error.square().sum(dim=(1, 2)) / self.where.sum()
        return total.nan_to_num(nan=torch.inf)


class Evaluator:
    """Simulates any number of candidates; environments of each batch size are built once and kept."""

    def __init__(self, make_env: Callable[[int], ManagerBasedEnv], dataset: Dataset, space: ParameterSpace):
        """Keep what is needed to build environments.

        Args:
            make_env: Builds the environment with a given number of environments.
            dataset: The recordings.
            space: The parameters.
        """
        self.dataset = dataset
        self.space = space
        self._make_env = make_env
        self._rollouts: dict[int, Rollout] = {}
        self.simulations = 0
        """Candidates simulated so far by :meth:`residuals`."""
        self._again = 0

    @property
    def simulated_steps(self) -> int:
        """Control steps simulated so far, over all environments."""
        return sum(rollout.simulated_steps for rollout in self._rollouts.values()) - self._again

    @contextlib.contextmanager
    def again(self) -> Iterator[None]:
        """What is simulated in the block was counted before: a run that goes on finds again what it had not kept."""
        before = self.simulated_steps
        try:
            yield
        finally:
            self._again += self.simulated_steps - before

    def rollout(self, num_candidates: int) -> Rollout:
        """The rollout of that many candidates."""
        if num_candidates not in self._rollouts:
            env = self._make_env(num_candidates * self.dataset.num_recordings)
            self._rollouts[num_candidates] = Rollout(env, self.dataset, self.space)
        return self._rollouts[num_candidates]

    def residuals(
        self,
        physical: torch.Tensor,
        where: torch.Tensor | None = None,
        initial_offset: torch.Tensor | None = None,
    ) -> Residuals:
        """Simulate candidates and keep their errors.

        Args:
            physical: Physical parameters, (m, size).
            where: Which samples count, (T, R) bool; ``None`` means those to train on.
            initial_offset: Added to each recording's first position, (m, n) [rad].
        """
        self.simulations += len(physical)
        widest = max(1, _WIDEST // self.dataset.num_recordings)
        offsets = [None] * len(physical) if initial_offset is None else initial_offset.split(widest)
        parts = [
            self._residuals(part, where, offset) for part, offset in zip(physical.split(widest), offsets, strict=False)
        ]
        return (
            parts[0]
            if len(parts) == 1
            else Residuals(error=torch.cat([part.error for part in parts]), where=parts[0].where, step=parts[0].step)
        )

    def _residuals(
        self, physical: torch.Tensor, where: torch.Tensor | None, initial_offset: torch.Tensor | None
    ) -> Residuals:
        data = self.dataset
        mask = data.train if where is None else where
        step = mask.any(dim=1).nonzero()[:, 0]
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
        return Residuals(error=error.permute(1, 0, 2, 3), where=kept, step=step)
