"""Which recordings a case has: a battery or one chirp, and validation recordings of another kind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pace_envs.tasks.pace import ExcitationCfg, PaceCfg
from pace_optim.motion.signals import Trajectory, make_excitation
from pace_optim.recording import Drive, Load

from .robot import PlantRobot
from .truth import Run

Kind = Literal["battery", "chirp"]

BENCH_LOAD = Load(load_mass=2.0, load_length=0.375, arm_mass=0.33)
"""Link inertia 0.30 kg m^2, gravity torque 8.0 N m."""
_BENCH_MASS = {"load": 0.8}  # the known mass [kg]
_BENCH_SCALE, _BENCH_STAIRCASE = 0.8, 1.3  # [rad]
_KP_FACTOR = 1.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Suite:
    """The recordings of a case, before they are made; all of the same length."""

    train: tuple[Run, ...]
    """To fit."""
    validation: tuple[Run, ...]
    """To judge."""

    @property
    def runs(self) -> tuple[Run, ...]:
        """All, in the order of the session."""
        return (*self.train, *self.validation)


def make_suite(
    robot: PlantRobot,
    kind: Kind = "battery",
    *,
    seed: int = 0,
    duration: float | None = None,
    gains: tuple[float, float] | None = None,
) -> Suite:
    """The usual recordings of a robot.

    "battery": the six motions of 10 s, one chirp again with 1.5 times the proportional gain, one again with a known
    mass added (0.8 kg on the bench, 0.5 kg on each last link elsewhere); validated by a multisine and by other steps.
    "chirp": 20 s, validated by a multisine. Recordings follow one another without a pause, in this order.

    Args:
        duration: Of each recording [s]; None for the usual.
        gains: kp [N m/rad] and kd [N m s/rad] of all joints; None for the robot's.
    """
    bench = robot.name == "test_bench"
    load = BENCH_LOAD if bench else Load()
    known_mass = _BENCH_MASS if bench else _last_links(robot)
    small = 0.6 if bench else 0.75
    drive, stiffness = Drive(), robot.drive["stiffness"]
    if gains is not None:
        stiffness = np.full(robot.num_joints, gains[0])
        drive = Drive(stiffness=stiffness, damping=np.full(robot.num_joints, gains[1]))
    if kind == "chirp":
        span = 20.0 if duration is None else duration
        train = [("chirp", _motions(robot, "chirp", span, seed, bench, 0.5 / 0.8 if bench else 1.0)[0], drive, load)]
        validation = [("multisine", _motions(robot, "multisine", span, seed + 1, bench, small)[0], drive, load)]
    elif kind == "battery":
        span = 10.0 if duration is None else duration
        six = _motions(robot, "battery", span, seed, bench, 1.0)
        if bench:
            wide = _motions(robot, "battery", span, seed, bench, _BENCH_STAIRCASE / _BENCH_SCALE)
            six = [wide[i] if t.name == "staircase" else t for i, t in enumerate(six)]
        train = [(t.name, t, drive, load) for t in six]
        medium = next(t for t in six if t.name == "chirp_medium")
        stiff = replace(drive, stiffness=stiffness * _KP_FACTOR)
        train.append(("chirp_stiff", medium, stiff, load))
        train.append(("chirp_mass", medium, drive, replace(load, added_mass=known_mass)))
        validation = [
            ("multisine", _motions(robot, "multisine", span, seed + 1, bench, small)[0], drive, load),
            ("other_steps", _motions(robot, "steps", span, seed + 2, bench, small)[0], drive, load),
        ]
    else:
        raise ValueError(f"There is no kind of suite {kind!r}. Available: battery, chirp.")
    runs = [
        Run(name=name, command=t.des_dof_pos, drive=drive, load=each, session_start=i * span)
        for i, (name, t, drive, each) in enumerate([*train, *validation])
    ]
    return Suite(train=tuple(runs[: len(train)]), validation=tuple(runs[len(train) :]))


def session_of(trajectories: Sequence[Trajectory], drive: Drive, load: Load) -> list[Run]:
    """Runs of commanded trajectories, one after another without a pause."""
    ends = np.cumsum([0.0, *(len(t.time) * (t.time[1] - t.time[0]) for t in trajectories)])
    return [
        Run(name=t.name, command=t.des_dof_pos, drive=drive, load=load, session_start=float(start))
        for t, start in zip(trajectories, ends, strict=False)
    ]


def _motions(robot: PlantRobot, name: str, duration: float, seed: int, bench: bool, factor: float) -> list[Trajectory]:
    """An excitation, its amplitude times a factor."""
    pace: PaceCfg = robot.pace
    excitation = pace.excitation
    if excitation is None:
        raise ValueError(f"{robot.name} has no excitation. Set PaceCfg.excitation.")
    scale = (_BENCH_SCALE,) if bench else excitation.scale
    # target = (signal + bias) direction scale: the centre stays, the amplitude changes
    changed = ExcitationCfg(
        bias=tuple(b / factor for b in excitation.bias),
        direction=excitation.direction,
        scale=tuple(s * factor for s in scale),
    )
    return make_excitation(
        name, replace(pace, excitation=changed), control_dt=robot.control_dt, duration=duration, seed=seed
    )


def _last_links(robot: PlantRobot) -> dict[str, float]:
    """Half a kilogram, scaled with the drives, on each link that carries no other joint."""
    spec = robot.spec()
    model = spec.compile()
    moved = {int(model.joint(name).bodyid[0]) for name in robot.joint_names}
    inner = set()
    for body in moved:
        parent = int(model.body_parentid[body])
        while parent:
            inner.add(parent)
            parent = int(model.body_parentid[parent])
    mass = round(0.5 * min(1.0, robot.torque_scale), 3)
    return {model.body(body).name: mass for body in sorted(moved - inner)}
