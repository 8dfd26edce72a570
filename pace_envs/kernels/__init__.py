"""Compiles C while the program runs, for a GPU or the processor, and launches it."""

from pace_envs.kernels.host import CannotCompileError, HostKernels, host_kernels
from pace_envs.kernels.nvrtc import Kernels, kernels_of

__all__ = ["CannotCompileError", "HostKernels", "Kernels", "host_kernels", "kernels_of"]
