"""A fit that is interrupted after each iteration and resumed, against one that is not; exits 1 where a bit differs."""

import sys

import torch
from problems import chirp, make_problem, record

from pace_optim.estimate.least_squares import Descent, checkpoint_of
from pace_optim.estimate.way_down import WayDown, WayDownCfg


def main() -> None:
    """Compare; the argument is the number of threads."""
    torch.set_num_threads(int(sys.argv[1]))
    coarse = make_problem(record(chirp(0.5), noise=1e-4))
    problem = coarse.with_physics_dt(coarse.physics_dt / 2)

    def way(**options):
        result = WayDown(problem, cfg=WayDownCfg(share=0.25), **options)
        result.noise_score = 0.0
        return result

    kept: list = []
    whole = way(on_iteration=lambda _: kept.append(checkpoint_of(first.descents)))
    first = whole
    starts = [problem.space.start, 0.5 * torch.ones_like(problem.space.start)]
    end = whole.run(starts)
    for checkpoint in kept[1::3]:
        again = way()
        again.descents = Descent.restore(checkpoint)
        other = again.run(starts)
        if not torch.equal(other.x, end.x) or other.scores != end.scores or not torch.equal(other.hessian, end.hessian):
            sys.exit(1)
    print(len(kept), "iterations")


if __name__ == "__main__":
    main()
