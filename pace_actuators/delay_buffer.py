"""A delay of a real number of steps, one per environment."""

import math
from collections.abc import Hashable, Sequence
from typing import Literal, NamedTuple

import torch

from pace_actuators.memory import check_memory
from pace_actuators.part import Part

Interpolation = Literal["linear", "hold"]
EnvIds = Sequence[int] | torch.Tensor | slice | None
"""Environments: indices, a mask (num_envs,) bool, or ``None`` for all."""

_LARGE = 1e7
"""Samples from where on it is looked whether there is memory for them."""
_LARGEST_LEAD = 0.5
"""Of a step: by so much at most a simulator lets a held signal act too early."""


class Jump(NamedTuple):
    """How a signal that is given as its mean changes within the time of the mean."""

    rise: torch.Tensor
    """Its value after the change less that before, (num_envs, num_joints)."""

    share: torch.Tensor
    """The part of the time that is before the change, (num_envs, 1 or num_joints)."""


class DelayBuffer(Part):
    """Delays a batched signal (num_envs, num_joints) by a separate time lag for every environment.

    With the lag d = i + f (i whole steps, f the fraction), the output at step k is

    - ``"linear"``: ``(1 - f) * x[k - i] + f * x[k - i - 1]``, continuous in d;
    - ``"hold"``: ``x[k - ceil(d)]``, what a zero-order hold delayed by d shows at step k.

    A step may have ``parts``, the physics steps in it. Then part p of step k shows the mean, over that part, of the
    held signal delayed by d: with e = d - p / parts and w = min(1, parts (1 + e - ceil(e))),

    - ``"linear"``: ``(1 - w) * x[k - ceil(e) + 1] + w * x[k - ceil(e)]``: the signal switches within one part, exactly
      for the impulse of a torque, and stays continuous in d. With one part it is the formula above.

    After a reset, the first sample stands for everything before it. Gradients flow back through the history, to the
    last reset of all environments.

    On a GPU, where the buffer is in the ring and how old its history is are tensors, one number per environment: a
    CUDA graph repeats a step, and nothing is counted in Python.
    """

    memory = ("_storage", "_head", "_stale", "_any_stale", "_row", "_age")

    def __init__(
        self,
        max_delay: float,
        num_envs: int,
        device: str | torch.device = "cpu",
        interpolation: Interpolation = "linear",
        parts: int = 1,
        counts_on_device: bool | None = None,
    ):
        """Create the buffer with all lags at zero.

        Args:
            max_delay: Largest lag that can be set [steps].
            interpolation: ``"linear"`` or ``"hold"``.
            parts: Into how many parts a step is divided.
            counts_on_device: Whether the place in the ring is a tensor; ``None`` for a GPU's alone.

        Raises:
            ValueError: If ``max_delay`` is negative or not finite, or the interpolation is unknown.
        """
        if not (math.isfinite(max_delay) and max_delay >= 0):
            raise ValueError(f"max_delay is {max_delay}, expected a finite number of steps >= 0.")
        if interpolation not in ("linear", "hold"):
            raise ValueError(f"Unknown delay interpolation {interpolation!r}. Available: 'linear', 'hold'.")
        if max_delay * num_envs > _LARGE and torch.device(device).type == "cpu":
            check_memory(
                8.0 * max_delay * num_envs,
                f"max_delay = {max_delay:g} steps in {num_envs} environments",
                "Lower max_delay in the drive's configuration, or take fewer environments.",
            )
        self.max_delay = float(max_delay)
        self.interpolation = interpolation
        self.parts = parts
        self._num_envs = num_envs
        self._device = torch.device(device)
        self._lead = 0.0
        self._length = math.ceil(max_delay + _LARGEST_LEAD) + 2
        self._lag = torch.zeros(num_envs, 1, dtype=torch.float64, device=self._device)
        self._storage: torch.Tensor | None = None  # (length * num_envs, num_joints)
        self._on_device = self._device.type == "cuda" if counts_on_device is None else counts_on_device
        self._head = 0
        self._stale = torch.ones(num_envs, dtype=torch.bool, device=self._device)
        self._any_stale = True
        self._row = torch.zeros(num_envs, 1, dtype=torch.long, device=self._device)  # of the newest sample
        self._age = torch.full_like(self._row, -1)  # steps from the oldest sample to the newest; -1: no sample
        self._all_zero = True
        self._index_lags()

    @property
    def time_lags(self) -> torch.Tensor:
        """Lags [steps]: one per environment, (num_envs,), or one per joint, (num_envs, num_joints)."""
        return self._lag[:, 0].clone() if self._lag.shape[1] == 1 else self._lag.clone()

    def set_time_lag(self, time_lag: float | torch.Tensor, env_ids: EnvIds = None) -> None:
        """Set the lag of all or some environments; the history is kept.

        Args:
            time_lag: Lag [steps]: a number, one per environment (len(env_ids),), or one per environment and
                joint (len(env_ids), num_joints).
            env_ids: The environments, or ``None`` for all.

        Raises:
            ValueError: If a lag is not a number between 0 and ``max_delay``, or their number is wrong.
        """
        lag = torch.as_tensor(time_lag, dtype=torch.float64, device=self._device)
        if lag.ndim == 1:
            lag = lag[:, None]
        bad = ~((lag >= 0) & (lag <= self.max_delay))
        if bool(bad.any()):
            raise ValueError(
                f"A delay of {lag[bad].flatten()[0].item():g} steps was set, expected 0 to max_delay = "
                f"{self.max_delay:g}. Raise max_delay in the actuator's configuration or bound the delay."
            )
        if lag.ndim == 2 and lag.shape[1] > self._lag.shape[1]:
            with torch.inference_mode(False):  # can be written outside of the caller's inference mode too
                self._lag = self._lag.expand(-1, lag.shape[1]).clone()
        rows = slice(None) if env_ids is None else env_ids
        try:
            self._lag[rows] = lag
        except RuntimeError:
            raise ValueError(
                f"The delay has shape {tuple(lag.shape)}. Expected a number, or {len(self._lag[rows])} rows of "
                "environments, with one column for all joints or one per joint."
            ) from None
        self._index_lags()

    def flags(self) -> dict[str, Hashable]:
        """None: it counts, and what it does is the same."""
        return {}

    def set_lead(self, lead: float) -> None:
        """Say by how much the simulator lets what it gets act too early [steps], 0 to 0.5: it is added to all lags."""
        if lead != self._lead:
            self._lead = lead
            self._index_lags()

    def reset(self, env_ids: EnvIds = None) -> None:
        """Forget the history of all or some environments: indices, or (num_envs,) bool."""
        if self._on_device:
            self._age[slice(None) if env_ids is None else env_ids] = -1
        elif isinstance(env_ids, torch.Tensor) and env_ids.dtype == torch.bool:
            self._stale |= env_ids
        else:
            self._stale[slice(None) if env_ids is None else env_ids] = True
        self._any_stale = not self._on_device
        if env_ids is None and self._storage is not None and self._storage.requires_grad:
            self._storage = self._storage.detach()  # gradients end here too

    def compute(self, data: torch.Tensor) -> torch.Tensor:
        """Push a sample and return the delayed one.

        Args:
            data: The sample, shape (num_envs, num_joints).

        Returns:
            The delayed sample, same shape; of the step's first part.
        """
        if self._storage is None or self._storage.shape[1:] != data.shape[1:]:
            with torch.inference_mode(False):  # as above
                self._storage = data.new_zeros((self._length * self._num_envs, *data.shape[1:]))
            self.reset()
        self._push(data)
        if self._all_zero:
            return data
        if self.parts > 1 and self.interpolation == "linear":
            return self.part(0)
        return self.mean()

    def history(self) -> torch.Tensor:
        """The samples, (length, num_envs, num_joints): the newest, then those before it from the oldest on.

        Raises:
            ValueError: If nothing was appended yet.
        """
        if self._storage is None:
            raise ValueError("The delay has no sample yet: call compute first.")
        back = [0, *range(self._length - 1, 0, -1)]
        return torch.stack([self._seen(self._rows(torch.full_like(self._row, steps))) for steps in back])

    def _push(self, data: torch.Tensor) -> None:
        """Put a sample into the ring."""
        assert self._storage is not None
        history = self._storage.view(self._length, *data.shape)
        if self._on_device:
            self._row.copy_(torch.where(self._row == self._length - 1, 0, self._row + 1))
            self._age.add_(1).clamp_(max=self._length - 1)
            place = self._row.expand_as(data)[None]
            if torch.is_grad_enabled() and (data.requires_grad or history.requires_grad):
                self._storage = history.scatter(0, place.clone(), data[None]).view_as(self._storage)
            else:
                history.scatter_(0, place, data[None])
            return
        if self._any_stale:
            rows = self._stale.nonzero()[:, 0]
            history[:, rows] = data[rows]
            self._stale[:] = False
            self._any_stale = False
        self._head = (self._head + 1) % self._length
        history[self._head] = data

    def changes(self, part: int) -> bool:
        """Whether a part of a step shows something else than the part before it."""
        return part in self._switches

    def part(self, part: int) -> torch.Tensor:
        """What a part of the present step shows, same shape as the samples."""
        if part not in self._at:
            return self.mean()
        newer, older, weight = self._at[part]
        shown = self._seen(older)
        return shown if weight is None else self._seen(newer).lerp_(shown, weight.to(shown.dtype))

    def mean(self) -> torch.Tensor:
        """The mean of what the present step shows, same shape as the samples."""
        newer = self._seen(self._newer)
        return newer if self._whole else newer.lerp_(self._seen(self._older), self._fraction.to(newer.dtype))

    def jump(self, part: int) -> Jump | None:
        """By how much the signal rises within a part of the present step; ``None`` where it does not change there."""
        if self.interpolation == "hold" or self._all_zero:
            return None
        if self.parts > 1:
            newer, older, share = self._at[part]
        else:
            newer, older, share = self._newer, self._older, None if self._whole else self._fraction
        if share is None:
            return None
        rise = self._seen(newer) - self._seen(older)
        return Jump(rise, share.to(rise.dtype))

    def _index_lags(self) -> None:
        """Find the rows of the two samples around each lag."""
        self._total = lag = self._lag + self._lead if self._lead else self._lag
        whole = lag.ceil() if self.interpolation == "hold" else lag.floor()
        self._newer, self._older = self._rows(whole), self._rows(whole + 1)
        self._fraction = torch.zeros_like(lag) if self.interpolation == "hold" else lag - whole
        self._whole = self.interpolation == "hold" or self._all(self._fraction == 0)
        self._all_zero = self._all(lag == 0)
        self._index_parts()

    def _index_parts(self) -> None:
        """The same for every part of a step: the newer and the older sample, and the older one's weight."""
        self._at: dict[int, tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]] = {}
        self._switches: set[int] = set()
        if self.parts == 1 or self.interpolation == "hold":
            return
        before: tuple[torch.Tensor, torch.Tensor] | None = None
        for part in range(self.parts):
            left = self._total - part / self.parts
            back = left.ceil().clamp(min=0.0)
            weight = (self.parts * (1 + left - back)).clamp(max=1.0)
            newer = self._rows((back - 1).clamp(min=0.0))
            self._at[part] = newer, self._rows(back), None if self._all(weight == 1) else weight
            if before is not None and not self._all((before[0] == back) & (before[1] == weight)):
                self._switches.add(part)
            before = back, weight

    def _all(self, which: torch.Tensor) -> bool:
        return bool(which.all())

    def _rows(self, steps: torch.Tensor) -> torch.Tensor:
        """What :meth:`_seen` takes for the samples so many steps back, (num_envs, 1 or num_joints)."""
        if self._on_device:
            return steps.long()
        return torch.arange(self._num_envs)[:, None] - self._num_envs * steps.long()

    def _seen(self, rows: torch.Tensor) -> torch.Tensor:
        """Samples of the past, (num_envs, num_joints).

        Args:
            rows: Of :meth:`_rows`: on a GPU steps back; else rows of the storage while its first place has the newest
                sample.
        """
        assert self._storage is not None  # a sample was pushed before
        if not self._on_device:
            index = (rows + self._head * self._num_envs) % len(self._storage)
            return self._storage.index_select(0, index[:, 0]) if index.shape[1] == 1 else self._storage.gather(0, index)
        history = self._storage.view(self._length, self._num_envs, -1)
        place = self._row - torch.minimum(rows, self._age)
        place = torch.where(place < 0, place + self._length, place)
        return history.gather(0, place.expand(history.shape[1:])[None])[0]
