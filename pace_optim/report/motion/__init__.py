"""The robot in 3-D, measured and simulated motion over each other: what it looks like, how it moves, the viewer."""

from .meshes import Looks, looks_of
from .motion import Motion, motions_of
from .scene import scene_of

__all__ = ["Looks", "Motion", "looks_of", "motions_of", "scene_of"]
