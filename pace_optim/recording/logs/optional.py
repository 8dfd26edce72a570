"""Readers that are an optional extra, and what to say where they are missing."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any


def reader(module: str, path: Path) -> Any:
    """Import a reader of logs."""
    try:
        return import_module(module)
    except ImportError:
        raise ValueError(
            f"{path}: reading it needs the package {module.partition('.')[0]}, which is not installed. Install it with "
            'pip install "pace-mujoco[logs]".'
        ) from None
