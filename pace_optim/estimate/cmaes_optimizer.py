"""PACE's search: CMA-ES on rollouts, one strategy per group of joints that do not influence each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch

from pace_actuators.config import Config
from pace_envs.tasks.pace import PaceCfg
from pace_optim.estimate.convergence import Criterion, ScoreSpread, stop_rule
from pace_optim.estimate.tree_strategy import DIVERGED_SCORE, TreeStrategy
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.rollout import Rollout
from pace_optim.terminal.processes import Processes

_CONSENSUS_SPREAD = 0.002
_CONSENSUS_LATEST = 0.9


@dataclass(kw_only=True)
class CMAESOptimizerCfg(Config):
    """Settings of the search."""

    per_tree: bool = True
    """Whether parts of the robot that do not move each other (legs on a fixed base) are searched apart."""

    max_iteration: int = 200
    """Largest number of generations."""

    epsilon: float | None = 1e-2
    """Stop when (max - min) / min of a generation's scores falls below this; ``None`` switches it off."""

    stop: Sequence[Any] = ()
    """Further rules that end the search, beside ``epsilon`` and ``max_iteration``: ``"plateau"``, ``"window"``,
    ``"gradient"``, ``"early_stopping"``, ``"parameters"`` or ``"target"``, with numbers as in
    ``"plateau:generations=30,improvement=0.01"``; or a custom rule (:class:`~pace_optim.Criterion`)."""

    sigma: float = 0.5
    """Initial standard deviation, in normalised parameters (the bounds are -1 and 1)."""

    save_interval: int = 10
    """Generations between two saved means and checkpoints."""

    save_optimization_process: bool = False
    """Whether every generation's parameters and scores are kept in ``progress.pt``."""

    @classmethod
    def of(cls, robot: PaceCfg) -> CMAESOptimizerCfg:
        """A robot's settings, as PACE's configuration has them, or the defaults."""
        return cls() if robot.cmaes is None else robot.cmaes


class CMAESOptimizer:
    """Searches by CMA-ES: ``ask``, simulate, ``tell``, ``evolve``, until finished.

        while not optimizer.finished():
            optimizer.ask()
            optimizer.update_simulator(rollout)
            for sim_dof_pos, real_dof_pos in rollout:
                optimizer.tell(sim_dof_pos, real_dof_pos)
            optimizer.evolve()

    The score of a candidate is the mean over the samples of Σ_joints (q_sim - bias - q_measured)² [rad²]; it is
    accumulated during the rollout, positions are not stored.

    With several trees (groups of joints that do not influence each other) each has its own strategy on the same
    rollouts. Shared parameters (the delay) are searched by each tree on its own until the trees know theirs well; then
    the one value with the lowest total score is taken for all, and the search goes on with it.

    Override :meth:`tell` for a custom objective, and name the class in ``fit --optimizer my_module:MyOptimizer``:

        class PositionAndVelocity(CMAESOptimizer):
            def tell(self, sim_dof_pos, real_dof_pos):
                error_pos = torch.sum((sim_dof_pos - self.sim_params[:, self.bias_idx] - real_dof_pos) ** 2, dim=1)
                error_vel = torch.sum((self.sim_dof_vel - self.real_dof_vel) ** 2, dim=1)
                self.scores += 0.7 * error_pos + 0.3 * error_vel

    Attributes:
        armature_idx, damping_idx, friction_idx, bias_idx, delay_idx: Slices of the parameter vector.
        sim_params: Physical parameters of every environment, (num_envs, size); set by :meth:`update_simulator`.
        rollout: The rollout that is being scored.
        generation: Generations so far.
        history: Scores of each generation, (population_size, trees) [rad²].
        best_scores: Best score so far after each generation [rad²].
    """

    def __init__(
        self,
        space: ParameterSpace,
        population_size: int,
        cfg: CMAESOptimizerCfg,
        *,
        trees: Sequence[Sequence[str]] | None = None,
        seed: int = 0,
        start: torch.Tensor | None = None,
        criteria: Sequence[Criterion] | None = None,
        processes: Processes | None = None,
    ):
        """Prepare the search.

        Args:
            trees: Groups of joint names that do not influence each other; ``None`` means one joint strategy.
            start: Where to start, normalised (size,); ``None`` means the centre of the bounds.
            criteria: When a strategy stops; ``None`` means PACE's, with ``cfg.epsilon``.
            processes: Who shares the search: each process simulates its part of the candidates, and updates its
                strategies; the other processes send their candidates and states.

        Raises:
            ValueError: If the population is too small.
        """
        if population_size < 4:
            raise ValueError(
                f"The population is {population_size}, expected at least 4 candidates. Raise --num_envs to at least "
                "4 times the number of recordings."
            )
        self.space = space
        self.cfg = cfg
        self.processes = self._doers = processes or Processes()
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
        self.line_generation = -1
        self._restored_line: int | None = None
        self._stopped: list[str] = []
        self.armature_idx, self.damping_idx = space["armature"], space["viscous_friction"]
        self.friction_idx, self.bias_idx = space["friction"], space["encoder_bias"]
        self.delay_idx = space["delay"]
        self.sim_params = torch.empty(0)
        self.scores_buffer: torch.Tensor | None = None
        self.rollout: Rollout | None = None
        self._sample: tuple[int, torch.Tensor, torch.Tensor] | None = None
        """A step, the errors that were added to ``scores`` there, and their weights."""
        self.where: torch.Tensor | None = None
        """Which samples are scored, (T, R) bool; ``None``: those to train on."""
        self.joins_joints: bool | None = None
        """Whether the last error was one per environment, not per joint; ``None`` before the first."""

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
        """
        if len(history) > self.cfg.max_iteration:
            raise ValueError(
                f"The search has had {len(history)} generations, more than max_iteration {self.cfg.max_iteration}. "
                "Give it as many or more."
            )
        self._restored_line, self._doers = line_generation, Processes()  # each for itself: the others may not do it
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
        self._restored_line, self._doers = None, self.processes

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
        if self._restored_line is not None:  # whatever max_iteration was
            return self.generation == self._restored_line
        if self.generation >= min(_CONSENSUS_LATEST * self.cfg.max_iteration, self.cfg.max_iteration - 1):
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

    @property
    def num_shown(self) -> int:
        """Candidates of a generation that this process simulates."""
        return len(range(*self.processes.share(self.population_size).indices(self.population_size)))

    def update_simulator(self, rollout: Rollout) -> None:
        """Write the generation to the simulation and start its rollout.

        Raises:
            ValueError: If the rollout is of another number of candidates.
        """
        mine = self.processes.share(self.population_size)
        if rollout.num_candidates != self.num_shown:
            raise ValueError(
                f"There are {self.num_shown} candidates of a generation to simulate here, but the rollout simulates "
                f"{rollout.num_candidates}. Take evaluator.rollout(optimizer.num_shown)."
            )
        rollout.start(self.candidates[mine], self.where, per_joint=self._per_joint_copies(mine))
        self.sim_params = rollout.physical
        shape = rollout.env.num_envs, len(self.joint_names)
        self.scores_buffer = torch.zeros(shape, dtype=torch.float64, device=rollout.env.device)
        self.rollout, self._sample = rollout, None

    @property
    def scores(self) -> torch.Tensor:
        """Errors of the present sample per environment, (num_envs,): ``self.scores += error`` in :meth:`tell`.

        They are weighted when the sample is over, so that a score is the mean over all samples.
        """
        rollout = self._scored()
        if self._sample is None or self._sample[0] != rollout.step:
            self._end_sample()
            errors = torch.zeros(rollout.env.num_envs, dtype=torch.float64, device=rollout.env.device)
            self._sample = rollout.step, errors, torch.as_tensor(rollout.weight)
        return self._sample[1]

    @scores.setter
    def scores(self, errors: torch.Tensor) -> None:
        rollout = self._scored()
        if errors.shape != (rollout.env.num_envs,):
            raise ValueError(
                f"scores has shape {tuple(errors.shape)}, expected one error per environment, "
                f"({rollout.env.num_envs},): sum over the joints, dim=1."
            )
        self._end_sample(unless=rollout.step)
        self._sample = rollout.step, errors, torch.as_tensor(rollout.weight)

    @property
    def sim_dof_vel(self) -> torch.Tensor:
        """Simulated joint velocities at the present sample, (num_envs, n) [rad/s]."""
        return self._scored().sim_dof_vel

    @property
    def real_dof_vel(self) -> torch.Tensor:
        """Measured joint velocities at the present sample, (num_envs, n) [rad/s]: recorded, or by differences."""
        return self._scored().real_dof_vel

    @property
    def sim_ee_pose(self) -> torch.Tensor:
        """Simulated pose of ``PaceCfg.ee_site`` in the base's frame, shaped as :attr:`real_ee_pose`."""
        return self._scored().sim_ee_pose

    @property
    def real_ee_pose(self) -> torch.Tensor:
        """Measured pose of the end effector, the series ``real_ee_pose`` of the recordings.

        (num_envs, 3), a position [m], or (num_envs, 7), position and quaternion (w, x, y, z).
        """
        return self._scored().real_ee_pose

    @property
    def reads_positions_alone(self) -> bool:
        """Whether the objective is this class's: it reads what :meth:`tell` is given, and nothing of the robot."""
        kind = type(self)
        return kind.tell is CMAESOptimizer.tell and kind.add_score is CMAESOptimizer.add_score

    def tell(self, sim_dof_pos: torch.Tensor, real_dof_pos: torch.Tensor) -> None:
        """Add one sample to the scores.

        Args:
            sim_dof_pos: True simulated joint positions, (num_envs, n) [rad].
            real_dof_pos: Measured joint positions, (num_envs, n) [rad].
        """
        self.add_score((sim_dof_pos - self.sim_params[:, self.bias_idx]).sub_(real_dof_pos).square_())

    def add_score(self, error: torch.Tensor) -> None:
        """Add one sample's error to the scores, weighted so that a score is the mean over all samples.

        Args:
            error: Per environment and joint, (num_envs, n), or per environment, (num_envs,), for an objective that
                joins all joints (with ``cfg.per_tree = False``, or a robot of one tree).

        Raises:
            ValueError: If the error joins all joints but the search is split, or has another shape.
        """
        self._add(error, self._scored().weight)

    def _scored(self) -> Rollout:
        """The rollout that is being scored."""
        if self.scores_buffer is None or self.rollout is None:
            raise ValueError("There is no rollout to score. Call update_simulator first.")
        return self.rollout

    def _add(self, error: torch.Tensor, weight: torch.Tensor | float) -> None:
        buffer = self.scores_buffer
        if buffer is None or error.shape not in (buffer.shape, buffer.shape[:1]):
            shape = None if buffer is None else tuple(buffer.shape)
            raise ValueError(
                f"The error has shape {tuple(error.shape)}, expected {shape} (environments, joints) or "
                f"({None if shape is None else shape[0]},)."
            )
        self.joins_joints = error.ndim == 1
        if error.ndim == 1:
            if len(self.strategies) > 1:
                raise ValueError(
                    "The objective gives one error per environment, but the search is split into "
                    f"{len(self.strategies)} independent trees. Return one error per joint, or set "
                    "CMAESOptimizerCfg(per_tree=False)."
                )
            error = (error / len(self.joint_names))[:, None]
        buffer.add_(error * weight)

    def _end_sample(self, unless: int | None = None) -> None:
        """Weight and add what a sample added to ``scores``, unless it is the one of that step."""
        if self._sample is not None and self._sample[0] != unless:
            _, errors, weight = self._sample
            self._sample = None
            self._add(errors, weight)

    def score_of_each(self) -> torch.Tensor:
        """The score of each candidate since the rollout began, (candidates,), on the processor."""
        self._scored()
        self._end_sample()
        return self._by_joint(self.scores_buffer).sum(dim=1).cpu()

    def evolve(self) -> None:
        """End the generation: strategies learn from the scores."""
        if self.scores_buffer is None:
            raise ValueError("There are no scores to learn from. Call update_simulator() and tell() first.")
        self._end_sample()
        per_joint = self._of_all(self._by_joint(self.scores_buffer))
        scores = torch.zeros(self.population_size, len(self.strategies), dtype=torch.float64)
        scores.index_add_(1, self._joint_group, per_joint)
        self.scores_buffer = None  # the next generation needs a new rollout
        self._learn(scores.nan_to_num(nan=DIVERGED_SCORE).clamp(max=DIVERGED_SCORE).numpy())

    def close(self) -> None:
        """Forget the rollout; results stay readable."""
        self.scores_buffer = None
        self.rollout = None

    def _by_joint(self, scores: Any) -> torch.Tensor:
        """Scores of the environments, (num_envs, n), as those of the candidates of this process, (candidates, n)."""
        return scores.view(self.num_shown, -1, len(self.joint_names)).sum(dim=1)

    def _of_all(self, scores: torch.Tensor) -> torch.Tensor:
        """The scores of all candidates, from this process's own, on the processor."""
        return self.processes.gather(scores, self.population_size).cpu()

    def _per_joint_copies(self, mine: slice) -> dict[str, torch.Tensor]:
        """Shared parameters of some candidates as each joint's tree has them, {name: (candidates, n)}."""
        if len(self.strategies) == 1:
            return {}
        copies = {}
        for parameter in self.space.parameters:
            if not parameter.shared:
                continue
            entry = self.space[parameter.name].start
            per_tree = []
            for strategy, x in zip(self.strategies, self._shown, strict=True):
                own = torch.as_tensor(x[mine, strategy.entries.tolist().index(entry)])
                full = torch.zeros(len(own), self.space.size, dtype=torch.float64)
                full[:, entry] = own
                per_tree.append(self.space.to_physical(full)[:, entry])
            copies[parameter.name] = torch.stack(per_tree, dim=1)[:, self._joint_group]
        return copies
