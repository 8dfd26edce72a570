"""A case of the benchmark: what is hidden, and its files."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pace_actuators.files import write_atomically
from pace_optim.recording import save_recording

from .draw import Drawn, draw_visible, with_background
from .hidden import effect_named
from .robot import PlantRobot, plant_robot
from .simulate import simulate_truths
from .suite import Kind, Suite, make_suite
from .truth import BaseTruth, PlantCfg, Truth

_STIFF_GAINS = (300.0, 3.0)  # of the harmonic drive, kp [N m/rad] and kd [N m s/rad]


@dataclass(frozen=True, kw_only=True)
class Case:
    """One case; the same case is always drawn the same."""

    effects: tuple[str, ...] = ()
    """What is hidden; empty for a clean case."""
    seed: int = 0
    """Seed of base parameters, sizes, motions and noise."""
    task: str = "Pace-TestBench-v0"
    """The robot."""
    kind: Kind = "battery"
    """Which recordings."""
    background: float = 0.0
    """RMS change of the motion by about twenty other small effects, as a share of the effect's own; 0 for none."""
    part: Literal["both", "effects", "background"] = "both"
    """Which part of a case with a background the recordings have: one alone shows the error that this part makes."""
    harmonic_drive: bool = False
    """A 20:1 harmonic drive with a resonance above 0 dB at 4 to 8 Hz, in place of a drawn elasticity."""
    noise: float = 1e-4
    """Of the encoder [rad]."""
    joints: str = ".*"
    """Which joints have the effects, a regular expression."""

    @property
    def name(self) -> str:
        """A name for its folder."""
        what = "harmonic_drive" if self.harmonic_drive else "+".join(self.effects) or "clean"
        small = f"_background{self.background:g}" if self.background else ""
        small += f"_{self.part}" if self.part != "both" else ""
        return f"{self.task}_{self.kind}_{what}{small}_{self.seed}"


@dataclass(frozen=True, kw_only=True)
class CaseFiles:
    """A case's recordings."""

    train: tuple[Path, ...]
    """To fit."""
    validation: tuple[Path, ...]
    """To judge."""
    truth: Path
    """What was hidden, JSON."""


def make_case(case: Case) -> tuple[Suite, Drawn]:
    """Draw a case and simulate its recordings."""
    for name in case.effects:
        effect_named(name)
    if case.background and not (case.effects or case.harmonic_drive):
        raise ValueError("A background is a share of an effect's size, and the case has no effect. Name one.")
    if case.part != "both" and not case.background:
        raise ValueError(f"part is {case.part!r}, and the case has no background. Give one, or leave part at 'both'.")
    robot = plant_robot(case.task)
    key = sum(ord(c) * 31**i for i, c in enumerate("+".join(case.effects))) % 2**31
    rng = np.random.default_rng([case.seed, key])
    suite = make_suite(robot, case.kind, seed=case.seed, gains=_STIFF_GAINS if case.harmonic_drive else None)
    cfg = PlantCfg(control_dt=robot.control_dt, noise=case.noise, seed=case.seed)
    if case.harmonic_drive:
        drawn = draw_visible(robot, suite.runs, (), rng, cfg=cfg, base=harmonic_drive(robot, rng))
    else:
        drawn = draw_visible(robot, suite.runs, case.effects, rng, cfg=cfg, joints=case.joints)
    if case.background and case.part != "effects":
        both = with_background(robot, suite.runs, drawn, rng, size=case.background * drawn.size, cfg=cfg)
        drawn = both if case.part == "both" else _without(robot, suite, both, drawn.truth.effects, cfg)
    return suite, drawn


def _without(robot: PlantRobot, suite: Suite, drawn: Drawn, effects: Iterable[str], cfg: PlantCfg) -> Drawn:
    """The same recorded without some effects."""
    left = {name: values for name, values in drawn.truth.effects.items() if name not in effects}
    truth = replace(drawn.truth, effects=left)
    made = simulate_truths(robot, suite.runs, [truth], cfg)[0]
    return Drawn(truth=truth, recordings=tuple(made), size=drawn.size)


def write_case(case: Case, folder: str | os.PathLike[str]) -> CaseFiles:
    """Draw a case and write `train_<i>_<name>.npz`, `validation_<i>_<name>.npz` and `truth.json` to a folder."""
    folder = Path(folder)
    suite, drawn = make_case(case)
    files: dict[str, list[Path]] = {"train": [], "validation": []}
    for i, recording in enumerate(drawn.recordings):
        part = "train" if i < len(suite.train) else "validation"
        files[part].append(save_recording(folder / f"{part}_{i}_{recording.name}.npz", recording))
    truth = {"case": case.name, "size": drawn.size, **drawn.truth.to_dict()}
    path = write_truth(folder / "truth.json", truth)
    return CaseFiles(train=tuple(files["train"]), validation=tuple(files["validation"]), truth=path)


def write_truth(path: Path, truth: dict[str, Any]) -> Path:
    """Write what was hidden."""
    text = json.dumps(truth, indent=2).encode()
    write_atomically(path, lambda file: file.write(text))
    return path


def harmonic_drive(robot: PlantRobot, rng: np.random.Generator) -> Truth:
    """A drive whose joint elasticity resonates within the band of identification.

    The rotor of a 20:1 gear is light at the joint and held stiffly (kp 300, kd 3), the encoder is on the link, and the
    flexspline with what is behind it is soft: the link on its spring would resonate at sqrt(k / I) = 2π 4.5 to 6 Hz.
    Of a chirp the encoder shows 5 to 10 dB more than was commanded at 4 to 6 Hz.
    """
    inertia = 0.3 * robot.torque_scale  # of the bench's link
    k = inertia * (2 * np.pi * rng.uniform(4.5, 6.0)) ** 2
    base = BaseTruth(
        armature=float(rng.uniform(0.04, 0.07)) * robot.torque_scale,
        viscous_friction=float(rng.uniform(1.0, 2.5)) * robot.torque_scale,
        friction=float(rng.uniform(0.2, 0.6)) * robot.torque_scale,
        encoder_bias=float(rng.uniform(-0.02, 0.02)),
        delay=float(rng.uniform(0.002, 0.004)),
    )
    elasticity = {"k": float(k), "c": float(0.02 * np.sqrt(k * inertia)), "encoder_on_link": 1.0}
    return Truth(base=base, effects={"joint_elasticity": elasticity})
