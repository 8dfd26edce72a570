"""Simulations as one kernel: a whole recording in one launch.

Nothing is written twice. One control step of the same ``PaceDCMotor`` and its effects runs on symbols (``symbols``,
``operations``) in place of tensors (``drive``); what they record (``tape``) is the program of one joint. With the
single-joint simulation in it, it is written as C (``source``) and compiled for a GPU or the processor
(``pace_envs.kernels``), a thread for each joint of each row (``single_joint_model.kernel_rollout``). Around MuJoCo's
step it drives a whole robot on the processor (``robot``, ``robot_source``, ``robot_kernel``). Numbers are float64, and
multiplications are not fused with additions.
"""

from pace_envs.compiled_drive.tape import NotTraceableError

__all__ = ["NotTraceableError"]
