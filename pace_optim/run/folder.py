"""The folder of a run: what is written, and what a resumed run reads."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np
import torch

from pace_optim.run.history import History
from pace_optim.terminal.atomic import write_atomically, write_json, write_tensors
from pace_optim.terminal.cli import command

if TYPE_CHECKING:
    from pace_optim.optimizers.cmaes_optimizer import CMAESOptimizer
    from pace_optim.optimizers.least_squares import Descent
    from pace_optim.problem.problem import Problem

_README = """Identification of {robot} with {task}, started {started}.

result.json          parameters, error bars, errors and warnings
report.html          the same to look at
best_trajectory.pt   commanded, measured and simulated positions of the best parameters (torch.load)
mean_xxx.pt          mean of the search after generation xxx, physical, in the layout of config.pt
config.pt            joints, bounds and layout of the parameter vector
history.json         scores over iterations
comparison.json      where the model fails, once {compare} was run
diagnosis.json       which physical effect is missing, once {diagnose} was run
events.out.*         TensorBoard: tensorboard --logdir {folder}
settings.json, checkpoint.npz   what `{fit} --resume {folder}` needs
"""


class RunFolder:
    """Writes and reads one run's files; every write is atomic."""

    def __init__(self, path: Path):
        """Use an existing folder."""
        self.path = path

    @classmethod
    def create(cls, log_dir: str | Path, robot_name: str) -> RunFolder:
        """A new folder ``<log_dir>/<robot_name>/<YY_MM_DD_HH-MM-SS>``."""
        parent = Path(log_dir) / robot_name
        name = stamp = datetime.now().strftime("%y_%m_%d_%H-%M-%S")
        for attempt in range(1, 1000):
            try:
                (parent / name).mkdir(parents=True)
                return cls(parent / name)
            except FileExistsError:  # another run of the same second
                name = f"{stamp}_{attempt}"
        raise OSError(f"No free folder under {parent}.")

    def write_start(self, settings: dict[str, Any], digests: dict[str, str], problem: Problem) -> None:
        """Everything that is known before the first simulation."""
        write_json(self.path / "settings.json", {"settings": settings, "digests": digests})
        write_tensors(
            self.path / "config.pt",
            {
                "task": problem.task,
                "joint_order": list(problem.joint_names),
                "bounds_params": torch.stack([problem.space.lower, problem.space.upper], dim=1),
                "parameters": list(problem.space.labels),
                "slices": {name: [s.start, s.stop] for name, s in problem.space.slices.items()},
                "delay_mode": problem.delay_mode,
                "control_dt": problem.control_dt,
                "physics_dt": problem.physics_dt,
            },
        )
        text = _README.format(
            robot=problem.env_cfg.sim2real.robot_name,
            task=problem.task,
            started=datetime.now().strftime("%Y-%m-%d %H:%M"),
            folder=self.path,
            **{verb: command(verb) for verb in ("fit", "compare", "diagnose")},
        )
        write_atomically(self.path / "README.txt", lambda file: file.write(text.encode()))

    def write_checkpoint(
        self,
        optimizer: CMAESOptimizer | None,
        descents: Sequence[Descent],
        search_stop: Sequence[str],
        steps: int,
        scores: History,
    ) -> None:
        """The state of the search and of the refinement, as plain numbers, and the scores so far."""
        write_json(self.path / "history.json", scores.to_dict())
        history = np.stack(optimizer.history) if optimizer and optimizer.history else np.zeros((0, 0, 0))
        arrays = {
            "history": history,
            "line_generation": np.array(optimizer.line_generation if optimizer else -1),
            "search_stop": np.array(list(search_stop), dtype=str),
            "simulated_steps": np.array(steps),
            "descent_x": np.stack([d.x.numpy() for d in descents]) if descents else np.zeros((0, 0)),
            "descent_state": np.array(
                [[d.score, d.damping, d.iteration, d.stalled, d.jacobian is not None] for d in descents]
            ).reshape(-1, 5),
            "descent_stop": np.array([d.stop_reason or "" for d in descents], dtype=str),
            "descent_scores": np.array(json.dumps([d.scores for d in descents])),
        }
        write_atomically(self.path / "checkpoint.npz", lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]

    def read_checkpoint(self) -> dict[str, np.ndarray]:
        """What :meth:`write_checkpoint` wrote.

        Raises:
            ValueError: If there is none, or it is damaged.
        """
        path = self.path / "checkpoint.npz"
        if not path.is_file():
            raise ValueError(f"{self.path} has no checkpoint.npz: it cannot be resumed. Start a new fit.")
        try:
            with np.load(path, allow_pickle=False) as content:
                return {key: content[key] for key in content.files}
        except (OSError, ValueError, EOFError, AttributeError, BadZipFile) as error:
            raise ValueError(f"{path} cannot be read ({error}). Start a new fit.") from None

    def read_history(self) -> History:
        """The scores so far, as :meth:`write_checkpoint` wrote them.

        Raises:
            ValueError: If the file is missing or damaged.
        """
        path = self.path / "history.json"
        try:
            return History(**json.loads(path.read_text()))
        except (OSError, TypeError, json.JSONDecodeError) as error:
            raise ValueError(f"{path} cannot be read ({error}). Start a new fit.") from None

    def write_mean(self, generation: int, physical: torch.Tensor) -> None:
        """The mean of the search after a generation."""
        write_tensors(self.path / f"mean_{generation:03d}.pt", physical)

    def write_tensors(self, name: str, content: Any) -> None:
        """A file for ``torch.load``."""
        write_tensors(self.path / name, content)

    def write_json(self, name: str, content: Any) -> None:
        """A JSON file."""
        write_json(self.path / name, content)
