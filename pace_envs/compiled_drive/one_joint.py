"""A drive of one joint, which stands for many: what it does is noted, and no number is computed."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial, reduce
from typing import TYPE_CHECKING, Any, Protocol

import torch

from pace_actuators import PaceDCMotor
from pace_actuators.delay_buffer import DelayBuffer
from pace_actuators.effects import Effect
from pace_actuators.effects.drive_state import DriveState
from pace_actuators.part import Part
from pace_envs.compiled_drive.drive_code import Program, Read
from pace_envs.compiler.operations import COMPARED, TYPES, UNARY, rule
from pace_envs.compiler.tape import Node, NotTraceableError, Tape, Tracer, tensors_in
from pace_envs.mdp import JointPositionAction

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv
    from pace_envs.articulation import Articulation

_DTYPES = {kind: dtype for dtype, kind in TYPES.items()}
HELD = ("held_free", "held_position", "held_speed")
"""Series that say where joints are free, and what encoders show where they are held."""
_TARGETS = (("joint_vel_target", "command_vel"), ("joint_effort_target", "command_effort"))
_LIKE_THE_FIRST = {"clone", "copy", "fill", "full_like", "masked_fill", "new_zeros", "ones_like", "zero", "zeros_like"}
_OF_FLOATS = {"div", "atan2", *UNARY} - {"neg", "abs", "square", "sign", "sgn", "clone", "_to_copy", "relu"}
_INDEXED = ("bucketize", "gather", "index", "index_select")
_CHOICES = ("where", "masked_fill")
_NUMBERS = (float, int, bool)
_AT_ONCE = 64


class Commands(Protocol):
    """What a robot of n joints follows: R recordings of T control steps."""

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


class JointTracer(Tracer):
    """Notes on a tape what is done to tensors of one number each, and to tables of numbers."""

    def __init__(self) -> None:
        """Know nothing yet."""
        super().__init__()
        self.tape = Tape()
        self._nodes: dict[int, Node] = {}  # by address
        self._tables: dict[int, int] = {}
        self._made: set[int] = set()
        self._left: dict[tuple[str, int], list[torch.Tensor]] = {}
        self._kept: list[torch.Tensor] = []  # so that no address is used again

    def tensor(self, node: Node) -> torch.Tensor:
        """A tensor (1, 1) that stands for a number."""
        return self._new(node, 2)

    def table(self, leaf: int, entries: int) -> torch.Tensor:
        """A tensor (1, 1, entries) that stands for some numbers."""
        result = torch.empty(1, 1, entries, dtype=torch.float64)
        for i in range(entries):
            place = self.tape.constant(i, "long long")
            self._known(result[..., i], self.tape.add("table", place, index=leaf))
        self._tables[result.data_ptr()] = leaf
        return result

    def node(self, value: Any, kind: str | None = None) -> Node:
        """The number that a tensor now stands for; of another tensor, the one number that it has.

        Raises:
            NotTraceableError: If it has several.
        """
        if type(value) in _NUMBERS:
            return self.tape.constant(value, kind or "double")
        node = self._nodes.get(value.data_ptr())
        if node is None:
            if value.numel() != 1:
                raise NotTraceableError("a tensor of all joints among the numbers of one")
            return self.tape.constant(value.item(), kind or TYPES[value.dtype])
        return node if kind is None else self.tape.cast(node, kind)

    def forget(self) -> None:
        """Let all tensors go: the tape stays."""
        for each in (self._nodes, self._tables, self._made, self._left, self._kept):
            each.clear()

    def put(self, tensor: torch.Tensor, node: Node) -> None:
        """Let a tensor stand for another number, of its type."""
        self._nodes[tensor.data_ptr()] = self.tape.cast(node, TYPES[tensor.dtype])

    # ------------------------------------------------------------------ what torch asks

    def made(self, func: Any, name: str, args: tuple, kwargs: dict[str, Any]) -> Any:
        """A new tensor, which may be written to."""
        result = func(*args, **kwargs)
        if isinstance(result, torch.Tensor):
            self._kept.append(result)
            self._made.add(result.data_ptr())
        return result

    def knows(self, tensors: Sequence[torch.Tensor]) -> bool:
        """Whether one of them stands for numbers."""
        return not self._nodes.keys().isdisjoint([each.data_ptr() for each in tensors])

    def left_to_torch(self, func: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
        """What has nothing to do with the joint.

        Raises:
            NotTraceableError: If it has.
        """
        if self.knows(tensors_in((*args, *kwargs.values()))):
            name = func._schema.name.partition("::")[2]
            branches = name in ("_local_scalar_dense", "item", "is_nonzero", "equal")
            raise NotTraceableError("a branch in Python over a tensor's values" if branches else f"torch's {name}")
        return func(*args, **kwargs)

    def noted(self, func: Any, name: str, args: tuple, kwargs: dict, target: Any, tensors: list[torch.Tensor]) -> Any:
        """Write it down."""
        if name in _INDEXED:
            node = self._indexed(name, args, kwargs)
            like = args[0] if name == "bucketize" else args[-1][-1] if name == "index" else args[-1]
            return None if node is None else self._result(node, like.ndim, target)
        if self._tables and any(each.numel() != 1 for each in tensors):
            raise NotTraceableError("a table among numbers")
        compared = name in COMPARED
        dtype = kwargs.get("dtype") or (target.dtype if target is not None else _type_of(name, args, tensors))
        found = rule(name, args, kwargs, dtype) if dtype in TYPES else None
        if found is None:
            return None
        (first, *others), form = found
        kind = TYPES[_promoted(args, tensors) if compared else dtype]
        nodes = [self.node(first, "bool" if name in _CHOICES else kind), *[self.node(each, kind) for each in others]]
        node = self.tape.add(form, *nodes, kind="bool" if compared else kind)
        return self._result(node, max([each.ndim for each in tensors]), target)

    # ------------------------------------------------------------------ inside

    def _new(self, node: Node, ndim: int) -> torch.Tensor:
        """A tensor for a number; many are made at once, which is faster."""
        left = self._left.setdefault((node.kind, ndim), [])
        if not left:
            with torch._C._DisableTorchDispatch():
                self._kept.append(torch.empty(_AT_ONCE, *(1,) * ndim, dtype=_DTYPES[node.kind]))
                left += self._kept[-1].unbind()
        tensor = left.pop()
        self._nodes[tensor.data_ptr()] = node
        return tensor

    def _known(self, tensor: torch.Tensor, node: Node) -> torch.Tensor:
        self._kept.append(tensor)
        self._nodes[tensor.data_ptr()] = node
        return tensor

    def _result(self, node: Node, ndim: int, target: torch.Tensor | None) -> torch.Tensor:
        if target is None:
            return self._new(node, ndim)
        if target.data_ptr() not in self._nodes and target.data_ptr() not in self._made:
            raise NotTraceableError("a tensor that is no state, which is changed")
        self.put(target, node)
        return target

    def _indexed(self, name: str, args: tuple, kwargs: dict[str, Any]) -> Node | None:
        """An entry of a table or of numbers that are the same for all joints, by its index; or the index."""
        if name == "bucketize":
            if kwargs or args[1].data_ptr() in self._nodes:
                return None
            x = self.node(args[0])
            over = [self.tape.add("({0} > {1})", x, self.node(knot), kind="bool") for knot in args[1].tolist()]
            form = "(" + " + ".join(f"{{{i}}}" for i in range(len(over))) + ")"
            return self.tape.add(form, *over, kind="long long")
        source, index = args[0], args[1] if name == "index" else args[2]
        if name == "gather":
            leaf = self._tables.get(source.data_ptr())
            whole = leaf is not None and args[1] % source.ndim == source.ndim - 1
            return self.tape.add("table", self.node(index), index=leaf or 0) if whole else None
        if source.data_ptr() in self._nodes:  # the joint itself
            return self.node(source) if source.numel() == 1 else None
        if name != "index" or source.ndim != 1 or len(index) != 1 or index[0].data_ptr() not in self._nodes:
            return None
        return self.tape.knot(tuple(source.tolist()), self.node(index[0]))


def _type_of(name: str, args: Sequence[Any], tensors: Sequence[torch.Tensor]) -> torch.dtype:
    """The type of an operation's result."""
    if name in COMPARED:
        return torch.bool
    if name in _LIKE_THE_FIRST:
        return args[0].dtype
    if tensors[-1].dtype == torch.float64:
        return torch.float64
    dtype = _promoted(args, tensors)
    return torch.get_default_dtype() if name in _OF_FLOATS and not dtype.is_floating_point else dtype


def _promoted(args: Sequence[Any], tensors: Sequence[torch.Tensor]) -> torch.dtype:
    """The common type of tensors (1, 1) and numbers."""
    types = {each.dtype for each in tensors}
    if torch.float64 in types:
        return torch.float64
    numbers = {type(value) for value in args}
    if float in numbers:
        types.add(torch.get_default_dtype())
    if int in numbers and types == {torch.bool}:
        types.add(torch.int64)
    return reduce(torch.promote_types, types)


class TracedDelay(DelayBuffer):
    """A delay whose samples and lags are noted; it has seen a sample."""

    def __init__(self, tracer: JointTracer, lag: Callable[[], torch.Tensor], like: DelayBuffer):
        """Stand for a delay.

        Args:
            lag: Makes what stands for it, in steps, the lead included.
        """
        self.interpolation, self.parts, self._length = like.interpolation, like.parts, like._length
        self._tracer, self._make_lag = tracer, lag
        self.ring: int | None = None
        """Index of its memory, once it is used."""
        self._all_zero = False

    def compute(self, data: torch.Tensor) -> torch.Tensor:
        """As the delay's."""
        if self.ring is None:
            self.ring = self._tracer.tape.ring(self._length)
            self._lag, self._lead = self._make_lag(), 0.0
            self._index_lags()
        self._tracer.tape.new("push", self._tracer.node(data, "double"), index=self.ring)
        return self.part(0) if self._at else self.mean()

    def _all(self, which: torch.Tensor) -> bool:
        return False

    def _rows(self, steps: torch.Tensor) -> torch.Tensor:
        return steps

    def _seen(self, rows: Any) -> torch.Tensor:
        if self.ring is None:
            raise NotTraceableError("a delay that is read before it has a sample")
        return self._tracer.tensor(self._tracer.tape.new("ring", self._tracer.node(rows), index=self.ring))


class OneJoint:
    """A drive of one joint in a robot of one joint: copies of the true ones, whose tensors stand for many joints.

    It is used while it notes (:meth:`noting`); the numbers that a step begins with are read from the true ones.
    """

    def __init__(self, robot: Articulation, actuator: PaceDCMotor, rows: range):
        """Copy a drive.

        Args:
            robot: Whose drive it is; it has made a control step: what happens only in the first one is not noted.
            rows: Environments, in all of which the same effects act.
        """
        self.tracer = JointTracer()
        self.rows = rows
        self.columns = torch.arange(robot.num_joints)[actuator.joint_indices]
        """Its joints among those of the robot."""
        self.dof_columns = robot.dof_columns[self.columns]
        """Their columns in the simulation's fields."""
        self.leaves: list[Read] = []
        self.entries: list[int] = []
        self._known: dict[tuple, tuple[torch.Tensor, int]] = {}
        self._after: list[tuple[int, Callable[[], Any]]] = []
        self._delays: list[tuple[TracedDelay, Read]] = []
        self._series: dict[str, torch.Tensor] = {}
        self._true, self._actuator = robot, actuator
        self.robot: Any
        with torch.inference_mode(False):
            self.drive = self._copied_drive()

    @contextmanager
    def noting(self) -> Iterator[None]:
        """What is done to the drive is noted.

        Raises:
            NotTraceableError: If a kernel cannot do it, such as an effect that branches over a tensor's values.
        """
        try:
            with torch.inference_mode(False), torch.no_grad(), self.tracer:
                yield
        except NotTraceableError:
            raise
        except (AttributeError, IndexError, TypeError, ValueError, RuntimeError) as error:
            raise NotTraceableError(str(error)) from error

    def in_robot(self, simulation: Any, commands: Commands) -> Any:
        """A robot of the joint, in a simulation, that follows commands.

        Raises:
            NotTraceableError: If the robot follows targets that no recording has.
        """
        true, robot = self._true, copy.copy(self._true)
        data = robot.data = copy.copy(true.data)
        first = torch.tensor([0])
        name = next(name for name, each in true.actuators.items() if each is self._actuator)
        robot._sim, robot.actuators, robot._columns = simulation, {name: self.drive}, {}
        robot._layout = replace(true._layout, qpos_columns=first, dof_columns=first)
        data.joint_pos, data.joint_vel = simulation.qpos, simulation.qvel
        data.joint_pos_target = self.series("command")
        for key, series in _TARGETS:
            if getattr(commands, series) is not None:
                setattr(data, key, self.series(series))
            elif getattr(data, key) is not None:
                raise NotTraceableError("targets that no recording has")
        self.robot = robot
        return robot

    def control_step(
        self, decimation: int, commands: Commands, with_torques: bool = False, hold: Callable[[], None] | None = None
    ) -> dict[str, Node]:
        """Let the robot do a control step; returns what is shown of it (``Program.shown``).

        Args:
            decimation: Physics steps of a control step.
            with_torques: Whether the motor's torque is shown, too.
            hold: Puts the joint where it is held, with :meth:`held`; ``None``: it is free.

        Raises:
            NotTraceableError: If something counts steps in Python.
        """
        before = self.drive.branches()
        if hold is not None:
            hold()
        shown = {"out": self.tracer.node(self.robot.sensed_joint_pos())}
        if commands.torque_enable is not None:
            self.drive.set_torque_enable(self.series("torque_enable"))
        for _ in range(decimation):
            self.robot.write_data_to_sim()
            if with_torques:
                shown.setdefault("effort", self.tracer.node(self.drive.motor_effort))
            self.robot._sim.step()
            self.robot.update()
        if self.drive.branches() != before:
            raise NotTraceableError("a drive or an effect that counts steps in Python")
        return shown

    def held(
        self, shift: torch.Tensor | float, shift_vel: torch.Tensor | float = 0.0
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """State in which the encoder shows what it is held at, and the present one where the joint is free.

        Args:
            shift: Added to what encoders show [rad] ...
            shift_vel: ... and to their speeds [rad/s].
        """
        free, position, speed = (self.series(name) for name in HELD)
        return self.robot.held(position + shift, speed + shift_vel, free > 0.5)

    def series(self, name: str) -> torch.Tensor:
        """The present value of a series."""
        if name not in self._series:
            self._series[name] = self.tracer.tensor(self.tracer.tape.of_series(name))
        return self._series[name]

    def leaf(self, read: Read, kind: str = "double", entries: int = 1) -> torch.Tensor:
        """A tensor for numbers that are there when the step begins; ``read`` gives them, (entries, rows, joints)."""
        self.leaves.append(read)
        self.entries.append(entries)
        index = len(self.leaves) - 1
        if entries > 1:
            return self.tracer.table(index, entries)
        return self.tracer.tensor(self.tracer.tape.leaf(index, kind))

    def replace(self, holder: dict, true: dict, key: Any, begin: int = 0, columns: torch.Tensor | None = None) -> None:
        """Put what stands for a tensor into its place in a copy.

        Args:
            holder: The copy's attributes, or a dictionary.
            true: Those of which it is a copy.
            begin: The environment of its first row.
            columns: The joints' in it; ``None`` where it has no others.
        """
        value = true[key]
        if value.ndim < 2 or value.dtype not in TYPES:  # the same for all joints
            return
        place = _place(value)
        if place not in self._known:
            kind = TYPES[value.dtype]
            entries = value.shape[2] if value.ndim == 3 else 1
            rows = slice(self.rows.start - begin, self.rows.stop - begin)
            read = partial(_numbers, true, key, rows, columns, (len(self.rows), len(self.columns)))
            tensor = self.leaf(read, kind, entries)
            self._known[place] = tensor, len(self.leaves) - 1
        holder[key], index = self._known[place]
        if value.ndim == 2:
            self._after.append((index, lambda: holder[key]))

    def program(self, shown: Mapping[str, Node], written: Sequence[Mapping[str, Node]] = ()) -> Program:
        """What was noted.

        Args:
            written: What was written into MuJoCo's fields before each physics step, and after the last.

        Raises:
            NotTraceableError: If something is no number any more, or has left the memory that it shared.
        """
        used = sorted((delay.ring, i) for i, (delay, _) in enumerate(self._delays) if delay.ring is not None)
        program = Program(
            tape=self.tracer.tape,
            written=written,
            updates=self._updates(),
            shown=shown,
            entries=self.entries,
            leaves=self.leaves,
            rings=[self._delays[i][1] for _, i in used],
            columns=self.columns,
        )
        self.tracer.forget()
        return program

    # ------------------------------------------------------------------ inside

    def _updates(self) -> dict[int, Node]:
        """What has become of the leaves, by index."""
        updates: dict[int, Node] = {}
        leaves = {node.index: node for node in self.tracer.tape.nodes if node.operation == "leaf"}
        for index, after in self._after:
            if not isinstance(value := after(), torch.Tensor):
                raise NotTraceableError("a tensor that a step replaced by something else")
            node = self.tracer.node(value, leaves[index].kind)
            if updates.setdefault(index, node) is not node:
                raise NotTraceableError("tensors that shared their memory and do not any more")
        return {i: node for i, node in updates.items() if node is not leaves[i]}

    def _copied_drive(self) -> PaceDCMotor:
        actuator, stack, effects = self._actuator, self._actuator.effects, None
        if stack is not None and (acting := self._acting(stack.effects)):
            state = self._state(stack.state, [stack.views[effect] for effect in acting])
            twins = [self._copied(effect, begin) for effect, begin in acting.items()]
            for twin, (effect, begin) in zip(twins, acting.items(), strict=True):
                twin.shape, twin.rows, twin.buffers = (1, 1), slice(None), self._traced(effect.buffers, begin)
            effects = stack.of(twins, state)
        drive: PaceDCMotor = self._copied(actuator)
        drive._num_envs, drive._joint_names, drive._joint_indices = 1, actuator.joint_names[:1], slice(None)
        drive._delays, drive.effects = copy.copy(actuator._delays), effects
        drive._delays.buffers = self._traced(actuator._delays.buffers)
        return drive

    def _acting(self, effects: Sequence[Effect]) -> dict[Effect, int]:
        """Those that act in its rows, and where their own rows begin."""
        own = {effect: range(self._actuator._num_envs)[effect.rows] for effect in effects}
        first, last = self.rows[0], self.rows[-1]
        return {effect: rows.start for effect, rows in own.items() if first in rows and last in rows}

    def _copied(self, part: Part, begin: int = 0) -> Any:
        """A copy of a part whose tensors all are of the drive's joints."""
        twin = copy.copy(part)
        for key in part.tensors():
            self.replace(vars(twin), vars(part), key, begin)
        return twin

    def _state(self, state: DriveState, views: Sequence[DriveState]) -> DriveState:
        """What stands for a drive's state, and for what is seen of it through its views."""
        twin: dict[str, torch.Tensor] = {}
        true, seen = state.tensors(), [view.tensors() for view in views]
        for name, tensor in true.items():
            self.replace(twin, true, name)
            self._known |= {_place(each[name]): self._known[_place(tensor)] for each in seen if name in each}
        return DriveState(twin)

    def _traced(self, buffers: Mapping[str, DelayBuffer], begin: int = 0) -> dict[str, DelayBuffer]:
        """What stands for delays."""
        return {name: self._delay(buffer, begin) for name, buffer in buffers.items()}

    def _delay(self, buffer: DelayBuffer, begin: int) -> TracedDelay:
        rows = slice(self.rows.start - begin, self.rows.stop - begin)
        shape = len(self.rows), len(self.columns)
        delay = TracedDelay(self.tracer, lambda: self.leaf(lambda: buffer._total[rows].expand(shape)[None]), buffer)
        self._delays.append((delay, lambda: buffer.history()[:, rows].expand(-1, *shape)))
        return delay


def _place(tensor: torch.Tensor) -> tuple:
    return tensor.data_ptr(), tensor.shape, tensor.dtype


def _numbers(
    true: Mapping, key: Any, rows: slice, columns: torch.Tensor | None, shape: tuple[int, int]
) -> torch.Tensor:
    """What a tensor now holds of some rows and joints, (entries, *shape)."""
    own = true[key][rows]
    own = own if columns is None or own.shape[1] == 1 else own[:, columns]
    return own.permute(2, 0, 1) if own.ndim == 3 else own.to(torch.float64).expand(shape)[None]


def commands(env: ManagerBasedEnv, dataset: Commands, name: str) -> torch.Tensor:
    """A series of the recordings by control step, (T, R, n): targets, added torques, or the switch."""
    if name == "command":
        term = position_term(env)
        term.process_actions(dataset.command)
        return term.processed_actions
    if name == "torque_enable":
        assert dataset.torque_enable is not None
        return dataset.torque_enable[..., None].expand(-1, -1, dataset.command.shape[-1])
    return getattr(dataset, name)


def position_term(env: ManagerBasedEnv) -> JointPositionAction:
    """The only action: targets of all joints.

    Raises:
        NotTraceableError: If there is another one.
    """
    (term, *others) = env.action_manager._terms.values()
    if others or type(term) is not JointPositionAction or term._joint_ids is not None:
        raise NotTraceableError("actions other than the positions of all joints")
    return term
