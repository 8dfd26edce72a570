"""The delays of a drive: of its commands, or of its torque."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch

from pace_actuators.delay_buffer import DelayBuffer, EnvIds, Interpolation, Jump
from pace_actuators.part import Part

_Signal = TypeVar("_Signal", torch.Tensor, torch.Tensor | None)


class DriveDelays(Part):
    """One lag for several signals, in control steps; the signals come at every run of the controller.

    A signal that is not given (``None``) passes; when it comes back, what was before counts as zero, and for positions
    as the first one.
    """

    memory = ("_silent",)

    def __init__(
        self,
        names: Sequence[str],
        max_delay: float,
        num_envs: int,
        device: torch.device,
        interpolation: Interpolation,
        *,
        runs: int,
        parts: int,
    ):
        """Create the buffers.

        Args:
            names: Of the signals that are delayed; all others pass.
            max_delay: Largest delay [control steps].
            runs: Runs of the controller in a control step.
            parts: Calls of the drive from one run to the next.
        """
        self._runs = runs
        self.buffers = {name: DelayBuffer(max_delay * runs, num_envs, device, interpolation, parts) for name in names}
        """The delay of each signal, by name."""
        self._silent: frozenset[str] = frozenset()  # signals that were not given at the last run

    @property
    def time_lags(self) -> torch.Tensor:
        """Delay [control steps] of each environment, (num_envs,), or joint, (num_envs, num_joints)."""
        return next(iter(self.buffers.values())).time_lags / self._runs

    def set_time_lag(self, delay: torch.Tensor | float, env_ids: EnvIds = None) -> None:
        """Set the delay of all or some environments [control steps]."""
        lag = torch.as_tensor(delay, dtype=torch.float64) * self._runs
        for buffer in self.buffers.values():
            buffer.set_time_lag(lag, env_ids)

    def set_lead(self, lead: float) -> None:
        """Say by how much the simulator lets what it is given act too early [runs of the controller]."""
        for buffer in self.buffers.values():
            buffer.set_lead(lead)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Forget the history of all or some environments."""
        for buffer in self.buffers.values():
            buffer.reset(env_ids)
        if env_ids is None:
            self._silent = frozenset()

    def push(self, name: str, data: _Signal) -> _Signal:
        """Take a signal at a run of the controller, and give what has arrived of it until the next call."""
        buffer = self.buffers.get(name)
        if buffer is None:
            return data
        if data is None:
            self._silent |= {name}
            return None
        if name in self._silent:  # until now there was no target, or it was zero
            self._silent -= {name}
            buffer.reset()
            if name != "positions":
                buffer.compute(torch.zeros_like(data))
        return buffer.compute(data)

    def changes(self, part: int) -> bool:
        """Whether another sample arrives at a call between two runs."""
        return any(buffer.changes(part) for name, buffer in self.buffers.items() if name not in self._silent)

    def at(self, name: str, part: int, undelayed: _Signal) -> _Signal:
        """What has arrived of a signal at a call between two runs; ``undelayed`` if it is not delayed or not given."""
        buffer = self.buffers.get(name)
        return undelayed if buffer is None or name in self._silent else buffer.part(part)

    def mean(self, name: str, undelayed: torch.Tensor) -> torch.Tensor:
        """The mean of what arrives of a signal until the next run; ``undelayed`` if it is not delayed."""
        buffer = self.buffers.get(name)
        return undelayed if buffer is None or name in self._silent else buffer.mean()

    def jump(self, name: str, part: int) -> Jump | None:
        """How a signal changes within a call; ``None`` if it does not, or is not delayed or not given."""
        buffer = self.buffers.get(name)
        return None if buffer is None or name in self._silent else buffer.jump(part)
