"""Read JSON and tensors of a run's folder; every fault of a file is one sentence that names it."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

_HALF_CHARACTER = re.compile(r"\\u[dD][89a-fA-F]")
"""An escape that may be one: two of them together make a character."""


def file_at(path: str | Path, cure: str) -> Path:
    """The path of a regular file, which can be opened.

    Args:
        cure: What to do if it is not, a sentence.
    """
    path = Path(path)
    try:
        if path.is_file():
            with path.open("rb"):
                return path
        found = "is no file" if path.exists() else "is a link to nothing" if path.is_symlink() else "does not exist"
    except (OSError, ValueError) as error:  # a loop of links, a name too long or with a zero in it, no permission
        found = f"cannot be read ({getattr(error, 'strerror', None) or error})"
    raise ValueError(f"{path} {found}. {cure}") from None


def read_json(path: str | Path, cure: str) -> Any:
    """What a JSON file holds.

    Args:
        cure: What to do if it is missing or damaged, a sentence.
    """
    path = file_at(path, cure)
    try:
        return parsed_json(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError, OSError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise ValueError(f"{path} is no JSON ({reason}). {cure}") from None


def parsed_json(text: str) -> Any:
    """What a text of JSON says.

    Raises:
        RecursionError: If it is nested too deeply.
    """
    content = json.loads(text)
    if _HALF_CHARACTER.search(text):
        json.dumps(content, ensure_ascii=False).encode()
    return content


def read_tensors(path: str | Path, cure: str) -> Any:
    """What ``torch.save`` wrote: tensors, numbers, text, lists and dicts; nothing in the file is executed.

    Args:
        cure: What to do if it is missing or damaged, a sentence.
    """
    path = file_at(path, cure)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of foreign pickles: the error below names the fault
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for a damaged or foreign file
        if "Unsupported" in str(error) or "weights_only" in str(error).lower():
            reason = (
                "it holds Python objects beside tensors, numbers, text, lists and dicts, or torch.save did not write it"
            )
        else:
            reason = (str(error).splitlines() or [type(error).__name__])[0][:160]
        raise ValueError(f"{path} cannot be read ({reason}). {cure}") from None
    for key, tensor in tensors_in(content):
        stored = tensor.untyped_storage().nbytes() if tensor.layout == torch.strided else None
        if stored is None or tensor.numel() * tensor.element_size() > stored:
            raise ValueError(
                f"{path}: {key or 'the tensor'} of shape {tuple(tensor.shape)} is not stored in full: written out it "
                f"would take {tensor.numel() * tensor.element_size() / 1e9:.3g} GB. {cure}"
            )
    return content


def tensors_in(content: Any, key: str = "") -> Iterator[tuple[str, torch.Tensor]]:
    """All tensors of nested dicts and lists, with the keys that lead there."""
    if isinstance(content, torch.Tensor):
        yield key, content
    elif isinstance(content, dict | list | tuple):
        for name, value in content.items() if isinstance(content, dict) else enumerate(content):
            yield from tensors_in(value, f"{key}/{name}" if key else str(name))
