"""Many small operations on tensors of all environments as a few kernels, a thread for each environment.

What follows the physics in a step is some four hundred operations of torch on a few numbers of each environment. On a
GPU each is a kernel of 2.5 µs, one after another, whatever they do. :class:`Fusion` puts them off while a function runs
(``fusion``, by torch's dispatch), finds which belong into one kernel (``memory``), writes these as C (``writer``,
``operations``) and launches them: once, while a CUDA graph is captured.
"""

from pace_envs.fused.fusion import Fusion, fusion_for, launch_pending

__all__ = ["Fusion", "fusion_for", "launch_pending"]
