"""What all managers share: terms by name, resolved once."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import torch

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv


@dataclasses.dataclass(kw_only=True)
class SceneEntityCfg:
    """Joints and bodies of an entity, named by regular expressions and found once, when the managers load."""

    name: str = "robot"
    """Name of the entity in the scene."""

    joint_names: str | tuple[str, ...] | None = None
    """Expressions of joints; ``None`` means all."""

    body_names: str | tuple[str, ...] | None = None
    """Expressions of bodies; ``None`` means all."""

    preserve_order: bool = False
    """Order by the expressions instead of by the entity's own order."""

    joint_ids: slice | list[int] | torch.Tensor = dataclasses.field(default_factory=lambda: slice(None))
    """Filled in by :meth:`resolve`."""

    body_ids: slice | list[int] | torch.Tensor = dataclasses.field(default_factory=lambda: slice(None))
    """Filled in by :meth:`resolve`."""

    def resolve(self, env: ManagerBasedEnv) -> SceneEntityCfg:
        """A copy with ``joint_ids`` and ``body_ids`` filled in."""
        resolved, entity = dataclasses.replace(self), env.scene[self.name]
        if self.joint_names is not None:
            resolved.joint_ids = _on_device(
                env, entity.find_joints(self.joint_names, preserve_order=self.preserve_order)[0]
            )
        if self.body_names is not None:
            resolved.body_ids = _on_device(
                env, entity.find_bodies(self.body_names, preserve_order=self.preserve_order)[0]
            )
        return resolved


def _on_device(env: ManagerBasedEnv, ids: list[int]) -> list[int] | torch.Tensor:
    """Indices where the tensors are: a list would be copied to a GPU, which waits for it, at every use."""
    return ids if env.device.type == "cpu" else torch.tensor(ids, device=env.device)


@dataclasses.dataclass(kw_only=True)
class ManagerTermBaseCfg:
    """A term: a function ``(env, **params)``, or a class built as ``(cfg, env)`` and then called so."""

    func: Callable[..., Any]
    """The function or class."""

    params: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Arguments after ``env``."""


class ManagerTermBase:
    """Base of terms that keep state."""

    def __init__(self, cfg: ManagerTermBaseCfg, env: ManagerBasedEnv):
        """Keep the configuration and the environment."""
        self.cfg = cfg
        self._env = env

    def __call__(self, env: ManagerBasedEnv, *args: Any, **params: Any) -> Any:
        """What a function term would do; subclasses name their parameters."""
        raise NotImplementedError

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget the state of some environments."""


Number = float | torch.Tensor
"""A number to log; on a GPU a tensor without dimensions, so that nothing waits for it before it is written."""


def as_numbers(log: Mapping[str, torch.Tensor]) -> dict[str, Number]:
    """Tensors without dimensions as numbers to log."""
    return {name: value.item() if value.device.type == "cpu" else value for name, value in log.items()}


def state_only(func: Callable[..., Any]) -> Callable[..., Any]:
    """Marks an event that changes positions, speeds and targets alone, and treats every environment by itself.

    On a GPU it may be run on all environments; the others get their values back, and nothing has to wait for
    the GPU to count them (:meth:`pace_envs.scene.InteractiveScene.only_where`).
    """
    func.changes_state_only = True  # type: ignore[attr-defined]
    return func


CfgT = TypeVar("CfgT", bound=ManagerTermBaseCfg)
TermT = TypeVar("TermT")


class Term(Generic[CfgT]):
    """A term with its function and parameters resolved."""

    def __init__(self, name: str, cfg: CfgT, env: ManagerBasedEnv, *, num_args: int = 1):
        """Resolve scene entities, build class terms and check the arguments.

        Args:
            num_args: Number of arguments that come before its params: ``env``, and for events ``env_ids``.
        """
        self.name = name
        self.cfg = cfg
        self._env = env
        self.params = {
            key: value.resolve(env) if isinstance(value, SceneEntityCfg) else value for key, value in cfg.params.items()
        }
        self.func: Callable[..., Any] = cfg.func(cfg, env) if isinstance(cfg.func, type) else cfg.func
        self._check_arguments(num_args)

    def __call__(self, *args: Any) -> Any:
        """Call the term's function: ``func(env, *args, **params)``."""
        return self.func(self._env, *args, **self.params)

    @property
    def changes_state_only(self) -> bool:
        """Whether it is an event that :func:`state_only` marks."""
        return getattr(self.func, "changes_state_only", False)

    @property
    def keeps_state(self) -> bool:
        """Whether a reset concerns it."""
        return isinstance(self.func, ManagerTermBase) and type(self.func).reset is not ManagerTermBase.reset

    def reset(self, env_ids: torch.Tensor) -> None:
        """Reset the state of a class term."""
        if isinstance(self.func, ManagerTermBase):
            self.func.reset(env_ids)

    def _check_arguments(self, num_args: int) -> None:
        accepted = inspect.signature(self.func).parameters
        if any(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in accepted.values()):
            return
        takes = list(accepted)[num_args:]
        unknown = [name for name in self.params if name not in takes]
        missing = [n for n in takes if accepted[n].default is inspect.Parameter.empty and n not in self.params]
        if unknown or missing:
            wrong = f"got unknown params {', '.join(unknown)}" if unknown else f"lacks {', '.join(missing)}"
            raise ValueError(f"The term {self.name!r} {wrong}. Params of its function: {', '.join(takes) or 'none'}.")


class ManagerBase(Generic[CfgT]):
    """A manager of terms that are functions."""

    def __init__(self, cfg: Any, env: ManagerBasedEnv, *, num_args: int = 1):
        """Resolve the terms of a dict, or of an object whose attributes are terms."""
        self.terms: list[Term[CfgT]] = [
            Term(name, term, env, num_args=num_args) for name, term in term_items(cfg).items()
        ]

    @property
    def active_terms(self) -> Any:
        """Names of the terms."""
        return [term.name for term in self.terms]

    @property
    def takes_masks(self) -> bool:
        """Whether a reset of environments that are not counted does what :meth:`reset` does."""
        return not any(term.keeps_state for term in self.terms)

    def reset(self, env_ids: torch.Tensor) -> dict[str, Number]:
        """Reset class terms; returns numbers to log."""
        for term in self.terms:
            term.reset(env_ids)
        return {}


class ClassTerms(Generic[TermT]):
    """Terms that are objects of their configurations' classes, by name."""

    def __init__(self, cfg: Any, env: ManagerBasedEnv, what: str):
        """Build the terms of a dict, or of an object whose attributes are their configurations.

        Args:
            what: What a term is called in messages.
        """
        self._terms: dict[str, TermT] = {name: term.class_type(term, env) for name, term in term_items(cfg).items()}
        self._what = what

    @property
    def active_terms(self) -> list[str]:
        """Names of the terms."""
        return list(self._terms)

    @property
    def terms(self) -> list[TermT]:
        """The terms."""
        return list(self._terms.values())

    def get_term(self, name: str) -> TermT:
        """The term of that name."""
        if name not in self._terms:
            raise KeyError(f"There is no {self._what} {name!r}. Available: {', '.join(self._terms) or 'none'}.")
        return self._terms[name]


def term_items(cfg: Any) -> dict[str, Any]:
    """Terms by name, of a dict or of an object whose attributes are terms; ``None`` switches a term off."""
    if cfg is None:
        return {}
    items = cfg if isinstance(cfg, Mapping) else vars(cfg)
    return {name: term for name, term in items.items() if term is not None}
