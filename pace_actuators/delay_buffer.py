"""A delay of a real number of steps, one per environment."""

import math
from collections.abc import Sequence
from typing import Literal

import torch

Interpolation = Literal["linear", "hold"]


class DelayBuffer:
    """Delays a batched signal (num_envs, num_joints) by a time lag of its own for every environment.

    With the lag d = i + f (i whole steps, f the fraction), the output at step k is

    - ``"linear"``: ``(1 - f) * x[k - i] + f * x[k - i - 1]``, continuous in d;
    - ``"hold"``: ``x[k - ceil(d)]``, what a zero-order hold delayed by d shows at step k.

    After a reset, the first sample stands for everything before it.
    """

    def __init__(
        self,
        max_delay: float,
        num_envs: int,
        device: str | torch.device = "cpu",
        interpolation: Interpolation = "linear",
    ):
        """Create the buffer with all lags at zero.

        Args:
            max_delay: Largest lag that can be set [steps].
            num_envs: Number of environments.
            device: Device of the signal.
            interpolation: ``"linear"`` or ``"hold"``.

        Raises:
            ValueError: If ``max_delay`` is negative or not finite, or the interpolation is unknown.
        """
        if not (math.isfinite(max_delay) and max_delay >= 0):
            raise ValueError(f"max_delay is {max_delay}, expected a finite number of steps >= 0.")
        if interpolation not in ("linear", "hold"):
            raise ValueError(f"Unknown delay interpolation {interpolation!r}. Available: 'linear', 'hold'.")
        self.max_delay = float(max_delay)
        self.interpolation = interpolation
        self._num_envs = num_envs
        self._device = torch.device(device)
        self._length = math.ceil(max_delay) + 2
        self._lag = torch.zeros(num_envs, 1, dtype=torch.float64, device=self._device)
        self._storage: torch.Tensor | None = None  # (length * num_envs, num_joints)
        self._head = 0
        self._stale = torch.ones(num_envs, dtype=torch.bool, device=self._device)
        self._any_stale = True
        self._all_zero = True
        self._index_lags()

    @property
    def time_lags(self) -> torch.Tensor:
        """Lags [steps]: one per environment, (num_envs,), or one per joint, (num_envs, num_joints)."""
        return self._lag[:, 0].clone() if self._lag.shape[1] == 1 else self._lag.clone()

    def set_time_lag(
        self, time_lag: float | torch.Tensor, env_ids: Sequence[int] | torch.Tensor | slice | None = None
    ) -> None:
        """Set the lag of all or some environments; the history is kept.

        Args:
            time_lag: Lag [steps]: a number, one per environment (len(env_ids),), or one per environment and
                joint (len(env_ids), num_joints).
            env_ids: The environments, or ``None`` for all.

        Raises:
            ValueError: If a lag is not a number between 0 and ``max_delay``.
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
        self._lag[slice(None) if env_ids is None else env_ids] = lag
        self._index_lags()

    def reset(self, env_ids: Sequence[int] | torch.Tensor | slice | None = None) -> None:
        """Forget the history of all or some environments."""
        self._stale[slice(None) if env_ids is None else env_ids] = True
        self._any_stale = True

    def compute(self, data: torch.Tensor) -> torch.Tensor:
        """Push a sample and return the delayed one.

        Args:
            data: The sample, shape (num_envs, num_joints).

        Returns:
            The delayed sample, same shape.
        """
        if self._storage is None or self._storage.shape[1:] != data.shape[1:]:
            with torch.inference_mode(False):  # as above
                self._storage = data.new_empty((self._length * self._num_envs, *data.shape[1:]))
            self.reset()
        if self._any_stale:
            self._storage.view(self._length, *data.shape)[:, self._stale] = data[self._stale]
            self._stale[:] = False
            self._any_stale = False
        self._head = (self._head + 1) % self._length
        start = self._head * self._num_envs
        self._storage[start : start + self._num_envs] = data
        if self._all_zero:
            return data
        newer = _look_up(self._storage, self._newer[self._head])
        if self._whole:
            return newer
        older = _look_up(self._storage, self._older[self._head])
        return newer.lerp_(older, self._fraction.to(data.dtype))

    def _index_lags(self) -> None:
        """Tabulate, for every head position, the rows of the two samples around each lag."""
        whole = self._lag.ceil() if self.interpolation == "hold" else self._lag.floor()
        self._fraction = torch.zeros_like(self._lag) if self.interpolation == "hold" else self._lag - whole
        self._whole = not bool(self._fraction.any())
        self._all_zero = not bool(self._lag.any())
        heads = torch.arange(self._length, device=self._device)[:, None]
        if whole.shape[1] == 1:
            steps, envs = whole[:, 0].long(), torch.arange(self._num_envs, device=self._device)
        else:
            heads, steps = heads[..., None], whole.long()
            envs = torch.arange(self._num_envs, device=self._device)[:, None]
        self._newer = ((heads - steps) % self._length) * self._num_envs + envs
        self._older = ((heads - steps - 1) % self._length) * self._num_envs + envs


def _look_up(storage: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Whole rows for one lag per environment, single entries for one per joint."""
    return storage.index_select(0, index) if index.ndim == 1 else storage.gather(0, index)
