"""PACE on MuJoCo: identify actuator parameters from recordings, and find the effect that is missing."""

from typing import Any

__all__ = ["CMAESOptimizer"]


def __getattr__(name: str) -> Any:
    """Import what is public when it is asked for: commands begin before torch is there."""
    if name != "CMAESOptimizer":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from pace_optim.optimizers.cmaes_optimizer import CMAESOptimizer

    return CMAESOptimizer
