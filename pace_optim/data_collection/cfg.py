"""What is asked of a data collection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pace_optim.recording import Drive, Load


@dataclass(frozen=True, kw_only=True)
class CollectionCfg:
    """Which motion, of which robot, with which true parameters, measured how, written where."""

    task: str
    """Identification environment, such as ``"Pace-AnymalD-v0"``."""
    excitation: str = "chirp"
    """Name of the motion."""
    duration: float | None = None
    """Duration of each trajectory [s]; ``None`` means the excitation's usual one."""
    min_frequency: float = 0.1
    """Lower end of the band [Hz]."""
    max_frequency: float = 10.0
    """Upper end of the band [Hz]."""
    optimize: bool = False
    """Whether amplitudes, centres and bands are chosen so that the expected error bars are smallest."""
    reach: float = 1.0
    """With ``optimize``: width of the range of targets, as a multiple of what the robot's excitation states."""
    seed: int = 0
    """Seed of the motion and of the noise."""
    effects: tuple[str, ...] = ()
    """Physical effects hidden in the recordings, by name; they are then made by the independent plant."""
    effect_joints: str = ".*"
    """Which joints have them, a regular expression."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """True parameters in place of ``PaceCfg.sample_params``: by name, or ``name/joint``."""
    noise: float = 0.0
    """Standard deviation of the encoder's noise [rad]."""
    encoder_bits: int | None = None
    """Resolution of the encoder, 2^bits steps per turn; ``None`` means exact."""
    stiffness: float | None = None
    """Proportional gain of all joints [N m/rad]; ``None`` means the robot's."""
    damping: float | None = None
    """Derivative gain of all joints [N m s/rad]; ``None`` means the robot's."""
    velocity_joints: str | None = None
    """Joints whose drives follow speeds, a regular expression; ``None``: those without a proportional gain."""
    load: Load = field(default_factory=Load)
    """What the robot carries."""
    delay_mode: str | None = None
    """``"command"`` or ``"effort"``; ``None`` means the robot's."""
    physics_dt: float | None = None
    """A finer physics step under the same control rate [s]."""
    control_dt: float | None = None
    """Time between two commands [s] of a robot that a model file states; ``None``: 2.5 ms."""
    output: Path | None = None
    """File of the recording; ``None`` means ``data/<robot_name>/<excitation>.npz``."""
    export_command: Path | None = None
    """CSV file of the commands alone."""
    command_only: bool = False
    """Whether only the commands are made and nothing is simulated."""
    plot: Path | None = None
    """PNG file of the plot; ``None`` means beside the output."""
    no_plot: bool = False
    """Whether to draw nothing."""
    positions_only: bool = False
    """Whether to leave ``dof_vel`` out of the recording."""
    overwrite: bool = False
    """Whether files that exist are replaced; otherwise they are refused, for they may be measurements."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        load = self.load
        numbers = {
            "noise": self.noise,
            "stiffness": self.stiffness,
            "damping": self.damping,
            "load_mass": load.load_mass,
            "load_length": load.load_length,
            "arm_mass": load.arm_mass,
            **{f"added_mass {body}": mass for body, mass in load.added_mass.items()},
        }
        for name, value in numbers.items():
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{name} is {value:g}; expected a finite number of 0 or more.")
        if self.encoder_bits is not None and not 1 <= self.encoder_bits <= 32:
            raise ValueError(f"encoder_bits is {self.encoder_bits}; expected 1 to 32 (12 to 20 are usual).")
        if self.command_only and self.effects:
            raise ValueError("Nothing is simulated with --command_only, so --effect has no use. Leave one out.")
        if self.effect_joints != ".*" and not self.effects:
            raise ValueError("--effect_joints needs an effect. Add --effect NAME.")
        if self.command_only and self.output is not None:
            raise ValueError(
                "Nothing is recorded with --command_only, so --output has no use. Name the file of the commands with "
                "--export_command."
            )

    def drive(self, num_joints: int) -> Drive:
        """Gains in place of the robot's, for all joints."""
        gains = {"stiffness": self.stiffness, "damping": self.damping}
        return Drive(**{key: np.full(num_joints, value) for key, value in gains.items() if value is not None})
