"""A joint's program over a whole recording, written as C: for a GPU and for the processor."""

from __future__ import annotations

from pace_envs.compiled_drive.drive_code import DriveCode, Program
from pace_envs.compiler.operations import PRELUDE

_ARGUMENTS = (
    "int count, int first, int last, int steps, int stride, const int* place, const double* leaves, "
    "const double* rings, const double* series, const int* slot, double* out"
)
_END = """
#ifdef __CUDACC__
extern "C" __global__ void simulate(ARGUMENTS) {
  const int e = blockIdx.x * blockDim.x + threadIdx.x;
  if (e < count) joint(e, NAMES);
}
#else
extern "C" void simulate(ARGUMENTS) {
  for (int e = 0; e < count; ++e) joint(e, NAMES);
}
#endif
""".replace("ARGUMENTS", _ARGUMENTS).replace(
    "NAMES", ", ".join(part.split()[-1].lstrip("*") for part in _ARGUMENTS.split(","))
)


def joint_source(program: Program) -> tuple[str, list[int]]:
    """The C source of a program, and which leaves it reads, in order.

    The function ``simulate`` goes through the control steps ``first`` to ``last`` of ``count`` joints. What is shown
    at step k is written to ``out[slot[k] * count + e]`` unless the slot is negative; series are read at ``place[e]`` of
    ``stride`` numbers.
    """
    code = DriveCode(program)
    count, size = len(program.tape.series), "(long long)steps * stride"
    shown = f"if (slot[k] >= 0) out[(long long)slot[k] * count + e] = {code.of(program.shown['out'])};"
    before = [
        *code.knots,
        *code.begin(),
        "const double* s = series + (long long)first * stride + place[e];",
        *(f"double s{i} = s[{i} * {size}];" for i in range(count)),
    ]
    inside = [
        "const long long ahead = k + 1 < last ? stride : 0;",
        *(f"const double t{i} = s[{i} * {size} + ahead];" for i in range(count)),
        *code.part(0, lambda node: f"s{node.index}", [shown]),
        *(f"s{i} = t{i};" for i in range(count)),
        "s += ahead;",
    ]
    top, loop = "\n  ".join(before), "\n    ".join(inside)
    return (
        f"{PRELUDE}FUNCTION void joint(int e, {_ARGUMENTS}) {{\n  {top}\n"
        f"  for (int k = first; k < last; ++k) {{\n    {loop}\n  }}\n}}\n{_END}"
    ), code.used
