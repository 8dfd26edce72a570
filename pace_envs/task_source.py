"""Where a task comes from: a name, your module or a model file; and how a run's record finds it again."""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pace_actuators.files import checked
from pace_actuators.own_code import (
    checked_record,
    code_of,
    import_recorded,
    import_reference,
    loaded_module,
    split_reference,
    trust,
)
from pace_envs.model_file import is_model_file, read_model_file
from pace_envs.registration import load_env_cfg, registered_by


def use_task(text: str) -> str:
    """Make a task known that the user names, and return its text, good from any folder.

    Args:
        text: A registered name, ``module:Name``, ``path/to/file.py:Name`` (either registers the name when it is
            imported), or a model file (``.xml``, ``.mjcf``, ``.urdf``).
    """
    if is_model_file(text):
        if not Path(text).is_file():
            raise ValueError(f"--task {text}: there is no such model file. Correct its path.")
        return str(Path(text).resolve())
    return import_reference(text, f"--task {text}")


@dataclass(frozen=True, kw_only=True)
class EnvironmentRecord:
    """What a run keeps to find its environment again."""

    task: str
    """As :func:`use_task` returns it."""

    module: str | None = None
    """What is imported so that the task is known, a module or a file; ``None``: this package knows it."""

    folder: str = ""
    """Where relative paths of the configuration begin."""

    code: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """File and SHA-256 of each module of the user's own."""

    files: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of each file that the model consists of."""

    control_dt: float | None = None
    """Time between two commands [s] of a model file, which does not say it."""

    held_joints: Mapping[str, float] = field(default_factory=dict)
    """Joints that are held, beside those that the task itself holds, and where [rad, of slides m]."""

    motors: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Motors that move several joints of a model file and that it does not have, {motor: {joint: ratio}}."""

    @classmethod
    def of(cls, task: str, cfg: Any, effects: Iterable[str] = (), folder: str | None = None) -> EnvironmentRecord:
        """The record of a task that is known.

        Args:
            task: As :func:`use_task` returns it.
            effects: Modules of effects of the user's own.
            folder: Where relative paths begin; ``None`` means the present folder.
        """
        module = None if is_model_file(task) else split_reference(task)[0] or registered_by(task)
        files = model_files(Path(cfg.scene.robot.mjcf_path).resolve(), touches=cfg.scene.terrain is not None)
        code = code_of([*([module] if module else []), *effects])
        trust(entry["sha256"] for entry in code.values())  # it runs here already
        return cls(
            task=task,
            module=module,
            folder=folder or str(Path.cwd()),
            code=code,
            files={str(file): file_digest(file) for file in files},
            control_dt=cfg.sim.dt * cfg.decimation if is_model_file(task) else None,
            held_joints=dict(cfg.scene.robot.held_joints),
            motors=_stated_motors(cfg.scene.robot) if is_model_file(task) else {},
        )

    @classmethod
    def read(
        cls, content: Mapping[str, Any] | None, task: str, source: object = "settings.json", cure: str = "Start again."
    ) -> EnvironmentRecord:
        """The ``environment`` of a file; that of a registered task without such a file."""
        if not content:
            return cls(task=task)
        whole = {"task": task, **content} if isinstance(content, Mapping) else content
        record = checked(cls, whole, f"{source}: environment", cure)
        checked_record(content, source, cure)
        return record

    def to_dict(self) -> dict[str, Any]:
        """For a JSON file."""
        return asdict(self)

    def use(self, where: str, task: str | None = None) -> str:
        """Make the task known again and return its text, or another that the user names instead.

        Args:
            where: The file of this record, for messages.
            task: Another one, as :func:`use_task` returns it.
        """
        if task is not None:
            return task
        name = split_reference(self.task)[1]
        if self.module == "__main__":
            if loaded_module("__main__") is not None and registered_by(name) == "__main__":
                return self.task
            raise ValueError(f"{where} was made by a script that registers {name}. Name it: --task FILE.py:{name}.")
        if is_model_file(self.task) or self.module is None:
            return self.task
        import_recorded(self.module, self.code, where, f"--task {self.module}:{name}")
        return self.task

    def load_cfg(self, where: str, task: str | None = None) -> Any:
        """A fresh configuration of the environment; relative paths begin where the run was started."""
        known = self.use(where, task)
        try:
            of_file = (self.control_dt, self.motors) if is_model_file(known) else ()
            cfg = load_env_cfg(known, *of_file)
        except ValueError as error:  # what the record says, unless the user names another
            raise ValueError(str(error) if task is not None else f"{where}: {error}") from None
        path = Path(cfg.scene.robot.mjcf_path)
        if self.folder and not path.is_absolute() and not path.is_file():
            cfg.scene.robot.mjcf_path = Path(self.folder) / path
        return cfg.holding(self.held_joints) if self.held_joints and hasattr(cfg, "holding") else cfg


def _stated_motors(robot: Any) -> dict[str, dict[str, float]]:
    """Motors that a robot's model file lacks, and joints of these that keep their drives."""
    rows = dict(robot.couplings)
    spec = read_model_file(robot.mjcf_path).spec if rows else None
    stated = {m: dict(row) for m, row in rows.items() if spec and not (spec.joint(m) or spec.tendon(m))}
    turned = {joint for row in stated.values() for joint in row}
    return {joint: {joint: 1.0} for joint in robot.joint_order or () if joint in turned} | stated


def model_files(path: Path, *, touches: bool = False) -> list[Path]:
    """A model file and what it includes and needs, as far as it is there; with the meshes that touch, or without."""
    found = [path]
    for file in found:
        for name in _included(file):
            if (each := (path.parent / name).resolve()).is_file() and each not in found:
                found.append(each)
    try:
        spec = read_model_file(path, touches=touches).spec  # less the meshes that are not needed
    except (ValueError, OSError):
        return found
    meshes = [path.parent / spec.meshdir / mesh.file for mesh in spec.meshes if mesh.file]
    return found + sorted({mesh.resolve() for mesh in meshes if mesh.is_file()})


def file_digest(path: str | Path) -> str:
    """SHA-256 of a file, or of all files of a folder, to see whether they have changed."""
    path, digest = Path(path), hashlib.sha256()
    if not path.is_dir():
        with path.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()
    for file in sorted(each for each in path.rglob("*") if each.is_file()):
        digest.update(f"{file.relative_to(path)}\0{file_digest(file)}\0".encode())
    return digest.hexdigest()


def _included(file: Path) -> list[str]:
    try:
        return [name for element in ET.parse(file).iter("include") if (name := element.get("file"))]
    except (ET.ParseError, OSError):
        return []
