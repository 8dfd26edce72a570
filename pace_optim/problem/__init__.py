"""One identification problem: parameters, environments, rollouts and their residuals."""
