"""A fit on TensorBoard: scores, the distribution of every parameter, and the result."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from pace_actuators.drive_result import ALL
from pace_optim.run.result import FitResult

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

    from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer

_PACES_GROUPS = {
    "delay": "0_Delay",
    "armature": "1_Armature",
    "viscous_friction": "2_Damping",
    "friction": "3_Friction",
    "encoder_bias": "4_Bias",
}
"""Parameters by the groups of PACE's tags."""
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

    Beside them the tags of PACE: ``0_Episode/score``, ``max_score``, ``diff_score``, ``0_Delay/best``,
    ``0_Delay/distribution``, and ``best_<joint>``, ``distribution_<joint>`` under ``1_Armature``, ``2_Damping``,
    ``3_Friction`` and ``4_Bias``. There ``best`` is of the generation, not so far.
    """

    def __init__(self, folder: Path, histogram_interval: int = 10):
        """Prepare; the events' file appears with the first event.

        Args:
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
        self._log_as_pace(optimizer, scores)
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

    def _log_as_pace(self, optimizer: CMAESOptimizer, scores: torch.Tensor) -> None:
        step, write, low, high = optimizer.generation, self._writer, float(scores.min()), float(scores.max())
        write.add_scalar("0_Episode/score", low, step)
        write.add_scalar("0_Episode/max_score", high, step)
        if low > 0:
            write.add_scalar("0_Episode/diff_score", (high - low) / low, step)
        candidates, best = optimizer.candidates.numpy(), int(scores.argmin())
        with_histograms = step % self.histogram_interval == 0 or step == 1
        for name, group in _PACES_GROUPS.items():
            entries = range(optimizer.space.size)[optimizer.space[name]]
            keys = ("",) if name == "delay" else optimizer.joint_names
            for entry, key in zip(entries, keys, strict=True):
                end = f"_{key}" if key else ""
                write.add_scalar(f"{group}/best{end}", float(candidates[best, entry]), step)
                if with_histograms:
                    write.add_histogram(f"{group}/distribution{end}", candidates[:, entry], step, bins=_BINS)  # type: ignore[arg-type]

    def log_refinement(self, iteration: int, score: float) -> None:
        """Log an iteration of the refinement.

        Args:
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
    for title, entries in (
        ("Warnings", result.warnings),
        ("Notes", [*result.findings, *result.notes]),
        ("Stopped", result.stop_reasons),
    ):
        if entries:
            lines += ["", f"| {title} |", "|---|", *(f"| {_in_cell(entry)} |" for entry in entries)]
    lines += ["", f"{result.simulated_steps / 1e6:.2f} M simulated steps in {result.wall_time_s:.1f} s"]
    return "\n".join(lines)


def _in_cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
