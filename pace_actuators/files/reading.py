"""Read JSON and tensors of a run's folder; every fault of a file is one sentence that names it."""

from __future__ import annotations

import difflib
import json
import math
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

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


T = TypeVar("T")
_LONGEST = 60
_NAMES = {str: "text", int: "a whole number", float: "a finite number", bool: "true or false", NoneType: "null"}


def checked(cls: type[T], content: Any, source: object, cure: str, *, strict: bool = False) -> T:
    """Build a dataclass from what a file holds.

    Args:
        cls: The dataclass. A key that it does not have is left out; one that the file does not have keeps its default.
        source: The file, and the place in it, for messages.
        cure: What to do if something is wrong, a sentence.
        strict: Whether a key that the dataclass does not have is refused.
    """
    if not isinstance(content, Mapping):
        refuse(source, f"holds {_shown(content)}, expected an object with keys", cure)
    hints, values = get_type_hints(cls), {}
    known = {field.name: field for field in fields(cls)}  # type: ignore[arg-type]
    if strict and (foreign := [key for key in content if key not in known]):
        close = difflib.get_close_matches(str(foreign[0]), known, n=1)
        meant = f" (did you mean {close[0]}?)" if close else ""
        refuse(source, f"the key {_shown(foreign[0])} is not known{meant}", cure)
    for name, field in known.items():
        if name in content:
            values[name] = _value(hints[name], content[name], f"{source}: {name}", cure)
        elif field.default is MISSING and field.default_factory is MISSING:
            refuse(source, f"{name} is missing", cure)
    return cls(**values)


def refuse(source: object, what: str, cure: str) -> NoReturn:
    """Say what is wrong with a file."""
    raise ValueError(f"{source}: {what}. {cure}")


def _value(hint: Any, value: Any, where: str, cure: str) -> Any:
    """The value as its annotation has it."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        if value is None and NoneType in args:
            return None
        holds = isinstance(value, Mapping)
        others = [arg for arg in args if arg is not NoneType]
        return _value(min(others, key=lambda arg: (get_origin(arg) in (dict, Mapping)) != holds), value, where, cure)
    if origin is Literal:
        if value not in args or not isinstance(value, str):
            _wrong(where, f"is {_shown(value)}, expected {' or '.join(map(repr, args))}", cure)
        return value
    if is_dataclass(hint):
        return checked(hint, value, where, cure)  # type: ignore[arg-type]
    if origin in (list, tuple, Sequence):
        if not isinstance(value, list | tuple):
            _wrong(where, f"is {_shown(value)}, expected a list", cure)
        return [_value(args[0], item, f"{where}[{i}]", cure) for i, item in enumerate(value)]
    if origin in (dict, Mapping):
        if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
            _wrong(where, f"is {_shown(value)}, expected an object with keys", cure)
        return {key: _value(args[1], item, f"{where}/{key}", cure) for key, item in value.items()}
    if hint is Any:
        _finite(value, where, cure)
        return value
    return _plain(hint, value, where, cure)


def _plain(hint: Any, value: Any, where: str, cure: str) -> Any:
    fits = isinstance(value, int | float if hint is float else hint) and (hint is bool or not isinstance(value, bool))
    if fits and hint is float:
        try:
            value = float(value)
        except OverflowError:
            value = math.inf
        fits = math.isfinite(value)
    if not fits:
        _wrong(where, f"is {_shown(value)}, expected {_NAMES.get(hint, hint)}", cure)
    return value


def _finite(value: Any, where: str, cure: str) -> None:
    """Look for unusable numbers at every depth."""
    if isinstance(value, int | float) and not abs(value) <= sys.float_info.max:  # NaN, infinite, or too many digits
        _wrong(where, f"is {_shown(value)}, expected a finite number", cure)
    if isinstance(value, Mapping):
        for key, item in value.items():
            _finite(item, f"{where}/{key}", cure)
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            _finite(item, f"{where}[{i}]", cure)


def _wrong(where: str, what: str, cure: str) -> NoReturn:
    raise ValueError(f"{where} {what}. {cure}")


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return "an object"
    if isinstance(value, list | tuple):
        return "a list"
    if value is None:
        return "null"
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 10**30:
        return "a number of very many digits"
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
