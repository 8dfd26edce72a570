"""The folder of a run: what is written, and what a resumed run reads."""

from __future__ import annotations

import errno
import json
import os
import shlex
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from pace_actuators.files import checked, json_text, refuse, write_atomically, write_json, write_tensors, writing
from pace_actuators.files.writing import Writer
from pace_envs.task_source import file_digest
from pace_optim.estimate.least_squares import Descent, checkpoint_of
from pace_optim.run.history import History
from pace_optim.run.resolved import resolved, write_model
from pace_optim.terminal.arrays import read_arrays
from pace_optim.terminal.cli import command

if TYPE_CHECKING:
    from pace_optim.estimate.cmaes_optimizer import CMAESOptimizer
    from pace_optim.problem.problem import Problem

_README = """Identification of {robot} with {task}, started {started}.

result.json          parameters, error bars, errors and warnings
report.html          the same to look at
replay.html          the robot in 3-D, once {replay} was run
drives.json          the drives in force, and what each recording asked of them
best_trajectory.pt   commanded, measured and simulated positions of the best parameters (torch.load)
mean_xxx.pt          mean of the search, or best of the refinement, after iteration xxx; physical, as config.pt says
config.pt            joints, bounds and layout of the parameter vector, and the recordings
history.json         scores over iterations
comparison.json      where the model fails, once {compare} was run
diagnosis.json       which physical effect is missing, once {diagnose} was run; decisions.jsonl: each choice
consistency.json     values of each recording alone; with several recordings, near the noise
events.out.*         TensorBoard: tensorboard --logdir {folder}
model.mjb            the compiled model (mujoco.MjModel.from_binary_path)
settings.json, checkpoint.npz   what `{fit} --resume {folder}` needs
"""


_ANEW = "Start a new fit."

_CHECKPOINT = {
    "history": ("f", 3),
    "search_around": ("f", 1),
    "line_generation": ("i", 0),
    "search_stop": ("U", 1),
    "simulated_steps": ("i", 0),
    "looks": ("i", 0),
    "descents": ("U", 0),
    "descent_x": ("f", 2),
    "descent_hessian": ("f", 3),
    "descent_gradient": ("f", 2),
    "scores": ("U", 0),
}
"""Kind of number and number of axes of each array of a checkpoint."""


class RunFolder:
    """Writes and reads one run's files; every write is atomic."""

    def __init__(self, path: Path):
        """Use an existing folder."""
        self.path = path

    @staticmethod
    def refuse_file(log_dir: str | Path) -> None:
        """Refuse a place that is no folder, or is below a file, before anything is read.

        Raises:
            NotADirectoryError: If it is.
        """
        path = Path(log_dir).absolute()
        if not next(each for each in (path, *path.parents) if each.exists()).is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(log_dir))

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

    def write_start(
        self,
        settings: dict[str, Any],
        digests: dict[str, str],
        problem: Problem,
        *,
        inputs: dict[str, str | None],
        environment: dict[str, Any],
    ) -> None:
        """Everything that is known before the first simulation.

        Args:
            digests: SHA-256 of each recording.
            inputs: SHA-256 of each other file that was read; ``None`` where there was none.
        """
        write_model(problem, self.path / "model.mjb")
        content: dict[str, Any] = {
            "settings": settings,
            "environment": environment,
            "digests": digests,
            "inputs": inputs,
        }
        content |= {"model": file_digest(self.path / "model.mjb"), "resolved": resolved(problem)}
        write_json(self.path / "settings.json", content)
        write_tensors(
            self.path / "config.pt",
            {
                "task": problem.task,
                "joint_order": list(problem.joint_names),
                **_dataset(problem),
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
            folder=shlex.quote(str(self.path)),
            **{verb: command(verb) for verb in ("fit", "compare", "diagnose", "replay")},
        )
        write_atomically(self.path / "README.txt", lambda file: file.write(text.encode()))

    def write_checkpoint(
        self,
        optimizer: CMAESOptimizer | None,
        around: torch.Tensor,
        descents: Sequence[Descent],
        search_stop: Sequence[str],
        steps: int,
        looks: int,
        scores: History,
    ) -> None:
        """The state of the search and of the refinement, as plain numbers, and the scores so far.

        ``looks`` is the number of simulations between descents, whose steps are among ``steps``.
        """
        history = np.stack(optimizer.history) if optimizer and optimizer.history else np.zeros((0, 0, 0))
        arrays = {
            "history": history,
            "search_around": around.numpy(),
            "line_generation": np.array(optimizer.line_generation if optimizer else -1),
            "search_stop": np.array(list(search_stop), dtype=str),
            "simulated_steps": np.array(steps),
            "looks": np.array(looks),
            **checkpoint_of(descents),
            "scores": np.array(json.dumps(scores.to_dict())),
        }
        files: dict[Path, Writer] = {
            self.path / "history.json": lambda file: file.write(json_text(scores.to_dict())),
            self.path / "checkpoint.npz": lambda file: np.savez(file, **arrays),  # type: ignore[arg-type]
        }
        with writing(files):
            pass

    def read_checkpoint(self) -> dict[str, np.ndarray]:
        """What :meth:`write_checkpoint` wrote."""
        path = self.path / "checkpoint.npz"
        if not path.exists():
            raise ValueError(f"{self.path} has no checkpoint.npz: it cannot be resumed. {_ANEW}")
        arrays = read_arrays(path, _ANEW)
        for name, (kind, axes) in _CHECKPOINT.items():
            if name not in arrays:
                refuse(path, f"{name} is missing", _ANEW)
            if arrays[name].dtype.kind != kind or arrays[name].ndim != axes:
                refuse(path, f"{name} is of another type or shape", _ANEW)
            if kind == "f" and name != "descent_gradient" and np.isnan(arrays[name]).any():
                refuse(path, f"{name} holds values that are no numbers", _ANEW)
        try:
            Descent.restore(arrays)
        except (ValueError, TypeError, AttributeError, RecursionError):
            refuse(path, "its descents do not fit together", _ANEW)
        return arrays

    def history_of(self, checkpoint: dict[str, np.ndarray]) -> History:
        """The scores up to a checkpoint: ``history.json`` may be of one moment later."""
        where = f"{self.path / 'checkpoint.npz'}: scores"
        try:
            content = json.loads(str(checkpoint["scores"]))
        except (ValueError, RecursionError):
            refuse(where, "is no JSON", _ANEW)
        return checked(History, content, where, _ANEW)

    def write_mean(self, iteration: int, physical: torch.Tensor) -> None:
        """The mean of the search, or the best of the refinement, after an iteration of either."""
        write_tensors(self.path / f"mean_{iteration:03d}.pt", physical)

    def write_progress(self, saved: dict[str, torch.Tensor]) -> None:
        """Every generation's candidates and scores, also by PACE's names; tensors are written once."""
        names = {"params_buffer": saved["params"], "scores_buffer": saved["scores"]}
        write_tensors(self.path / "progress.pt", saved | names)

    def write_tensors(self, name: str, content: Any) -> None:
        """A file for ``torch.load``."""
        write_tensors(self.path / name, content)

    def write_json(self, name: str, content: Any) -> None:
        """A JSON file."""
        write_json(self.path / name, content)


def _dataset(problem: Problem) -> dict[str, Any]:
    """The recordings, as logged on the control grid; the first also under the keys that PACE's ``config.pt`` has."""
    recordings = [
        {
            "name": recording.name,
            "time": torch.as_tensor(recording.time),
            "dof_pos": torch.as_tensor(recording.dof_pos),
            "des_dof_pos": torch.as_tensor(recording.sampled_command),
        }
        for recording in problem.dataset.recordings
    ]
    first = {key: recordings[0][key] for key in ("time", "dof_pos", "des_dof_pos")}
    bounds = torch.stack([problem.space.lower, problem.space.upper], dim=1)
    return {"recordings": recordings, **first, "bounds": bounds}
