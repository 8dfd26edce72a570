"""Making recordings: command a robot's simulation with known parameters, or write the commands for a real one.

>>> collection = collect(CollectionCfg(task="Pace-AnymalD-v0", output=Path("chirp.npz")))
>>> collection.recordings, collection.plots, collection.warnings
"""

from .cfg import CollectionCfg
from .collect import Collection, collect
from .plot import plot_motion
from .simulate import Encoder, Simulated, simulate, true_parameters

__all__ = [
    "Collection",
    "CollectionCfg",
    "Encoder",
    "Simulated",
    "collect",
    "plot_motion",
    "simulate",
    "true_parameters",
]
