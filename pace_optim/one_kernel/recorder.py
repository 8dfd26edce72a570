"""Records one control step of a group of joints, with symbols in place of all tensors that it touches."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import torch

from pace_actuators import PaceDCMotor
from pace_actuators.effects import Effect
from pace_envs.mdp import JointPositionAction
from pace_optim.one_kernel.places import Places, Read
from pace_optim.one_kernel.source import source_of
from pace_optim.one_kernel.symbols import Cell, Symbol
from pace_optim.one_kernel.tape import Node, NotTraceableError
from pace_optim.single_joint_model.simulation import TwinSimulation

if TYPE_CHECKING:
    from pace_optim.problem.rollout import Rollout

_SIMULATION = ("qpos", "qvel", "qfrc_applied", "_implicit")
_DATA = ("joint_pos_target", "computed_torque", "applied_torque")


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
    robot, env = rollout.robot, rollout.env
    terms = list(env.action_manager._terms.values())
    if len(terms) != 1 or type(terms[0]) is not JointPositionAction or terms[0]._joint_ids is not None:
        raise NotTraceableError("actions other than the positions of all joints")
    ids = actuator.joint_indices
    columns = torch.arange(robot.num_joints)[ids]
    recorder = Places(rows=rows, columns=columns, dof_columns=robot.dof_columns[columns])
    name = next(name for name, each in robot.actuators.items() if each is actuator)
    with _only(actuator, rows):
        try:
            _swap_all(recorder, rollout, actuator)
            recorder.put(robot, "actuators", {name: actuator})
            shown, updates = _one_step(recorder, rollout, actuator)
        except (AttributeError, IndexError, TypeError, ValueError) as error:  # of an effect that asks for a tensor
            raise NotTraceableError(str(error)) from error
        finally:
            recorder.end()
    used = sorted((delay.ring, read) for delay, read in recorder.delays if delay.ring is not None)
    source, leaves = source_of(recorder.tape, updates, shown, recorder.entries)
    return Recorded(
        source=source,
        leaves=[recorder.reads[i] for i in leaves],
        rings=[read for _, read in used],
        series=recorder.tape.series,
        columns=columns,
    )


def _one_step(recorder: Places, rollout: Rollout, actuator: PaceDCMotor) -> tuple[Node, dict[int, Node]]:
    """Do a control step with symbols; returns what the encoders show before it, and what becomes of the leaves."""
    robot, sim, before = rollout.robot, rollout.env.sim, actuator.flags()
    shown = cast(Symbol, robot.sensed_joint_pos()).cell.node
    if rollout.dataset.torque_enable is not None:
        actuator.set_torque_enable(cast(torch.Tensor, recorder.symbol("torque_enable")))
    for _ in range(rollout.env.cfg.decimation):
        robot.write_data_to_sim()
        sim.step()
        robot.update()
    if actuator.flags() != before:
        raise NotTraceableError("a drive or an effect that counts steps in Python")
    updates: dict[int, Node] = {}
    for slot in recorder.slots:
        after = slot.get()
        if not isinstance(after, Symbol):
            raise NotTraceableError(f"{slot.key}, which is no tensor any more")
        if updates.setdefault(slot.leaf, after.cell.node) is not after.cell.node:
            raise NotTraceableError(f"{slot.key}, which shared its memory and does not any more")
    leaves = {node.index: node for node in recorder.tape.nodes if node.operation == "leaf"}
    return shown, {i: node for i, node in updates.items() if node is not leaves[i]}


def _swap_all(recorder: Places, rollout: Rollout, actuator: PaceDCMotor) -> None:
    """Symbols for the tensors of the drive, its effects, the simulation and the robot's state."""
    robot, data = rollout.robot, rollout.robot.data
    sim = cast(TwinSimulation, rollout.env.sim)
    effects = [] if actuator.effects is None else actuator.effects.effects
    for thing in (robot, sim, data, actuator, *effects):
        recorder.keep(thing)
    recorder.put(sim, "_felt", None)
    recorder.put(sim, "_steps", 0)
    for key in _SIMULATION:
        recorder.swap(sim, key, 0, recorder.dof_columns)
    for name, value in sim._expanded.items():
        if value.ndim == 2:
            recorder.swap(sim._expanded, name, 0, recorder.dof_columns)
    for parameter in sim._model_values:
        recorder.swap(sim._model_values, parameter, 0, sim._place(recorder.dof_columns))
    for key in _DATA:
        recorder.swap(data, key, 0, recorder.columns)
    _share(recorder, robot)
    recorder.put(data, "joint_pos_target", recorder.symbol("command"))
    for key, name in (("joint_vel_target", "command_vel"), ("joint_effort_target", "command_effort")):
        if getattr(rollout.dataset, name) is not None:
            recorder.put(data, key, recorder.symbol(name))
        elif getattr(data, key) is not None:
            raise NotTraceableError("targets that no recording has")
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

    stack = actuator.effects
    if stack is not None:
        recorder.drive_state([stack.state, *(stack._view[effect] for effect in stack.effects)])
    recorder.objects(actuator, 0)
    if actuator._run is not None:
        recorder.objects(actuator._run, 0, lambda: actuator._run)
    for key in list(actuator._delays._buffers):
        recorder.delay(actuator._delays._buffers, key, 0)
    for effect in effects:
        recorder.objects(effect, effect.rows.indices(rollout.env.num_envs)[0])


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
        self.inertia, self.torque, self.load = (
            _Series(recorder, f"{name}.{part}") for part in ("inertia", "torque", "load")
        )


@contextmanager
def _only(actuator: PaceDCMotor, rows: range) -> Iterator[None]:
    """Leave a drive only those effects that act in some rows."""
    stack = actuator.effects
    if stack is None:
        yield
        return
    acting = [effect for effect in stack.effects if _covers(effect, rows, stack._num_envs)]
    actuator.effects = stack.of(acting) if acting else None
    try:
        yield
    finally:
        actuator.effects = stack


def _covers(effect: Effect, rows: range, num_envs: int) -> bool:
    begin, end, _ = effect.rows.indices(num_envs)
    return begin <= rows.start and rows.stop <= end
