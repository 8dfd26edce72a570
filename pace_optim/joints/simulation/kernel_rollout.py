"""A rollout of single joints in a few launches: its first control step in torch, all others in kernels."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import torch

from pace_actuators import PaceDCMotor
from pace_envs.compiled_drive.drive_code import Program
from pace_envs.compiled_drive.joint_source import joint_source
from pace_envs.compiled_drive.one_joint import HELD, OneJoint, commands, position_term
from pace_envs.compiler import Compiler
from pace_optim.joints.simulation.simulation import TwinSimulation
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
        steps, reading = int(at[-1]) + 1, rollout.reading(rollout.duration_steps)
        ahead = 0 if reading is None else reading.ahead
        rollout.hold(0)
        first = rollout.robot.sensed_joint_pos().clone()
        result = torch.empty(len(at), num_envs, n, dtype=torch.float64, device=self._device)
        if steps == 1:
            result[:] = first.to(self._device)
            return result
        rollout.advance(0)
        self._record()
        of_late = set() if reading is None else set(reading.late.tolist())
        late = [not of_late.isdisjoint(group.rows) for group in self._groups]
        reading = None if reading is None else reading.to(self._device)
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
                assert reading is not None
                seen[0] = begin
                envs = torch.arange(rows.start, rows.stop, device=self._device)
                seen = between_steps(seen, reading.taken_at(wanted, envs)[..., columns])
            elif int(at[0]) == 0:
                seen[0] = begin
            result[:, rows, columns] = seen
        rollout.simulated_steps += (steps - 1) * num_envs
        return result

    def _record(self) -> None:
        """Record the control step, unless it has been recorded with the same branches."""
        branches = [actuator.branches() for actuator in self._rollout.robot.actuators.values()]
        if branches == self._branches:
            return
        self._branches, self._groups = branches, []
        n, recordings = self._rollout.robot.num_joints, self._rollout.dataset.num_recordings
        for actuator in list(self._rollout.robot.actuators.values()):
            for rows in self._parts:
                program = _recorded(self._rollout, actuator, rows)
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


def _recorded(rollout: Rollout, actuator: PaceDCMotor, rows: range) -> Program:
    """What a control step does to joints of a drive in some rows, in all of which the same effects act.

    Args:
        rollout: Of joints that are simulated alone; it has begun with a control step.
        actuator: One of its robot's drives.

    Raises:
        NotTraceableError: If a kernel cannot do it, such as an effect that branches over a tensor's values.
    """
    position_term(rollout.env)
    joint = OneJoint(rollout.robot, actuator, rows)
    with torch.inference_mode(False):
        sim = _simulation(joint, cast(TwinSimulation, rollout.env.sim))
    with joint.noting():
        robot = joint.in_robot(sim, rollout.dataset)

        def hold() -> None:
            for field, held in zip((sim.qpos, sim.qvel), joint.held(joint.drive.encoder_bias), strict=True):
                sim._set(field, held)
            robot._refresh()

        is_held = rollout.dataset.carried is not None
        shown = joint.control_step(rollout.env.cfg.decimation, rollout.dataset, hold=hold if is_held else None)
        return joint.program(shown)


def _simulation(joint: OneJoint, true: TwinSimulation) -> Any:
    """The simulation of one joint."""
    sim, columns = copy.copy(true), joint.dof_columns
    own, alone = vars(sim), true._stands_alone[columns].double().expand(1, len(joint.rows), -1)
    own |= {"num_envs": 1, "_as_in_model": True, "_shape": (1, 1), "_columns": torch.tensor([0])}
    own |= {"_felt": None, "_steps": 0, "path": _Path(joint, list(true._model_values))}
    softness = () if true.friction_time is None else ("friction_time", "_rate", "_softness", "_rest_inertia")
    for key in ("qpos", "qvel", "qfrc_applied", "_implicit", *softness):
        joint.replace(own, vars(true), key, columns=columns)
    for key, values, places in (
        ("_expanded", true._expanded, columns),
        ("_model_values", true._model_values, true._place(columns)),
    ):
        own[key] = dict(values)
        for name in values:
            joint.replace(own[key], values, name, columns=places)
    own["_stands_alone"] = joint.leaf(lambda: alone, "bool")
    for key in ("inertia", "torque", "stiffness"):
        own[f"_{key}"] = _Series(joint, key)
    for key in ("middle", "begin", "load"):
        own[f"_{key}"] = [_Series(joint, f"{key}.{part}") for part in range(true._steps_per_interval)]
    return sim


class _Series:
    """Values by control step: the present one."""

    def __init__(self, joint: OneJoint, name: str):
        """Of a name."""
        self._joint, self._name = joint, name

    def __getitem__(self, step: int) -> torch.Tensor:
        """At the present step."""
        return self._joint.series(self._name)


class _Path:
    """What effects on the model change of what joints feel."""

    def __init__(self, joint: OneJoint, keys: list[tuple[str, str]]):
        """Of some effects' parameters."""
        self.model_effects = {key: _Change(joint, ".".join(key)) for key in keys}


class _Change:
    """Per unit of one parameter."""

    def __init__(self, joint: OneJoint, name: str):
        """Of a name."""
        self.inertia, self.torque, self.load, self.stiffness = (
            _Series(joint, f"{name}.{part}") for part in ("inertia", "torque", "load", "stiffness")
        )
