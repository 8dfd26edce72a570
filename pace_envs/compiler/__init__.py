"""From torch's operations to C: what drives and environments do, compiled for the processor and for a GPU.

Nothing is written twice. The product's own functions run while a tracer (``tape``) takes torch's operations in place
of torch, finds their C in one table (``operations``) and notes them on a tape (``tape``). There are two users:

- drives over whole recordings (:mod:`pace_envs.compiled_drive`);
- all rows of an environment's tensors, a thread for each environment (``fusion``).

``host`` compiles for the processor, ``nvrtc`` for a GPU. Multiplications are not fused with additions.
"""

from pace_envs.compiler.host import CannotCompileError, host_kernels
from pace_envs.compiler.nvrtc import Compiler, kernels_of
from pace_envs.compiler.tape import NotTraceableError

__all__ = ["CannotCompileError", "Compiler", "NotTraceableError", "host_kernels", "kernels_of"]
