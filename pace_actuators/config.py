"""What all configurations share: a changed copy, and defaults written as in Isaac Lab's ``configclass``."""

from __future__ import annotations

import copy
import dataclasses
import difflib
import inspect
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any, ClassVar, Self, TypeVar, dataclass_transform

_FIXED = (bool, int, float, str, bytes, tuple, frozenset, type, Path, FunctionType, partial, property)
"""Types of defaults that all instances can share."""

_Class = TypeVar("_Class", bound=type)


@dataclass_transform(kw_only_default=True, field_specifiers=(dataclasses.field,))
def configclass(cls: _Class) -> _Class:
    """Make a class a configuration: a dataclass with keyword arguments, as Isaac Lab's decorator of that name does.

    A subclass may give its fields any default, also a list, a tensor or another configuration: every instance gets a
    copy. A field of a base class needs no annotation to get another default.
    """
    return dataclasses.dataclass(kw_only=True)(cls)  # type: ignore[return-value]


class Config:
    """Base of the configurations: what a subclass writes as defaults becomes fields."""

    elsewhere: ClassVar[Mapping[str, str]] = {}
    """Fields of Isaac Lab's class of that name that this one lacks, and what to write instead."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Give every instance its own copy of a default that can change, and annotate defaults of inherited fields."""
        super().__init_subclass__(**options)
        inherited: dict[str, Any] = (
            {f.name: f.type for f in dataclasses.fields(cls)} if dataclasses.is_dataclass(cls) else {}
        )
        annotations = dict(inspect.get_annotations(cls))
        for name, value in list(vars(cls).items()):
            if name in inherited and name not in annotations:
                annotations[name] = inherited[name]
            if name not in annotations or "ClassVar" in str(annotations[name]) or isinstance(value, dataclasses.Field):
                continue
            if not (value is None or isinstance(value, _FIXED)):
                setattr(cls, name, dataclasses.field(default_factory=partial(copy.deepcopy, value)))
        cls.__annotations__ = annotations

    def __new__(cls, *_: Any, **values: Any) -> Self:
        """Refuse names that are no fields.

        Raises:
            TypeError: If a name is unknown, or the class changes fields and is no dataclass.
        """
        known = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
        if "__dataclass_fields__" not in vars(cls) and (own := [name for name in known if name in vars(cls)]):
            raise TypeError(
                f"{cls.__name__} sets {', '.join(own)}, but it is no dataclass, so that would have no effect. Write "
                "@configclass above it (from pace_envs import configclass)."
            )
        for name in values:
            if name not in known:
                raise TypeError(_unknown(cls, name, known))
        return super().__new__(cls)

    def replace(self, **changes: Any) -> Self:
        """A copy with other values of some fields.

        Raises:
            TypeError: If a name is unknown.
        """
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def copy(self) -> Self:
        """A copy that shares nothing."""
        return copy.deepcopy(self)


def _unknown(cls: type[Config], name: str, known: list[str]) -> str:
    if name in cls.elsewhere:
        return f"{cls.__name__} has no {name}: {cls.elsewhere[name]}"
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return f"{cls.__name__} has no {name!r}.{hint} Available: {', '.join(known)}."
