"""Records one control step of a group of joints, with symbols in place of all tensors that it touches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import torch

from pace_actuators import PaceDCMotor
from pace_envs.compiled_drive.drive import only_drive, recording, swap_drive, swap_targets, updates_of
from pace_envs.compiled_drive.slots import Places, Read
from pace_envs.compiled_drive.source import source_of
from pace_envs.compiled_drive.symbols import Cell, Symbol
from pace_envs.compiled_drive.tape import Node, NotTraceableError
from pace_optim.joints.simulation.simulation import TwinSimulation

if TYPE_CHECKING:
    from pace_optim.problem.rollout import Rollout

HELD = ("held_free", "held_position", "held_speed")
"""Series that say where joints are held, and where they are free."""
_SIMULATION = ("qpos", "qvel", "qfrc_applied", "_implicit")


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What one control step does to one joint, and where its first numbers are."""

    source: str
    """In C: see :func:`source_of`."""
    leaves: list[Read]
    """Read the first numbers of each leaf, (entries, rows, joints)."""
    rings: list[Read]
    """Read the memory of each delay, (length, rows, joints), the newest first."""
    series: list[str]
    """Names of the series that it reads, in order."""
    columns: torch.Tensor
    """The joints among those of the robot, (joints,)."""


def record(rollout: Rollout, actuator: PaceDCMotor, rows: range) -> Recorded:
    """What a control step does to joints of a drive in some rows, in all of which the same effects act.

    The rollout must have begun with a control step: what happens only then is not recorded.

    Args:
        rollout: Of joints that are simulated alone.
        actuator: One of its robot's drives.
        rows: Environments.

    Raises:
        NotTraceableError: If a kernel cannot do it, such as an effect that branches over a tensor's values.
    """
    robot, sim = rollout.robot, rollout.env.sim
    with recording(rollout.env, robot, actuator, rows, more=[sim]) as recorder:
        _swap_all(recorder, rollout, actuator)
        only_drive(recorder, robot, actuator)
        shown, updates = _one_step(recorder, rollout, actuator)
    used = sorted((delay.ring, read) for delay, read in recorder.delays if delay.ring is not None)
    source, leaves = source_of(recorder.tape, updates, shown, recorder.entries)
    return Recorded(
        source=source,
        leaves=[recorder.reads[i] for i in leaves],
        rings=[read for _, read in used],
        series=recorder.tape.series,
        columns=recorder.columns,
    )


def _one_step(recorder: Places, rollout: Rollout, actuator: PaceDCMotor) -> tuple[Node, dict[int, Node]]:
    """Do a control step with symbols; returns what the encoders show before it, and what becomes of the leaves."""
    robot, sim, before = rollout.robot, cast(TwinSimulation, rollout.env.sim), actuator.flags()
    if rollout.dataset.carried is not None:
        free, position, speed = (cast(torch.Tensor, recorder.symbol(name)) for name in HELD)
        position = position + actuator.encoder_bias
        for field, held in ((sim.qpos, position), (sim.qvel, speed)):
            sim._set(field, torch.where(free > 0.5, sim._joints(field), held))
        robot._refresh()
    shown = cast(Symbol, robot.sensed_joint_pos()).cell.node
    if rollout.dataset.torque_enable is not None:
        actuator.set_torque_enable(cast(torch.Tensor, recorder.symbol("torque_enable")))
    for _ in range(rollout.env.cfg.decimation):
        robot.write_data_to_sim()
        sim.step()
        robot.update()
    if actuator.flags() != before:
        raise NotTraceableError("a drive or an effect that counts steps in Python")
    return shown, updates_of(recorder)


def _swap_all(recorder: Places, rollout: Rollout, actuator: PaceDCMotor) -> None:
    """Symbols for the tensors of the drive, its effects, the simulation and the robot's state."""
    robot = rollout.robot
    sim = cast(TwinSimulation, rollout.env.sim)
    recorder.put(sim, "_felt", None)
    recorder.put(sim, "_steps", 0)
    for key in _SIMULATION:
        recorder.swap(sim, key, 0, recorder.dof_columns)
    for name, value in sim._expanded.items():
        if value.ndim == 2:
            recorder.swap(sim._expanded, name, 0, recorder.dof_columns)
    for parameter in sim._model_values:
        recorder.swap(sim._model_values, parameter, 0, sim._place(recorder.dof_columns))
    _share(recorder, robot)
    swap_targets(recorder, robot, rollout.dataset)
    for key in ("inertia", "torque", "stiffness"):
        recorder.put(sim, f"_{key}", _Series(recorder, key))
    for key in ("middle", "begin", "load"):
        parts = range(sim._steps_per_interval)
        recorder.put(sim, f"_{key}", [_Series(recorder, f"{key}.{part}") for part in parts])
    recorder.put(sim, "path", _Path(recorder, list(sim._model_values)))
    alone = sim._stands_alone[recorder.dof_columns].double()
    shape = (1, len(recorder.rows), len(recorder.columns))
    index = recorder.leaf(lambda: alone.expand(shape))
    symbol = Symbol(recorder.operations, Cell(recorder.tape.leaf(index, "bool")), shape[1:])
    recorder.put(sim, "_stands_alone", symbol)

    swap_drive(recorder, actuator, rollout.env.num_envs)


def _share(recorder: Places, robot: Any) -> None:
    """Positions and speeds of the robot: the simulation's own memory, or a copy that is read after each step."""
    for key, of in (("joint_pos", "qpos"), ("joint_vel", "qvel")):
        if robot._layout.side_by_side:
            own = getattr(robot._sim, of)
            recorder.put(robot.data, key, Symbol(recorder.operations, own.cell, own.shape))
        else:
            recorder.swap(robot.data, key, 0, recorder.columns)


class _Series:
    """Values by control step: the present one."""

    def __init__(self, recorder: Places, name: str):
        """Of a name."""
        self._recorder, self._name = recorder, name

    def __getitem__(self, step: int) -> Symbol:
        """At the present step."""
        return self._recorder.symbol(self._name)


class _Path:
    """What effects on the model change of what joints feel."""

    def __init__(self, recorder: Places, keys: list[tuple[str, str]]):
        """Of some effects' parameters."""
        self.model_effects = {key: _Change(recorder, ".".join(key)) for key in keys}


class _Change:
    """Per unit of one parameter."""

    def __init__(self, recorder: Places, name: str):
        """Of a name."""
        self.inertia, self.torque, self.load, self.stiffness = (
            _Series(recorder, f"{name}.{part}") for part in ("inertia", "torque", "load", "stiffness")
        )
