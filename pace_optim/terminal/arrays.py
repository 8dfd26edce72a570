"""Reading ``.npz`` archives without trusting what they say of themselves."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO

import numpy as np

from pace_actuators.files import file_at
from pace_actuators.memory import check_memory


def read_arrays(path: str | Path, cure: str) -> dict[str, np.ndarray]:
    """The arrays that ``numpy.savez`` wrote; no objects.

    Args:
        cure: What to do if it is missing or damaged, a sentence.
    """
    path = file_at(path, cure)
    key = ""
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
            check_memory(unpacked, "unpacking it", "It is larger than it looks.")
            for member in archive.infolist():
                key = member.filename.removesuffix(".npy")
                with archive.open(member) as file:
                    _check_size(file, member.file_size)
        with np.load(path, allow_pickle=False) as content:
            arrays = {}
            for key in content.files:
                arrays[key] = content[key]
            return arrays
    except Exception as error:  # numpy, zip and end-of-file errors of many kinds
        where = f"{path}: {key} cannot be read" if key else f"{path} cannot be read"
        reason = (str(error).splitlines() or [type(error).__name__])[0][:160]
        reason = "it holds Python objects" if reason.startswith("Object arrays") else reason
        raise ValueError(f"{where} ({reason}). {cure}") from None


def _check_size(file: IO[bytes], size: int) -> None:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    wanted = int(np.prod([float(n) for n in shape])) * dtype.itemsize
    if wanted > size and not dtype.hasobject:
        raise ValueError(f"its shape {shape} would take {wanted / 1e9:.3g} GB, and there are {size} bytes of data")
