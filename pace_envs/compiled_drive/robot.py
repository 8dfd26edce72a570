"""Records one control step of a drive of a whole robot; between its calls MuJoCo steps the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import torch

from pace_actuators import PaceDCMotor
from pace_envs.compiled_drive.drive import Commands, only_drive, recording, swap_drive, swap_targets, updates_of
from pace_envs.compiled_drive.slots import Places, Read
from pace_envs.compiled_drive.symbols import Cell, Symbol
from pace_envs.compiled_drive.tape import Node, NotTraceableError, Tape
from pace_envs.simulation import Simulation

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv

STATE = ("qpos", "qvel", "qfrc_bias")
"""Fields of MuJoCo's data that drives and effects read."""
WRITTEN = ("qvel", "qfrc_applied", "dof_armature", "dof_frictionloss", "dof_damping")
"""Fields of MuJoCo's data and model that they write before a physics step."""


@dataclass(frozen=True, kw_only=True)
class DriveProgram:
    """What one control step does to each joint of a drive."""

    tape: Tape
    """With a ``"physics"`` node where MuJoCo steps: it has the index of a row of ``written``."""
    written: list[dict[str, Node]]
    """What is written into MuJoCo's fields before each physics step, and after the last."""
    updates: dict[int, Node]
    """What becomes of leaves in a control step, by index."""
    shown: Node
    """What the encoders show before it."""
    torque: Node | None
    """What the motor gives in its first physics step [N m]; ``None``: it is not shown."""
    entries: list[int]
    """How many numbers each leaf has."""
    leaves: list[Read]
    """Read the first numbers of each leaf, (entries, rows, joints)."""
    rings: list[Read]
    """Read the memory of each delay, (length, rows, joints), the newest first."""
    columns: torch.Tensor
    """The drive's joints among those of the robot, (joints,)."""


def record_drive(env: ManagerBasedEnv, dataset: Commands, actuator: PaceDCMotor) -> DriveProgram:
    """What a control step does to the joints of a drive, in all environments.

    The robot must have made a control step: what happens only in the first one is not recorded.

    Args:
        env: The environment.
        dataset: The recordings whose commands it follows.
        actuator: One of its robot's drives.

    Raises:
        NotTraceableError: If a kernel cannot do it.
    """
    robot, stack = env.scene["robot"], actuator.effects
    if type(actuator) is not PaceDCMotor:
        raise NotTraceableError("a drive of the user's own")
    every = range(env.num_envs)
    if stack is not None and any(effect.rows.indices(env.num_envs) != (0, len(every), 1) for effect in stack.effects):
        raise NotTraceableError("effects of some environments only")
    with recording(env, robot, actuator, every) as places:
        sim = _Physics(places, env.sim)
        places.put(robot, "_sim", sim)
        for key, of in (("joint_pos", sim.qpos), ("joint_vel", sim.qvel)):
            view = getattr(robot.data, key)
            if robot._layout.side_by_side:
                places.known[view.data_ptr(), tuple(view.shape), view.dtype] = -1, of.cell
                places.put(robot.data, key, Symbol(places.operations, of.cell, of.shape))
            else:
                places.put(robot.data, key, Symbol(places.operations, Cell(of.cell.node), of.shape))
        swap_targets(places, robot, dataset)
        swap_drive(places, actuator, env.num_envs)
        only_drive(places, robot, actuator)
        before = actuator.flags()
        shown = cast(Symbol, robot.sensed_joint_pos()).cell.node
        if dataset.torque_enable is not None:
            actuator.set_torque_enable(cast(torch.Tensor, places.symbol("torque_enable")))
        torque: Node | None = None
        for _ in range(env.cfg.decimation):
            robot.write_data_to_sim()
            torque = torque or cast(Symbol, actuator.motor_effort).cell.node
            sim.step()
            robot.update()
        sim.end()
        if actuator.flags() != before:
            raise NotTraceableError("a drive or an effect that counts steps in Python")
        updates = updates_of(places)
    used = sorted((delay.ring, read) for delay, read in places.delays if delay.ring is not None)
    return DriveProgram(
        tape=places.tape,
        written=sim.written,
        updates=updates,
        shown=shown,
        torque=cast(Node, torque),
        entries=places.entries,
        leaves=places.reads,
        rings=[read for _, read in used],
        columns=places.columns,
    )


class _Physics:
    """Stands in for the robot's simulation: its fields are symbols, and a step of it is a mark on the tape."""

    write_passive = Simulation.write_passive

    def __init__(self, places: Places, sim: Simulation):
        """Read the state."""
        self.cfg, self.is_trapezoidal = sim.cfg, sim.is_trapezoidal
        self.device, self.dtype, self.num_envs = sim.device, sim.dtype, sim.num_envs
        self.written: list[dict[str, Node]] = []
        self._tape = places.tape
        shape = (len(places.rows), len(places.columns))
        self._fields = {name: Symbol(places.operations, Cell(self._read(name)), shape) for name in (*STATE, *WRITTEN)}
        self.qpos, self.qvel, self.qfrc_bias, self.qfrc_applied = (
            self._fields[name] for name in (*STATE, "qfrc_applied")
        )
        self._before = self._nodes()

    def expand(self, field: str) -> Symbol:
        """A field of the model."""
        if field not in self._fields:
            raise NotTraceableError(f"the model's {field}")
        return self._fields[field]

    def tensor(self, value: object) -> torch.Tensor:
        """As the simulation's."""
        return torch.as_tensor(value, dtype=self.dtype, device=self.device)

    def felt_link(self, columns: torch.Tensor) -> Any:
        """Needs more of MuJoCo's fields than are read.

        Raises:
            NotTraceableError: Always.
        """
        raise NotTraceableError("an effect that reads the link's inertia")

    def step(self) -> None:
        """Write what has changed, and read the state anew."""
        self.end()
        for name in STATE:
            self._fields[name].cell.node = self._read(name)
        self._before = self._nodes()

    def end(self) -> None:
        """Write what has changed."""
        after = self._nodes()
        self.written.append({name: after[name] for name in WRITTEN if after[name] is not self._before[name]})
        arguments: Sequence[Node] = tuple(self.written[-1].values())
        self._tape._new("physics", tuple(arguments), "double", len(self.written) - 1)

    def _nodes(self) -> dict[str, Node]:
        return {name: self._fields[name].cell.node for name in WRITTEN}

    def _read(self, name: str) -> Node:
        return self._tape._new("field", (), "double", (*STATE, *WRITTEN).index(name))
