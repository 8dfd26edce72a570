"""Records one control step of a drive of a whole robot; between its calls MuJoCo steps the robot."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import torch

from pace_actuators import PaceDCMotor
from pace_envs.compiled_drive.drive_code import Program
from pace_envs.compiled_drive.one_joint import Commands, JointTracer, OneJoint, position_term
from pace_envs.compiler.tape import Node, NotTraceableError
from pace_envs.simulation import Simulation

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv

STATE = ("qpos", "qvel", "qfrc_bias")
"""Fields of MuJoCo's data that drives and effects read."""
WRITTEN = ("qpos", "qvel", "qfrc_applied", "dof_armature", "dof_frictionloss", "dof_damping")
"""Fields of MuJoCo's data and model that they write before a physics step."""


def record_drive(
    env: ManagerBasedEnv,
    dataset: Commands,
    actuator: PaceDCMotor,
    with_torques: bool,
    shift: torch.Tensor | None = None,
) -> Program:
    """What a control step does to the joints of a drive, in all environments.

    Args:
        env: The environment; it has made a control step.
        dataset: The recordings whose commands it follows.
        actuator: One of its robot's drives.
        with_torques: Whether the motors' torques are shown, too.
        shift: Added to what encoders are held at, (num_envs, n, 2) [rad, rad/s]; ``None``: none is held.

    Raises:
        NotTraceableError: If a kernel cannot do it.
    """
    robot, stack = env.scene["robot"], actuator.effects
    if type(actuator) is not PaceDCMotor:
        raise NotTraceableError("a drive of the user's own")
    position_term(env)
    every = range(env.num_envs)
    if stack is not None and any(effect.rows.indices(env.num_envs) != (0, len(every), 1) for effect in stack.effects):
        raise NotTraceableError("effects of some environments only")
    joint = OneJoint(robot, actuator, every)
    with joint.noting():
        sim = _Physics(joint.tracer, env.sim)
        joint.in_robot(sim, dataset)
        hold = None if shift is None else partial(_hold, joint, sim, shift)
        shown = joint.control_step(env.cfg.decimation, dataset, with_torques, hold)
        sim.end()
        program = joint.program(shown, sim.written)
    return program


def _hold(joint: OneJoint, sim: _Physics, shift: torch.Tensor) -> None:
    columns = joint.columns
    own = [joint.leaf(lambda i=i: shift[None, :, columns, i]) for i in range(2)]  # type: ignore[misc]
    for field, held in zip((sim.qpos, sim.qvel), joint.held(*own), strict=True):
        field.copy_(held)


class _Physics:
    """Stands in for the robot's simulation: a step of it is a mark on the tape."""

    write_passive = Simulation.write_passive

    def __init__(self, tracer: JointTracer, sim: Simulation):
        """Read the state."""
        self.cfg, self.is_trapezoidal = sim.cfg, sim.is_trapezoidal
        self.written: list[dict[str, Node]] = []
        self._tracer = tracer
        self._fields = {name: tracer.tensor(self._read(name)) for name in (*STATE, *WRITTEN)}
        self.qpos, self.qvel, self.qfrc_bias, self.qfrc_applied = (
            self._fields[name] for name in (*STATE, "qfrc_applied")
        )
        self._before = self._nodes()

    def expand(self, field: str) -> torch.Tensor:
        """A field of the model."""
        if field not in self._fields:
            raise NotTraceableError(f"the model's {field}")
        return self._fields[field]

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
            self._tracer.put(self._fields[name], self._read(name))
        self._before = self._nodes()

    def end(self) -> None:
        """Write what has changed."""
        after = self._nodes()
        self.written.append({name: after[name] for name in WRITTEN if after[name] is not self._before[name]})
        self._tracer.tape.new("physics", *self.written[-1].values(), index=len(self.written) - 1)

    def _nodes(self) -> dict[str, Node]:
        return {name: self._tracer.node(self._fields[name]) for name in WRITTEN}

    def _read(self, name: str) -> Node:
        return self._tracer.tape.new("field", index=(*STATE, *WRITTEN).index(name))
