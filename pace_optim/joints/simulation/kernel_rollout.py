"""A rollout of single joints in a few launches: its first control step in torch, all others in kernels."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from pace_envs.compiled_drive.drive_code import Program
from pace_envs.compiled_drive.joint_source import joint_source
from pace_envs.compiled_drive.one_joint import HELD, commands
from pace_envs.compiler import Compiler
from pace_optim.joints.simulation.kernel_recorder import record
from pace_optim.problem.rollout import between_steps

if TYPE_CHECKING:
    from pace_optim.problem.rollout import Rollout

_OF_RECORDINGS = ("command", "command_vel", "command_effort", "torque_enable")
_WIDTH = 32
"""Threads of a block: each goes its way alone, and few blocks spread over the GPU."""


@dataclass(kw_only=True)
class _Group:
    """Joints of a drive in some rows, in all of which the same effects act."""

    rows: range
    program: Program
    source: str
    leaves: list[int]
    """Those that it reads."""
    place: torch.Tensor
    """Of each joint's numbers in a series, on the device."""

    @property
    def count(self) -> int:
        """Threads."""
        return len(self.place)


class KernelRollout:
    """Simulates a rollout whose parameters have been written and that has begun."""

    def __init__(self, rollout: Rollout, parts: Sequence[range], compiler: Compiler, device: torch.device):
        """Keep what is needed; nothing is recorded yet.

        Args:
            rollout: Of joints that are simulated alone, on the processor.
            parts: All its environments; in those of a part the same effects act.
            compiler: Compiles kernels.
            device: Where they run.
        """
        self._rollout, self._parts, self._compiler, self._device = rollout, list(parts), compiler, device
        self._groups: list[_Group] = []
        self._branches: object = None
        self._series: dict[tuple[tuple[str, ...], int], torch.Tensor] = {}
        self._streams: list[torch.cuda.Stream] = []

    def positions(self, at: torch.Tensor) -> torch.Tensor:
        """What the encoders show at control steps, as late as effects on the recording have it.

        Args:
            at: Control steps, ascending.

        Returns:
            (len(at), num_envs, n) float64 [rad] on the device.

        Raises:
            NotTraceableError: If a kernel cannot do what an effect does.
        """
        rollout = self._rollout
        num_envs, n = rollout.env.num_envs, rollout.robot.num_joints
        steps = int(at[-1]) + 1
        lag, offset = rollout.observation_lag(rollout.duration_steps), rollout.dataset.sample_offset
        if lag is None and offset is not None:
            lag = torch.zeros(2, num_envs, n, dtype=torch.float64)
        most = 0.0 if offset is None else float(offset.abs().max())
        ahead = 0 if lag is None else max(0, math.ceil(most - float(lag.min()))) + 2
        rollout.hold(0)
        first = rollout.robot.sensed_joint_pos().clone()
        result = torch.empty(len(at), num_envs, n, dtype=torch.float64, device=self._device)
        if steps == 1:
            result[:] = first.to(self._device)
            return result
        rollout.advance(0)
        self._record()
        late = [lag is not None and (offset is not None or bool(lag[:, g.rows].any())) for g in self._groups]
        wanted = at.to(self._device, torch.int32)
        whole = torch.arange(steps + ahead, dtype=torch.int32, device=self._device)
        own, every = _slots(wanted, steps), _slots(whole, steps + ahead)
        leaves = self._upload([torch.cat([g.program.leaves[i]().reshape(-1) for i in g.leaves]) for g in self._groups])
        rings = self._upload(
            [torch.cat([torch.zeros(1), *(r().reshape(-1) for r in g.program.rings)])[1:] for g in self._groups]
        )
        outs = []
        with self._side_by_side() as streams:
            for i, group in enumerate(self._groups):
                slot, last = (every, steps + ahead) if late[i] else (own, steps)
                series = self._series_of(group.program.tape.series, steps + ahead)
                out = torch.empty(
                    len(slot) if late[i] else len(at), group.count, dtype=torch.float64, device=self._device
                )
                outs.append(out)
                with streams[i % len(streams)]:
                    self._compiler.launch(
                        group.source,
                        group.count,
                        _WIDTH,
                        [group.count, 1, last, steps + ahead, rollout.dataset.num_recordings * n]
                        + [group.place, leaves[i], rings[i], series, slot, out],
                    )
        shown = first.to(self._device)
        for group, out, is_late in zip(self._groups, outs, late, strict=True):
            rows, columns = slice(group.rows.start, group.rows.stop), group.program.columns.to(self._device)
            begin = shown[rows][:, columns]
            seen = out.view(len(out), *begin.shape)
            if is_late:
                assert lag is not None
                seen[0] = begin
                own_lag = lag[:, rows][..., group.program.columns].to(self._device)
                when = _when(wanted, own_lag, rollout.duration_steps)
                if offset is not None:
                    recording = torch.arange(group.rows.start, group.rows.stop) % rollout.dataset.num_recordings
                    when = when + offset[at][:, recording, None].to(self._device)
                seen = between_steps(seen, when)
            elif int(at[0]) == 0:
                seen[0] = begin
            result[:, rows, columns] = seen
        rollout.simulated_steps += (steps - 1) * num_envs
        return result

    # ------------------------------------------------------------------ inside

    def _record(self) -> None:
        """Record the control step, unless it has been recorded with the same branches."""
        branches = [actuator.branches() for actuator in self._rollout.robot.actuators.values()]
        if branches == self._branches:
            return
        self._branches, self._groups = branches, []
        n, recordings = self._rollout.robot.num_joints, self._rollout.dataset.num_recordings
        for actuator in list(self._rollout.robot.actuators.values()):
            for rows in self._parts:
                program = record(self._rollout, actuator, rows)
                source, leaves = joint_source(program)
                recording = torch.arange(rows.start, rows.stop) % recordings
                place = (recording[:, None] * n + program.columns).reshape(-1).to(self._device, torch.int32)
                self._groups.append(_Group(rows=rows, program=program, source=source, leaves=leaves, place=place))
        self._compiler.compile([group.source for group in self._groups])

    def _series_of(self, names: Sequence[str], steps: int) -> torch.Tensor:
        """Series by control step, (names, steps, R n) on the device."""
        key = tuple(names), steps
        if key not in self._series:
            series = [_lengthened(self._one(name), steps) for name in names]
            self._series[key] = torch.stack(series).to(self._device)
        return self._series[key]

    def _one(self, name: str) -> torch.Tensor:
        """A series by name, (T, R n)."""
        rollout = self._rollout
        if name in _OF_RECORDINGS:
            value = commands(rollout.env, rollout.dataset, name)
        elif name in HELD and (carried := rollout.dataset.carried) is not None:
            value = dict(zip(HELD, (carried.free, *carried.measured.unbind(dim=-1)), strict=True))[name]
        else:
            value = rollout.env.sim.series(name)  # type: ignore[attr-defined]
        return value.double().reshape(len(value), -1)

    def _upload(self, parts: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Tensors on the device, in one piece."""
        whole = torch.cat([part.double() for part in parts]).to(self._device)
        return list(whole.split([len(part) for part in parts]))

    @contextlib.contextmanager
    def _side_by_side(self) -> Iterator[list]:
        """Streams whose kernels run beside each other."""
        if self._device.type != "cuda":
            yield [contextlib.nullcontext()]
            return
        if not self._streams:
            self._streams = [torch.cuda.Stream(self._device) for _ in range(min(16, len(self._groups)))]
        now = torch.cuda.current_stream(self._device)
        for stream in self._streams:
            stream.wait_stream(now)
        yield [torch.cuda.stream(stream) for stream in self._streams]
        for stream in self._streams:
            now.wait_stream(stream)


def _slots(at: torch.Tensor, steps: int) -> torch.Tensor:
    """Where each control step is among some, -1 where it is not."""
    slots = torch.full((steps,), -1, dtype=torch.int32, device=at.device)
    slots[at.long()] = torch.arange(len(at), dtype=torch.int32, device=at.device)
    return slots


def _lengthened(values: torch.Tensor, steps: int) -> torch.Tensor:
    """The last value held, or what is too long left out."""
    if len(values) >= steps:
        return values[:steps]
    return torch.cat([values, values[-1:].expand(steps - len(values), -1)])


def _when(at: torch.Tensor, lag: torch.Tensor, steps: int) -> torch.Tensor:
    """At which control step samples were taken, (K, m, n).

    Args:
        at: The steps that they are stamped with, (K,).
        lag: Of the first and the last sample [control steps], (2, m, n).
        steps: Control steps of the rollout.
    """
    rate = (lag[1] - lag[0]) / max(1, steps - 1)
    k = at.double()[:, None, None]
    return k - (lag[0] + rate * k)
