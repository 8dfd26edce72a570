"""Compiles C for a GPU while the program runs, with the compiler that torch for CUDA brings along, and launches it."""

from __future__ import annotations

import ctypes
import glob
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from pathlib import Path

import torch

from pace_envs.compiler.host import Argument, HostKernels, as_argument

_OPTIONS = ("--fmad=false", "-default-device")
"""A multiplication and an addition are rounded one by one, as on a processor."""


class Kernels:
    """Kernels by their source, each compiled once."""

    def __init__(self, device: torch.device):
        """For a GPU."""
        self._device = device
        self._functions: dict[str, ctypes.c_void_p] = {}
        self._kept: list[ctypes.c_void_p] = []

    def compile(self, sources: Sequence[str]) -> None:
        """Compile those that are new, side by side."""
        new = [source for source in dict.fromkeys(sources) if source not in self._functions]
        if not new:
            return
        major, minor = torch.cuda.get_device_capability(self._device)
        options = (*_OPTIONS, f"--gpu-architecture=sm_{major}{minor}")
        with ThreadPoolExecutor(min(len(new), os.cpu_count() or 1)) as pool:
            binaries = list(pool.map(lambda source: _compiled(source, options), new))
        for source, binary in zip(new, binaries, strict=True):
            self._functions[source] = self._loaded(binary)

    def launch(self, source: str, threads: int, width: int, arguments: Sequence[Argument]) -> None:
        """Queue a kernel on torch's current stream.

        Args:
            source: Of a compiled kernel, whose function is called ``simulate``.
            arguments: Tensors, which are handed over by address, and whole numbers.
        """
        values = [as_argument(each) for each in arguments]
        places = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
        blocks = -(-threads // width)
        stream = ctypes.c_void_p(torch.cuda.current_stream(self._device).cuda_stream)
        with torch.cuda.device(self._device):
            result = _driver().cuLaunchKernel(
                self._functions[source], blocks, 1, 1, width, 1, 1, 0, stream, places, None
            )
        _check(result, "launching a kernel")

    def _loaded(self, binary: bytes) -> ctypes.c_void_p:
        module, function = ctypes.c_void_p(), ctypes.c_void_p()
        with torch.cuda.device(self._device):
            if not torch.cuda.is_current_stream_capturing():
                torch.cuda.current_stream().synchronize()  # torch makes its context current
            _check(_driver().cuModuleLoadData(ctypes.byref(module), binary), "loading a kernel")
        _check(_driver().cuModuleGetFunction(ctypes.byref(function), module, b"simulate"), "finding a kernel")
        self._kept.append(module)
        return function


Compiler = HostKernels | Kernels


@cache
def kernels_of(device: torch.device) -> Kernels:
    """The kernels of a GPU."""
    return Kernels(device)


def _compiled(source: str, options: Sequence[str]) -> bytes:
    library, program = _compiler(), ctypes.c_void_p()
    library.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"simulate.cu", 0, None, None)
    words = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
    failed = library.nvrtcCompileProgram(program, len(options), words)
    size = ctypes.c_size_t()
    if failed:
        library.nvrtcGetProgramLogSize(program, ctypes.byref(size))
        log = ctypes.create_string_buffer(size.value)
        library.nvrtcGetProgramLog(program, log)
        raise RuntimeError(f"The GPU's compiler refused a kernel: {log.value.decode(errors='replace')}")
    library.nvrtcGetCUBINSize(program, ctypes.byref(size))
    binary = ctypes.create_string_buffer(size.value)
    library.nvrtcGetCUBIN(program, binary)
    library.nvrtcDestroyProgram(ctypes.byref(program))
    return binary.raw


def _check(result: int, what: str) -> None:
    if result:
        raise RuntimeError(f"CUDA refused {what} (error {result}).")


@lru_cache(maxsize=1)
def _driver() -> ctypes.CDLL:
    return ctypes.CDLL("libcuda.so.1")


@lru_cache(maxsize=1)
def _compiler() -> ctypes.CDLL:
    """NVRTC: the one in torch's own packages, or the system's."""
    version = (torch.version.cuda or "").split(".")[0]
    packages = Path(torch.__file__).parents[1] / "nvidia"
    own = [path for path in glob.glob(f"{packages}/*/lib/libnvrtc.so*") if ".alt." not in path]
    for name in (*own, f"libnvrtc.so.{version}", "libnvrtc.so"):
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise ValueError(
        f"The compiler for kernels, libnvrtc.so.{version}, was not found; torch for CUDA brings it as the package "
        "nvidia-cuda-nvrtc. Install that, or use --device cpu."
    )
