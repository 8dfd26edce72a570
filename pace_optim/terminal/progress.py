"""One live line on the terminal."""

from __future__ import annotations

import shutil
import sys
import time
from typing import TextIO


class ProgressLine:
    """Shows how far a fit is; on a terminal the line is overwritten, elsewhere it is printed now and then."""

    def __init__(self, stream: TextIO | None = None, seconds_between_lines: float = 10.0):
        """Start the clock."""
        self._stream = stream or sys.stderr
        self._live = self._stream.isatty()
        self._between = seconds_between_lines
        self.restart()

    def restart(self) -> None:
        """Start the clock anew, for a fit that begins now."""
        self._start = time.perf_counter()
        self._last_line = 0.0
        self._phase = ""
        self._phase_began = self._latest = (0.0, 0)

    @property
    def elapsed(self) -> float:
        """Time since the start [s]."""
        return time.perf_counter() - self._start

    def show(self, phase: str, done: int, total: int, best: float, spread: float | None, steps: int) -> None:
        """Update the line.

        Args:
            phase: What is going on.
            done: Iterations so far in this phase.
            total: Most iterations in this phase.
            best: Best score so far [rad², of slides m²].
            spread: Widest standard deviation of the search, normalised; ``None`` when there is none.
            steps: Simulated steps so far.
        """
        elapsed = self.elapsed
        filled = round(20 * done / max(1, total))
        if phase != self._phase:  # it has been going on since the last one's end
            self._phase, self._phase_began = phase, self._latest
        self._latest = (elapsed, steps)
        seconds, own_steps = elapsed - self._phase_began[0], steps - self._phase_began[1]
        left = seconds / max(1, done) * (total - done)
        at_most = f"{left:.0f} s" if left < 600 else f"{left / 60:.0f} min"
        text = (
            f"{phase} [{'#' * filled}{'.' * (20 - filled)}] {done}/{total}  best {best:.3e}"
            + ("" if spread is None else f"  spread {spread:.2g}")
            + f"  {own_steps / max(seconds, 1e-9) / 1e3:.0f}k steps/s  {elapsed:.0f} s, at most {at_most} left"
        )
        if self._live:
            self.say(text)
        elif elapsed - self._last_line >= self._between or done == total:
            self._last_line = elapsed
            self.say(text)

    def say(self, text: str) -> None:
        """Show a step that has no counter."""
        self._latest = (self.elapsed, self._latest[1])
        if self._live:
            width = shutil.get_terminal_size().columns - 1
            self._stream.write("\r")
            self._stream.write(text[:width].ljust(width))
        else:
            self._stream.write(text + "\n")
        self._stream.flush()

    def tell(self, *lines: str) -> None:
        """Show lines that stay."""
        print(*([""] if self._live else []), *lines, sep="\n", file=self._stream, flush=True)

    def close(self) -> None:
        """End the line."""
        if self._live:
            self._stream.write("\n")
            self._stream.flush()
