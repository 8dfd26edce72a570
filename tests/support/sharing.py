"""What test_several_processes.py starts once per rank: a few generations of a search, shared by gloo."""

import os
import sys

import torch

from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer, CMAESOptimizerCfg
from pace_optim.estimate.search import search
from pace_optim.problem.problem import load_problem
from pace_optim.terminal.cli import run_cli
from pace_optim.terminal.processes import Processes, join

GENERATIONS = 3


def main() -> None:
    """Search, and print all scores and where it is; the rank named by LOSE ends without a word after a generation."""
    torch.set_num_threads(1)
    processes, _ = join("cpu")
    task, recording = sys.argv[1:]
    print(searched(task, recording, processes))


def searched(task: str, recording: str, processes: Processes) -> list:
    """All scores, where the search is and its best scores."""
    problem = load_problem(task, data=[recording]).on_pieces(0.1)
    evaluator = problem.training_evaluator()
    optimizer = CMAESOptimizer(
        problem.space, 9, CMAESOptimizerCfg.of(problem.env_cfg.sim2real), trees=problem.trees, processes=processes
    )

    def after_generation(_: CMAESOptimizer) -> None:
        if os.environ.get("LOSE") == str(processes.rank):
            os._exit(9)
        if optimizer.generation == GENERATIONS:
            optimizer.stop("enough")

    search(optimizer, evaluator.rollout(optimizer.num_shown), after_generation)
    where_it_is = [each.tolist() for each in (optimizer.best, optimizer.mean, optimizer.spread)]
    return [[scores.tolist() for scores in optimizer.history], where_it_is, optimizer.best_scores]


if __name__ == "__main__":
    sys.exit(run_cli(main))
