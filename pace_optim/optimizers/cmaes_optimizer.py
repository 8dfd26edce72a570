"""PACE's search: CMA-ES on rollouts, one strategy per group of joints that do not influence each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from pace_envs.tasks.pace import CMAESOptimizerCfg
from pace_optim.optimizers.convergence import Criterion
from pace_optim.optimizers.tree_search import TreeSearch
from pace_optim.optimizers.tree_strategy import DIVERGED_SCORE
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.processes import Processes
from pace_optim.problem.rollout import Rollout


class CMAESOptimizer(TreeSearch):
    """Searches by CMA-ES: ask, simulate, tell, evolve, until finished.

        while not optimizer.finished():
            optimizer.ask()
            optimizer.update_simulator(rollout)
            for sim_dof_pos, real_dof_pos in rollout:
                optimizer.tell(sim_dof_pos, real_dof_pos)
            optimizer.evolve()

    The score of a candidate is the mean over the samples of Σ_joints (q_sim - bias - q_measured)² [rad²]; it is
    accumulated during the rollout, positions are not stored.

    Override :meth:`tell` for an objective of your own, and name the class in ``fit --optimizer my_module:MyOptimizer``:

        class PositionAndVelocity(CMAESOptimizer):
            def tell(self, sim_dof_pos, real_dof_pos):
                error_pos = torch.sum((sim_dof_pos - self.sim_params[:, self.bias_idx] - real_dof_pos) ** 2, dim=1)
                error_vel = torch.sum((self.sim_dof_vel - self.real_dof_vel) ** 2, dim=1)
                self.scores += 0.7 * error_pos + 0.3 * error_vel

    With several trees (groups of joints that do not influence each other), each has its own strategy on the same
    rollouts. Shared parameters (the delay) are searched by each tree on its own until the trees know theirs well;
    then the one value with the lowest total score is taken for all, and the search goes on with it.

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
            space: The parameters.
            population_size: Candidates per generation.
            cfg: Settings.
            trees: Groups of joint names that do not influence each other; ``None`` means one joint strategy.
            seed: Seed of the search.
            start: Where to start, normalised (size,); ``None`` means the centre of the bounds.
            criteria: When a strategy stops; ``None`` means PACE's, with ``cfg.epsilon``.
            processes: Who shares the search: each process simulates its part of the candidates, and does the
                arithmetic of its own strategies; the others' candidates and states come from them.

        Raises:
            ValueError: If the population is too small.
        """
        if population_size < 4:
            raise ValueError(
                f"The population is {population_size}, expected at least 4 candidates. Raise --num_envs to at least "
                "4 times the number of recordings."
            )
        processes = processes or Processes()
        super().__init__(space, population_size, cfg, processes, trees=trees, seed=seed, start=start, criteria=criteria)
        self.armature_idx, self.damping_idx = space["armature"], space["viscous_friction"]
        self.friction_idx, self.bias_idx = space["friction"], space["encoder_bias"]
        self.delay_idx = space["delay"]
        self._shown_here = self.num_shown
        self.sim_params = torch.empty(0)
        self.scores_buffer: torch.Tensor | None = None
        self.rollout: Rollout | None = None
        self._sample: tuple[int, torch.Tensor, torch.Tensor] | None = None
        """A step, the errors that were added to ``scores`` there, and their weights."""
        self.where: torch.Tensor | None = None
        """Which samples are scored, (T, R) bool; ``None``: those to train on."""
        self.joins_joints: bool | None = None
        """Whether the last error was one per environment, not per joint; ``None`` before the first."""

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
        self._shown_here = len(range(*mine.indices(self.population_size)))
        if rollout.num_candidates != self._shown_here:
            raise ValueError(
                f"There are {self._shown_here} candidates of a generation to simulate here, but the rollout simulates "
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
        """The rollout that is being scored.

        Raises:
            ValueError: If there is none.
        """
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
        """What has been told of each candidate since the rollout began, (candidates,), on the processor."""
        self._scored()
        self._end_sample()
        return self._by_joint(self.scores_buffer).sum(dim=1).cpu()

    def evolve(self) -> None:
        """End the generation: strategies learn from the scores."""
        if self.scores_buffer is None:
            raise ValueError("There are no scores to learn from. Call update_simulator and tell first.")
        self._end_sample()
        per_joint = self._of_all(self._by_joint(self.scores_buffer))
        scores = torch.zeros(self.population_size, len(self.strategies), dtype=torch.float64)
        scores.index_add_(1, self._joint_group, per_joint)
        self.scores_buffer = None  # the next generation needs a rollout of its own
        self._learn(scores.nan_to_num(nan=DIVERGED_SCORE).clamp(max=DIVERGED_SCORE).numpy())

    def close(self) -> None:
        """Forget the rollout; results stay readable."""
        self.scores_buffer = None
        self.rollout = None

    def _by_joint(self, scores: Any) -> torch.Tensor:
        """Scores of the environments, (num_envs, n), as those of the candidates of this process, (candidates, n)."""
        return scores.view(self._shown_here, -1, len(self.joint_names)).sum(dim=1)

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
