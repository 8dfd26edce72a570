"""CMA-ES with one strategy per group of joints that do not influence each other, and what the groups share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Self

import numpy as np
import torch

from pace_envs.tasks.pace import CMAESOptimizerCfg
from pace_optim.optimizers.convergence import Criterion, ScoreSpread, stop_rule
from pace_optim.optimizers.tree_strategy import TreeStrategy
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.processes import Processes

_CONSENSUS_SPREAD = 0.002
_CONSENSUS_LATEST = 0.9


class TreeSearch:
    """The strategies of all trees: vectors are drawn, and learnt from their scores; no simulator is known here.

    With several trees each has its own strategy on the same rollouts. Shared parameters (the delay) are searched by
    each tree on its own until the trees know theirs well; then the one value with the lowest total score is taken for
    all, and the search goes on with it.
    """

    def __init__(
        self,
        space: ParameterSpace,
        population_size: int,
        cfg: CMAESOptimizerCfg,
        processes: Processes,
        *,
        trees: Sequence[Sequence[str]] | None,
        seed: int,
        start: torch.Tensor | None,
        criteria: Sequence[Criterion] | None,
    ):
        """Prepare the search; the arguments are those of :class:`CMAESOptimizer`."""
        self.space = space
        self.cfg = cfg
        self.processes = self._doers = processes
        self.population_size = population_size
        self.generation = 0
        self.history: list[np.ndarray] = []
        self.best_scores: list[float] = []
        self.joint_names = next(p.keys for p in space.parameters if p.name == "encoder_bias")

        copies = all(p.per_joint_copies for p in space.parameters if p.shared)
        groups = [list(joints) for joints in trees] if trees and copies and cfg.per_tree else [list(self.joint_names)]
        owners = space.owners(groups)
        self._shared = [i for i, owner in enumerate(owners) if owner is None]
        self._joint_group = torch.tensor(
            [next(g for g, joints in enumerate(groups) if name in joints) for name in self.joint_names]
        )
        if criteria is None:
            criteria = [*([] if cfg.epsilon is None else [ScoreSpread(cfg.epsilon)]), *map(stop_rule, cfg.stop)]
        x0 = np.zeros(space.size) if start is None else np.asarray(start, dtype=float)
        seeds = np.random.SeedSequence(seed).generate_state(len(groups))
        self.strategies = []
        for g in range(len(groups)):
            entries = [i for i, owner in enumerate(owners) if owner in (g, None)]
            self.strategies.append(
                TreeStrategy(
                    entries,
                    start=x0[entries],
                    sigma=cfg.sigma,
                    population_size=population_size,
                    seed=int(seeds[g]),
                    criteria=criteria,
                )
            )
        self._consensus: np.ndarray | None = None if len(groups) > 1 and self._shared else np.zeros(0)
        self._line: np.ndarray | None = None
        self.line_generation = self._planned_line = -1
        self._stopped: list[str] = []

    def ask(self) -> torch.Tensor:
        """Draw the next generation; physical parameters, (population_size, size)."""
        if self._line is None and self._consensus is None and self._ready_for_consensus():
            self._line = self._consensus_line()
            self.line_generation = self.generation
        self._asked: list[np.ndarray] = []
        if self._line is None:
            own = [s.ask() if self._doers.owns(g) else None for g, s in enumerate(self.strategies)]
            self._asked = self._doers.exchange(own)
        shown = []
        for g, strategy in enumerate(self.strategies):
            if self._line is not None or strategy.stop_reason:
                x = np.tile(strategy.best_x, (self.population_size, 1))
            else:
                x = self._asked[g].copy()
            shared = self._positions(strategy)
            if self._line is not None:
                x[:, shared] = self._line
            elif self._consensus is not None and len(self._consensus):
                x[:, shared] = self._consensus
            shown.append(x)
        self._shown = shown
        full = np.zeros((self.population_size, self.space.size))
        for strategy, x in zip(self.strategies, shown, strict=True):
            full[:, strategy.entries] = x
        if self._shared:  # what is shown of a shared entry is the mean over the trees
            full[:, self._shared] = np.mean(
                [x[:, self._positions(s)] for s, x in zip(self.strategies, shown, strict=True)], axis=0
            )
        self.normalised = torch.as_tensor(full)
        self.candidates = self.space.to_physical(self.normalised)
        return self.candidates

    def finished(self) -> bool:
        """Whether the search has stopped; :attr:`stop_reasons` says why."""
        if self.generation >= self.cfg.max_iteration:
            self._stopped = [f"max_iteration {self.cfg.max_iteration}"]
        elif self._consensus is not None and all(s.stop_reason for s in self.strategies):
            self._stopped = list(dict.fromkeys(s.stop_reason for s in self.strategies if s.stop_reason))
        return bool(self._stopped)

    @property
    def best_score(self) -> float:
        """Best score of the whole run [rad²]; with several trees, the sum of each tree's best."""
        return float(sum(strategy.best_score for strategy in self.strategies))

    @property
    def best(self) -> torch.Tensor:
        """Best normalised vector of the whole run, (size,)."""
        return self._gather([strategy.best_x for strategy in self.strategies])

    @property
    def mean(self) -> torch.Tensor:
        """Mean of the search distribution, normalised (size,)."""
        return self._gather([strategy.mean for strategy in self.strategies])

    @property
    def spread(self) -> torch.Tensor:
        """Standard deviation of the search distribution, normalised (size,)."""
        return self._gather([strategy.spread for strategy in self.strategies])

    @property
    def stop_reasons(self) -> list[str]:
        """Why the search stopped."""
        return list(self._stopped)

    def stop(self, reason: str) -> None:
        """Make :meth:`finished` true."""
        self._stopped = [reason]

    def restore(
        self,
        history: Sequence[np.ndarray],
        line_generation: int = -1,
        after_generation: Callable[[Self], None] | None = None,
    ) -> None:
        """Bring a fresh optimizer to where another one, of the same seed and settings, was.

        Args:
            history: The other one's ``history``: scores of each generation, (population_size, trees).
            line_generation: The other one's ``line_generation``.
            after_generation: Called after each generation.

        Raises:
            ValueError: If the history does not fit.
        """
        self._planned_line, self._doers = line_generation, Processes()  # each for itself: the others may not do it
        for scores in history:
            if scores.shape != (self.population_size, len(self.strategies)):
                raise ValueError(
                    f"The checkpoint's generations have the shape {scores.shape}, expected "
                    f"{(self.population_size, len(self.strategies))} (population, trees). "
                    "Resume with the same settings."
                )
            self.ask()
            self._learn(np.asarray(scores))
            if after_generation is not None:
                after_generation(self)
        self._doers = self.processes

    def _learn(self, scores: np.ndarray) -> None:
        self.generation_scores = scores
        self.history.append(scores)
        self.generation += 1
        self._update_strategies(scores)
        self.best_scores.append(self.best_score)

    def _update_strategies(self, scores: np.ndarray) -> None:
        if self._line is not None:
            winner = int(scores.sum(axis=1).argmin())
            self._consensus, self._line = self._line[winner], None
            for g, strategy in enumerate(self.strategies):
                strategy.forget_best()
                strategy.best_x[self._positions(strategy)] = self._consensus
                strategy.best_score = float(scores[winner, g])
            return
        going = [g for g, strategy in enumerate(self.strategies) if not strategy.stop_reason]
        for g in going:
            if self._doers.owns(g):
                self.strategies[g].tell(scores[:, g], self._shown[g])
        states = self._doers.exchange([strategy.state for strategy in self.strategies])
        for g in going:
            self.strategies[g].state = states[g]

    def _ready_for_consensus(self) -> bool:
        """Whether all trees know their shared parameters well, or time is running out."""
        if self._planned_line >= 0:  # as in the run that is restored, whatever its max_iteration was
            return self.generation == self._planned_line
        if self.generation >= _CONSENSUS_LATEST * self.cfg.max_iteration:
            return self.generation > 0
        known = [
            bool(s.stop_reason) or float(s.spread[self._positions(s)].max()) < _CONSENSUS_SPREAD
            for s in self.strategies
        ]
        return self.generation > 0 and all(known)

    def _consensus_line(self) -> np.ndarray:
        """Shared values from the lowest to the highest of the trees', (population_size, shared)."""
        values = np.array([s.best_x[self._positions(s)] for s in self.strategies])
        part = np.linspace(0.0, 1.0, self.population_size)[:, None]
        return values.min(axis=0) + part * (values.max(axis=0) - values.min(axis=0))

    def _positions(self, strategy: TreeStrategy) -> list[int]:
        """Where the shared entries are among a strategy's own."""
        entries = strategy.entries.tolist()
        return [entries.index(i) for i in self._shared]

    def _gather(self, parts: Sequence[np.ndarray]) -> torch.Tensor:
        full = np.zeros(self.space.size)
        for strategy, part in zip(self.strategies, parts, strict=True):
            full[strategy.entries] = part
        if self._shared:
            values = [part[self._positions(s)] for s, part in zip(self.strategies, parts, strict=True)]
            consensus = self._consensus is not None and len(self._consensus) > 0
            full[self._shared] = self._consensus if consensus else np.mean(values, axis=0)
        return torch.as_tensor(full)
