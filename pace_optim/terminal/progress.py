"""One live line on the terminal."""

from __future__ import annotations

import re
import shutil
import sys
import threading
import time
from collections.abc import Mapping
from typing import ClassVar, TextIO

from pace_actuators.text import with_table

_TIMES = 3
"""Times that a counter's line shows, at most, before it is written anew."""
_MOST_TIMES = 8
"""Times on a line whose text stays."""
_LEAST_LEFT = 5.0
"""Less time left is not stated [s]."""


class ProgressLine:
    """Shows what runs and for how long.

    On a terminal one line is overwritten every second. Elsewhere a step has a line when it begins, and the time is
    added to that line every ten seconds. A counter that has moved is written every third time.
    """

    last_written: ClassVar[ProgressLine | None] = None
    """Whose line may be open."""

    def __init__(self, stream: TextIO | None = None, seconds_between_times: float = 10.0):
        """Start the clock."""
        self._stream = stream or sys.stderr
        self._live = self._stream.isatty()
        self._between = seconds_between_times
        self._lock = threading.Lock()
        self._running, self._step, self._shown, self._shown_step, self._open = "", "", "", "", False
        self._shares: dict[str, float] = {}
        self._share, self._share_began = 0.0, 0.0
        self._closed: threading.Event | None = None
        self._began, self._last, self._times = time.perf_counter(), 0.0, 0
        self.restart()

    def restart(self) -> None:
        """Start the clock of a fit that begins now; the time that is shown goes on."""
        self._start = time.perf_counter()
        self._phase = ""
        self._phase_began = self._latest = (0.0, 0)

    def expect(self, shares: Mapping[str, float]) -> None:
        """State the time left from now on.

        Args:
            shares: Part of the whole time that has usually passed where a step begins, by how its text begins (a
                regular expression; the first that fits counts).
        """
        self._shares = dict(shares)

    @property
    def left(self) -> float | None:
        """Time left [s], from how late the present step began and is; ``None`` if not known.

        A step that takes longer than usual goes on for as long as it has run, and the others are longer too.
        """
        if not self._share:
            return None
        later = min((share for share in self._shares.values() if share > self._share), default=1.0)
        passed = self.shown - self._share_began
        of_step = max(self._share_began * (later / self._share - 1.0) - passed, passed)
        return of_step + (self.shown + of_step) * (1.0 / later - 1.0)

    @property
    def elapsed(self) -> float:
        """Time since the last restart [s]."""
        return time.perf_counter() - self._start

    @property
    def shown(self) -> float:
        """Time since the line was made, which is shown [s]."""
        return time.perf_counter() - self._began

    def show(self, phase: str, done: int, total: int, error: str, spread: float | None, steps: int) -> None:
        """Update the line.

        Args:
            done: Iterations so far in this phase.
            total: Most iterations in this phase.
            error: Smallest error so far in this phase, with its unit.
            spread: Widest standard deviation of the search, normalised; ``None`` without a search.
            steps: Simulated steps so far.
        """
        elapsed = self.elapsed
        if phase != self._phase:  # it began when the last one ended
            self._phase, self._phase_began = phase, self._latest
        self._latest = (elapsed, steps)
        seconds, own_steps = elapsed - self._phase_began[0], steps - self._phase_began[1]
        text = (
            f"{phase}: {done}/{total} at most  {error}"
            + ("" if spread is None else f"  spread {spread:.2g}")
            + f"  {own_steps / max(seconds, 1e-9) / 1e3:.0f}k steps/s"
        )
        self._run(text, phase, now=self._live or phase != self._shown_step)

    def say(self, text: str) -> None:
        """Show a step that has no counter."""
        self._latest = (self.elapsed, self._latest[1])
        self._run(text, text)

    def wait_for(self, text: str) -> None:
        """Show a step that is usually short: only where it takes long."""
        self._latest = (self.elapsed, self._latest[1])
        self._last = self.shown
        self._run(text, text, now=False)

    def tell(self, *lines: str) -> None:
        """Show lines that stay."""
        self.end_line()
        print(*(part for line in lines for part in with_table(line)), sep="\n", file=self._stream, flush=True)

    def end_line(self) -> None:
        """End a line that is open, as something else follows."""
        with self._lock:
            if self._open and not self._stream.closed:
                print(file=self._stream, flush=True)
            self._open = False

    def close(self) -> None:
        """End the line."""
        if self._closed is not None:
            self._closed.set()
            self._closed = None
        self.end_line()
        self._shown = self._shown_step = ""

    def _run(self, text: str, step: str, now: bool = True) -> None:
        """Show what runs from now on, until the next text or the end; a counter's line waits for its turn."""
        if step != self._step:
            share = next((share for begin, share in self._shares.items() if re.match(begin, text)), 0.0)
            if share > self._share:
                self._share, self._share_began = share, self.shown
        self._running, self._step = text, step
        if now or self.shown - self._last >= self._between:
            self._write()
        if self._closed is None:
            self._closed = threading.Event()
            threading.Thread(target=self._repeat, args=(self._closed,), daemon=True).start()

    def _repeat(self, closed: threading.Event) -> None:
        """Write the time again while nothing else is written."""
        between = 1.0 if self._live else self._between
        while not closed.wait(max(0.1, self._last + between - self.shown)) and not self._stream.closed:
            if self.shown - self._last >= between:
                self._write()

    def _write(self) -> None:
        """The line as it is now."""
        with self._lock:
            self._last = self.shown
            passed = f"  {self._last:.0f} s"
            if self._live:
                width = shutil.get_terminal_size().columns - 1
                self._stream.write("\r")
                self._stream.write((self._running + passed + self._about_left())[:width].ljust(width))
            elif self._open and self._step == self._shown_step and self._times < self._most_times():
                self._times += 1
                self._stream.write(passed)
            else:
                # a text that has been shown goes on below itself
                text = " " * 4 if self._open and self._running == self._shown else self._running
                self._shown, self._shown_step, self._times = self._running, self._step, 1
                if self._open:
                    self._stream.write("\n")
                self._stream.write(text + passed + self._about_left())
            self._open, ProgressLine.last_written = True, self
            self._stream.flush()

    def _most_times(self) -> int:
        return _MOST_TIMES if self._running == self._shown else _TIMES

    def _about_left(self) -> str:
        """The time left in words, rounded to 10 s, from 100 s to minutes."""
        left = self.left
        if left is None or left < _LEAST_LEFT:
            return ""
        return f", about {f'{10 * max(1, round(left / 10))} s' if left < 100 else f'{left / 60:.0f} min'} left"


def end_line() -> None:
    """End a line of progress that is open, before anything else is printed."""
    if ProgressLine.last_written is not None:
        ProgressLine.last_written.end_line()
