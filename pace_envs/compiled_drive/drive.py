"""Records what a drive and its effects do, with symbols in place of all their tensors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

import torch

from pace_actuators import PaceDCMotor
from pace_actuators.effects import Effect
from pace_envs.compiled_drive.slots import Places
from pace_envs.compiled_drive.symbols import Symbol
from pace_envs.compiled_drive.tape import Node, NotTraceableError
from pace_envs.mdp import JointPositionAction

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv
    from pace_envs.articulation import Articulation

_DATA = ("joint_pos_target", "computed_torque", "applied_torque")
_TARGETS = (("joint_vel_target", "command_vel"), ("joint_effort_target", "command_effort"))


class Commands(Protocol):
    """What R recordings tell a robot of n joints in T control steps."""

    @property
    def num_recordings(self) -> int:
        """R."""

    @property
    def command(self) -> torch.Tensor:
        """Position targets, (T, R, n) [rad]."""

    @property
    def command_vel(self) -> torch.Tensor | None:
        """Velocity targets, (T, R, n) [rad/s]."""

    @property
    def command_effort(self) -> torch.Tensor | None:
        """Torques [N m] that are added, (T, R, n)."""

    @property
    def torque_enable(self) -> torch.Tensor | None:
        """Whether the drives are on, (T, R) bool."""


@contextmanager
def recording(
    env: ManagerBasedEnv, robot: Articulation, actuator: PaceDCMotor, rows: range, more: Sequence[Any] = ()
) -> Iterator[Places]:
    """Places for symbols of a drive in some rows, in all of which the same effects act; in the end all is put back.

    Args:
        env: Whose actions are the positions of all joints.
        robot: Whose drive it is.
        actuator: The drive.
        rows: Environments.
        more: Objects that symbols get into, beside the robot, the drive and the effects.

    Raises:
        NotTraceableError: If a kernel cannot do it, such as an effect that branches over a tensor's values.
    """
    _position_term(env)
    columns = torch.arange(robot.num_joints)[actuator.joint_indices]
    places = Places(rows=rows, columns=columns, dof_columns=robot.dof_columns[columns])
    with _only(actuator, rows):
        try:
            effects = [] if actuator.effects is None else actuator.effects.effects
            for thing in (robot, robot.data, actuator, *effects, *more):
                places.keep(thing)
            yield places
        except (AttributeError, IndexError, TypeError, ValueError) as error:  # of an effect that asks for a tensor
            raise NotTraceableError(str(error)) from error
        finally:
            places.end()


def only_drive(places: Places, robot: Articulation, actuator: PaceDCMotor) -> None:
    """Leave a robot one of its drives."""
    name = next(name for name, each in robot.actuators.items() if each is actuator)
    places.put(robot, "actuators", {name: actuator})


def swap_targets(places: Places, robot: Articulation, dataset: Commands) -> None:
    """Symbols for what the robot is told: the recordings' commands."""
    for key in _DATA:
        places.swap(robot.data, key, 0, places.columns)
    places.put(robot.data, "joint_pos_target", places.symbol("command"))
    for key, name in _TARGETS:
        if getattr(dataset, name) is not None:
            places.put(robot.data, key, places.symbol(name))
        elif getattr(robot.data, key) is not None:
            raise NotTraceableError("targets that no recording has")


def swap_drive(places: Places, actuator: PaceDCMotor, num_envs: int) -> None:
    """Symbols for the tensors of a drive and its effects."""
    stack = actuator.effects
    effects = [] if stack is None else stack.effects
    if stack is not None:
        places.drive_state([stack.state, *(stack._view[effect] for effect in effects)])
    places.objects(actuator, 0)
    if actuator._run is not None:
        places.objects(actuator._run, 0, lambda: actuator._run)
    for key in list(actuator._delays._buffers):
        places.delay(actuator._delays._buffers, key, 0)
    for effect in effects:
        places.objects(effect, effect.rows.indices(num_envs)[0])


def updates_of(places: Places) -> dict[int, Node]:
    """What has become of the leaves, by index.

    Raises:
        NotTraceableError: If something is no tensor any more, or has left the memory that it shared.
    """
    updates: dict[int, Node] = {}
    for slot in places.slots:
        after = slot.get()
        if not isinstance(after, Symbol):
            raise NotTraceableError(f"{slot.key}, which is no tensor any more")
        if updates.setdefault(slot.leaf, after.cell.node) is not after.cell.node:
            raise NotTraceableError(f"{slot.key}, which shared its memory and does not any more")
    leaves = {node.index: node for node in places.tape.nodes if node.operation == "leaf"}
    return {i: node for i, node in updates.items() if node is not leaves[i]}


def commands(env: ManagerBasedEnv, dataset: Commands, name: str) -> torch.Tensor:
    """A series of the recordings by control step, (T, R, n): the position targets, what else is told, or the switch."""
    if name == "command":
        term = _position_term(env)
        term.process_actions(dataset.command)
        return term.processed_actions
    if name == "torque_enable":
        assert dataset.torque_enable is not None
        return dataset.torque_enable[..., None].expand(-1, -1, dataset.command.shape[-1])
    return getattr(dataset, name)


def _position_term(env: ManagerBasedEnv) -> JointPositionAction:
    """The only action: targets of all joints."""
    (term, *others) = env.action_manager._terms.values()
    if others or type(term) is not JointPositionAction or term._joint_ids is not None:
        raise NotTraceableError("actions other than the positions of all joints")
    return term


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
