"""The robot in 3-D, measured and simulated motion over each other: what it looks like, how it moves, the viewer."""

from .motion import Motion, motions_of
from .scene import scene_of

__all__ = ["Motion", "motions_of", "scene_of"]
