"""From torch's operations to C: what drives, robots and environments do, compiled for the processor and for a GPU.

Nothing is written twice. The product's own functions run while a tracer (``tracer``) takes torch's operations in place
of torch, finds their C in one table (``operations``) and notes them on a tape (``tape``). There are four ways out:

- one joint over a recording, a thread for each joint (``one_joint``, ``joint_source``);
- a robot's drives around MuJoCo's step (``robot``, ``robot_source``, ``robot_kernel``);
- all rows of an environment's tensors, a thread for each environment (``fusion``), on the processor
- or, as all but a robot's, on a GPU (``host``, ``nvrtc`` compile).

Multiplications are not fused with additions.
"""

from pace_envs.compiler.host import CannotCompileError, HostKernels, host_kernels
from pace_envs.compiler.nvrtc import Kernels, kernels_of
from pace_envs.compiler.tape import NotTraceableError

__all__ = ["CannotCompileError", "HostKernels", "Kernels", "NotTraceableError", "host_kernels", "kernels_of"]
