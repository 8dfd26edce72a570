"""One live line on the terminal."""

from __future__ import annotations

import shutil
import sys
import threading
import time
from typing import TextIO


class ProgressLine:
    """Shows what runs and for how long.

    On a terminal one line is overwritten every second. Elsewhere a line is printed every ten seconds, and at once when
    a step without a counter begins.
    """

    def __init__(self, stream: TextIO | None = None, seconds_between_lines: float = 10.0):
        """Start the clock."""
        self._stream = stream or sys.stderr
        self._live = self._stream.isatty()
        self._between = seconds_between_lines
        self._lock = threading.Lock()
        self._running, self._open = "", False
        self._closed: threading.Event | None = None
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
        """Update the line. It states no remaining time: when an optimizer converges is not known.

        Args:
            done: Iterations so far in this phase.
            total: Most iterations in this phase.
            best: Best score so far [rad², of slides m²].
            spread: Widest standard deviation of the search, normalised; ``None`` without a search.
            steps: Simulated steps so far.
        """
        elapsed = self.elapsed
        if phase != self._phase:  # it began when the last one ended
            self._phase, self._phase_began = phase, self._latest
        self._latest = (elapsed, steps)
        seconds, own_steps = elapsed - self._phase_began[0], steps - self._phase_began[1]
        text = (
            f"{phase}: {done}/{total} at most  best {best:.3e}"
            + ("" if spread is None else f"  spread {spread:.2g}")
            + f"  {own_steps / max(seconds, 1e-9) / 1e3:.0f}k steps/s"
        )
        self._run(text, now=self._live or elapsed - self._last_line >= self._between or done == total)

    def say(self, text: str) -> None:
        """Show a step that has no counter."""
        self._latest = (self.elapsed, self._latest[1])
        self._run(text)

    def wait_for(self, text: str) -> None:
        """Show a step that is usually short: only where it takes long."""
        self._latest = (self.elapsed, self._latest[1])
        self._last_line = self.elapsed
        self._run(text, now=False)

    def tell(self, *lines: str) -> None:
        """Show lines that stay."""
        with self._lock:
            print(*([""] if self._open else []), *lines, sep="\n", file=self._stream, flush=True)
            self._open = False

    def close(self) -> None:
        """End the line."""
        if self._closed is not None:
            self._closed.set()
            self._closed = None
        if self._open:
            self.tell()

    def _run(self, text: str, now: bool = True) -> None:
        """Show what runs from now on, until the next text or the end."""
        self._running = text
        if now:
            self._write()
        if self._closed is None:
            self._closed = threading.Event()
            threading.Thread(target=self._repeat, args=(self._closed,), daemon=True).start()

    def _repeat(self, closed: threading.Event) -> None:
        """Write the line again while it stays the same, with the time."""
        between = 1.0 if self._live else self._between
        while not closed.wait(max(0.1, self._last_line + between - self.elapsed)) and not self._stream.closed:
            if self.elapsed - self._last_line >= between:
                self._write()

    def _write(self) -> None:
        """The line as it is now."""
        with self._lock:
            self._last_line = self.elapsed
            text = f"{self._running}  {self._last_line:.0f} s"
            if self._live:
                width = shutil.get_terminal_size().columns - 1
                self._stream.write("\r")
                self._stream.write(text[:width].ljust(width))
                self._open = True
            else:
                self._stream.write(text + "\n")
            self._stream.flush()
