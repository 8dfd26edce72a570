"""CMA-ES and least squares, from vectors and scores; as in PACE, ``CMAESOptimizer`` writes to a rollout."""
