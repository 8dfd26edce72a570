"""What a resume restores is what was interrupted, whatever kernels the libraries choose for the processor."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT, SUPPORT


@pytest.mark.slow
@pytest.mark.parametrize(
    ("core", "capability", "threads"),
    [("Haswell", "default", 1), ("SkylakeX", "avx2", 2), ("Zen", "avx2", 1)],
)
def test_a_resumed_fit_is_the_one_that_was_interrupted_bit_for_bit(core, capability, threads):
    if core == "SkylakeX" and "avx512f" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("OpenBLAS's kernels for SkylakeX need AVX-512, which this processor does not have")
    chosen = {"OPENBLAS_CORETYPE": core, "ATEN_CPU_CAPABILITY": capability, "OMP_NUM_THREADS": str(threads)}
    chosen["OPENBLAS_NUM_THREADS"] = chosen["OMP_NUM_THREADS"]
    path = os.pathsep.join([str(SUPPORT), str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, str(SUPPORT / "bit_for_bit.py"), str(threads)],
        env={**os.environ, **chosen, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[0]) > 6
