"""Replace tensors by symbols while a step is recorded, and restore them afterwards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch

from pace_actuators.delay_buffer import DelayBuffer
from pace_actuators.effects.drive_state import DriveState
from pace_envs.compiled_drive.symbols import Cell, Knots, Symbol, SymbolicDelay, Table, new_operations, ring_like
from pace_envs.compiled_drive.tape import Kind, Tape

Read = Callable[[], torch.Tensor]


@dataclass(kw_only=True)
class Slot:
    """A place that holds a tensor, and that held a symbol while the step was recorded."""

    holder: Any
    key: Any
    leaf: int

    def get(self) -> Any:
        """What it holds."""
        return self.holder[self.key] if isinstance(self.holder, dict) else getattr(self.holder, self.key)

    def set(self, value: Any) -> None:
        """Let it hold something else."""
        if isinstance(self.holder, dict):
            self.holder[self.key] = value
        else:
            setattr(self.holder, self.key, value)


@dataclass(kw_only=True)
class Places:
    """Puts symbols into the places of tensors."""

    rows: range
    columns: torch.Tensor
    """The joints among those of the robot."""
    dof_columns: torch.Tensor
    """Their columns in the simulation's fields."""
    tape: Tape = field(default_factory=Tape)
    slots: list[Slot] = field(default_factory=list)
    reads: list[Read] = field(default_factory=list)
    entries: list[int] = field(default_factory=list)
    undo: list[Callable[[], None]] = field(default_factory=list)
    delays: list[tuple[SymbolicDelay, Read]] = field(default_factory=list)
    known: dict[tuple, tuple[int, Cell]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.tape, self.operations = new_operations()

    def put(self, holder: Any, key: Any, value: Any) -> None:
        """Put something in a place until the end."""
        slot = Slot(holder=holder, key=key, leaf=-1)
        own = isinstance(holder, dict) or key in vars(holder)
        old = slot.get() if own else None
        self.undo.append((lambda: slot.set(old)) if own else (lambda: delattr(holder, key)))
        slot.set(value)

    def keep(self, thing: Any) -> None:
        """Let an object have at the end what it has now."""
        before = dict(vars(thing))

        def back() -> None:
            vars(thing).clear()
            vars(thing).update(before)

        self.undo.append(back)

    def symbol(self, name: str) -> Symbol:
        """The present value of a series."""
        return Symbol(self.operations, Cell(self.tape.of_series(name)), (len(self.rows), len(self.columns)))

    def leaf(self, read: Read, entries: int = 1) -> int:
        """A new leaf."""
        self.reads.append(read)
        self.entries.append(entries)
        return len(self.reads) - 1

    def swap(
        self, holder: Any, key: Any, begin: int, columns: torch.Tensor | None, now: Callable[[], Any] | None = None
    ) -> None:
        """A symbol in place of a tensor whose first row is row ``begin``; ``now`` gives a holder that changes."""
        slot = Slot(holder=holder, key=key, leaf=-1)
        value = slot.get()
        if value.dtype not in (torch.float64, torch.bool):
            return
        rows = slice(self.rows.start - begin, self.rows.stop - begin)
        shape = (len(self.rows), len(self.columns))
        if value.ndim == 1:
            self.put(holder, key, Knots(self.operations, tuple(value.tolist())))
            return

        def read() -> torch.Tensor:
            own = (slot.get() if now is None else getattr(now(), key))[rows]
            own = own if columns is None or own.shape[1] == 1 else own[:, columns]
            if own.ndim == 3:
                return own.permute(2, 0, 1)
            return own.to(torch.float64).expand(shape)[None]

        if value.ndim == 3:
            index = self.leaf(read, value.shape[2])
            self.put(holder, key, Table(self.operations, index))
            return
        place = (value.data_ptr(), tuple(value.shape), value.dtype)
        if place not in self.known:
            kind: Kind = "bool" if value.dtype == torch.bool else "double"
            index = self.leaf(read)
            self.known[place] = index, Cell(self.tape.leaf(index, kind))
        index, cell = self.known[place]
        self.put(holder, key, Symbol(self.operations, cell, shape))
        if index >= 0:
            self.slots.append(Slot(holder=holder, key=key, leaf=index))

    def delay(self, holder: Any, key: Any, begin: int) -> None:
        """A symbolic delay in place of a buffer."""
        place = Slot(holder=holder, key=key, leaf=-1)
        buffer: DelayBuffer = place.get()
        rows = slice(self.rows.start - begin, self.rows.stop - begin)
        shape = (len(self.rows), len(self.columns))
        lag = self.tape.leaf(self.leaf(lambda: place.get()._total[rows].expand(shape)[None]), "double")
        symbolic = SymbolicDelay(self.operations, lag, ring_like(buffer))

        def read() -> torch.Tensor:
            own: DelayBuffer = place.get()
            return own.history()[:, rows].expand(-1, *shape)

        self.delays.append((symbolic, read))
        self.put(holder, key, symbolic)

    def drive_state(self, states: list[DriveState]) -> None:
        """Symbols for the fields of a drive's state and of its effects' views of it, which share memory."""
        for name in DriveState.__annotations__:
            cell: Cell | None = None
            for state in states:
                if not hasattr(state, f"_{name}"):
                    continue
                tensor = getattr(state, f"_{name}")
                if cell is None:
                    slot = Slot(holder=state, key=f"_{name}", leaf=-1)
                    slot.leaf = self.leaf(_reader(slot, slice(self.rows.start, self.rows.stop)))
                    cell = Cell(self.tape.leaf(slot.leaf, "double"))
                    self.slots.append(slot)
                self.known[tensor.data_ptr(), tuple(tensor.shape), tensor.dtype] = self.slots[-1].leaf, cell
                symbol = Symbol(self.operations, cell, (len(self.rows), len(self.columns)))
                self.undo.append(_setter(state, f"_{name}", tensor))
                setattr(state, f"_{name}", symbol)

    def objects(self, thing: Any, begin: int, now: Callable[[], Any] | None = None) -> None:
        """Symbols for all tensors of an object of the drive's joints."""
        for key, value in list(vars(thing).items()):
            if isinstance(value, torch.Tensor):
                self.swap(thing, key, begin, None, now)
            elif isinstance(value, DelayBuffer):
                self.delay(thing, key, begin)

    def end(self) -> None:
        """Put everything back."""
        for back in reversed(self.undo):
            back()
        self.undo.clear()


def _reader(slot: Slot, rows: slice) -> Read:
    return lambda: slot.get()[rows][None]


def _setter(holder: Any, key: str, value: Any) -> Callable[[], None]:
    return lambda: setattr(holder, key, value)
