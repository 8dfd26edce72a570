"""Where torch computes: a processor or a GPU, by name."""

from __future__ import annotations

import torch


def find_device(name: str) -> torch.device:
    """The device of a name.

    Args:
        name: ``"cpu"``, ``"cuda"``, ``"cuda:0"``, ``"cuda:1"``, ….
    """
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise ValueError(f"device is {name!r}, expected cpu, or a GPU as cuda:0, cuda:1, ….")
    if device.type == "cpu":
        return torch.device("cpu")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if not count:
        raise ValueError(
            f"device is {name!r}, but torch finds no GPU with CUDA. Install a driver and torch for CUDA, or use cpu."
        )
    if (device.index or 0) >= count:
        raise ValueError(f"device is {name!r}, but there are {count} GPUs: cuda:0 to cuda:{count - 1}.")
    return torch.device("cuda", device.index or 0)
