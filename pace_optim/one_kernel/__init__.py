"""The single-joint simulation as one kernel: a whole recording in one launch, a thread for each joint of each row.

Nothing is written twice. One control step of the same ``PaceDCMotor``, effects and ``TwinSimulation`` runs on symbols
(``symbols``, ``operations``) in place of tensors; what they record (``tape``) is the program of one joint, which is
written as C (``source``) and compiled for a GPU or the processor (``pace_envs.kernels``). Numbers are float64, and
multiplications are not fused with additions.
"""

from pace_optim.one_kernel.batch import KernelRollout
from pace_optim.one_kernel.tape import NotTraceableError

__all__ = ["KernelRollout", "NotTraceableError"]
