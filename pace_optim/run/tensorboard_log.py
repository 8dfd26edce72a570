"""A fit on TensorBoard: scores, the distribution of every parameter, and the result."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from pace_actuators.drive_result import ALL
from pace_optim.run.result import FitResult

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

    from pace_optim.optimizers.cmaes_optimizer import CMAESOptimizer

_BINS = 40
"""Of a histogram, from the smallest to the largest candidate."""


class TensorBoardLog:
    """Writes events beside a run's other files; ``tensorboard --logdir <folder>`` shows them.

    score/…                               best, and a generation's min, median and max [rad²]
    best/<parameter>/<joint>              the best parameters so far, physical
    population/<parameter>/<joint>        how a generation's candidates are spread, physical (histograms)
    spread/<parameter>                    standard deviation of the search, normalised, mean over the joints
    refinement/score                      best score over the iterations of the refinement [rad²]
    result/…                              values, error bars and errors in the end
    """

    def __init__(self, folder: Path, histogram_interval: int = 10):
        """Prepare; the events' file appears with the first event.

        Args:
            folder: Where to write.
            histogram_interval: Generations between two histograms of the parameters, which take most of the time.
        """
        self.folder = folder
        self.histogram_interval = histogram_interval
        self._opened: SummaryWriter | None = None

    @property
    def _writer(self) -> SummaryWriter:
        if self._opened is None:
            from torch.utils.tensorboard import SummaryWriter  # takes a second, so not with the module

            self._opened = SummaryWriter(str(self.folder))
        return self._opened

    def log_generation(self, optimizer: CMAESOptimizer) -> None:
        """Log a generation, after ``evolve()``."""
        step, space, write = optimizer.generation, optimizer.space, self._writer
        scores = torch.as_tensor(optimizer.generation_scores).sum(dim=1)
        write.add_scalar("score/best", optimizer.best_score, step)
        write.add_scalar("score/generation_min", float(scores.min()), step)
        write.add_scalar("score/generation_median", float(scores.median()), step)
        write.add_scalar("score/generation_max", float(scores.max()), step)
        best, spread = space.to_physical(optimizer.best).tolist(), optimizer.spread
        for label, value in zip(space.labels, best, strict=True):
            write.add_scalar(f"best/{label}", value, step)
        for name, where in space.slices.items():
            write.add_scalar(f"spread/{name}", float(spread[where].mean()), step)
        # the first one too, so that a short search has a picture
        if step % self.histogram_interval == 0 or step == 1:
            candidates = optimizer.candidates.numpy()
            for i, label in enumerate(space.labels):
                write.add_histogram(f"population/{label}", candidates[:, i], step, bins=_BINS)  # type: ignore[arg-type]

    def log_refinement(self, iteration: int, score: float) -> None:
        """Log an iteration of the refinement.

        Args:
            iteration: Its number.
            score: Best score so far [rad²].
        """
        self._writer.add_scalar("refinement/score", score, iteration)

    def log_result(self, result: FitResult) -> None:
        """Log what the fit ended with."""
        write = self._writer
        metrics = {"result/score": result.score, "result/delay_s": result.delay_s}
        metrics |= {f"result/rmse/{part}": errors[ALL] for part, errors in result.rmse.items() if ALL in errors}
        for part, errors in result.rmse.items():
            for joint, value in errors.items():
                if joint != ALL:
                    write.add_scalar(f"result/rmse/{part}/{joint}", value)
        for name, values in result.parameters.items():
            for key, value in values.items():
                write.add_scalar(f"result/{name}/{key}", value)
                if (std := result.std[name][key]) is not None:
                    write.add_scalar(f"result/std/{name}/{key}", std)
        write.add_text("result", _as_markdown(result))
        self._log_settings(result, metrics)
        write.flush()

    def close(self) -> None:
        """Write what is left and close the file."""
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def _log_settings(self, result: FitResult, metrics: dict[str, float]) -> None:
        """The line of this run in the HPARAMS tab, in this run's own file (``add_hparams`` would open a folder)."""
        from torch.utils.tensorboard.summary import hparams

        settings: dict[str, Any] = {
            "task": result.task,
            "optimizer": result.optimizer,
            "seed": result.seed,
            "delay_mode": result.delay_mode,
            "physics_dt": result.physics_dt,
            "effects": ", ".join(result.effects) or "none",
            "recordings": ", ".join(result.recordings.get("train", [])),
        }
        for summary in hparams(settings, metrics):
            self._writer.file_writer.add_summary(summary)  # type: ignore[attr-defined]
        for tag, value in metrics.items():
            self._writer.add_scalar(tag, value)


def _as_markdown(result: FitResult) -> str:
    """Warnings, notes and the way to the result."""
    lines = [f"**{result.robot_name}**, {result.task}", ""]
    for title, entries in (("Warnings", result.warnings), ("Notes", result.notes), ("Stopped", result.stop_reasons)):
        if entries:
            lines += ["", f"| {title} |", "|---|", *(f"| {_in_cell(entry)} |" for entry in entries)]
    lines += ["", f"{result.simulated_steps / 1e6:.2f} M simulated steps in {result.wall_time_s:.1f} s"]
    return "\n".join(lines)


def _in_cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
