"""Drawing truths: base parameters, effects of visible size, a small background of others."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pace_optim.recording import Recording

from .hidden import Draw, effect_named, library_effects
from .robot import PlantRobot
from .simulate import simulate_truths
from .truth import BaseTruth, PlantCfg, Run, Truth

VISIBLE = 3.0
"""An effect changes the motion by at least this many times the noise (RMS)."""
_DRAWS = 3  # of each round
_ROUNDS = 4
_BOOST = 1.7  # from round to round
_NOT_IN_BACKGROUND = {
    "torque_limit",
    "torque_speed_limit",
    "command_rate_limit",
    "command_acceleration_limit",
    "backlash",
}
_BACKGROUND = 20  # effects of a background, at most
_STIFFEST = 1e5  # [N m/rad], of a small elasticity
_BENCH_BASE = {
    "armature": Draw(unit="kg m^2", low=0.05, high=0.2),
    "viscous_friction": Draw(unit="N m s/rad", low=1.5, high=4.5),
    "friction": Draw(unit="N m", low=0.2, high=1.0),
    "encoder_bias": Draw(unit="rad", low=0.002, high=0.03, signed=True),
    "delay": Draw(unit="s", low=0.002, high=0.010),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """A drawn truth with its recordings."""

    truth: Truth
    """What is hidden."""
    recordings: tuple[Recording, ...]
    """One per run."""
    size: float
    """RMS change of the motion against the base alone, over all runs and the effects' joints [rad]."""


def draw_base(robot: PlantRobot, rng: np.random.Generator) -> BaseTruth:
    """Base parameters: bench drives at random; of a robot, its sample parameters times 0.75 to 1.25 per joint."""
    if robot.name == "test_bench":
        return BaseTruth(**{key: draw.sample(rng, 1.0, 1.0) for key, draw in _BENCH_BASE.items()})
    values: dict[str, dict[str, float]] = {}
    for key in ("armature", "viscous_friction", "friction", "encoder_bias"):
        given = robot.pace.sample_params.get(key, 0.0)
        values[key] = {
            name: float(given[name] if isinstance(given, Mapping) else given) * float(rng.uniform(0.75, 1.25))
            for name in robot.joint_names
        }
    steps = robot.pace.sample_params.get("delay", 2.0)
    mean = float(np.mean(list(steps.values()))) if isinstance(steps, Mapping) else float(steps)
    return BaseTruth(**values, delay=mean * robot.control_dt * float(rng.uniform(0.75, 1.25)))  # type: ignore[arg-type]


def joints_of(robot: PlantRobot, pattern: str) -> tuple[str, ...]:
    """The joints that a regular expression names."""
    try:
        names = tuple(name for name in robot.joint_names if re.fullmatch(pattern, name))
    except re.error as error:
        raise ValueError(f"{pattern!r} is not a regular expression ({error}). Correct it.") from None
    if not names:
        raise ValueError(f"The pattern {pattern!r} matches no joint. Available: {', '.join(robot.joint_names)}.")
    return names


def draw_effect(
    name: str, robot: PlantRobot, rng: np.random.Generator, joints: Sequence[str] | None = None, boost: float = 1.0
) -> dict[str, dict[str, float]]:
    """An effect's parameters, the same on all its joints: {parameter: {joint: value}}.

    Args:
        robot: The robot, whose strength scales torques.
        joints: Which joints have it; None for all.
        boost: Above 1, it is larger than its range says.
    """
    where = robot.joint_names if joints is None else joints
    drawn = {
        parameter: draw.sample(rng, robot.torque_scale, boost) for parameter, draw in effect_named(name).draws.items()
    }
    return {parameter: dict.fromkeys(where, value) for parameter, value in drawn.items()}


def motion_change(
    changed: Sequence[Recording], base: Sequence[Recording], joints: Sequence[str] | None = None
) -> float:
    """RMS difference of positions over recordings and joints [rad]."""
    names = base[0].joint_names
    columns = [i for i, name in enumerate(names) if joints is None or name in joints]
    total = [np.square(a.dof_pos - b.dof_pos)[:, columns].mean() for a, b in zip(changed, base, strict=True)]
    return float(np.sqrt(np.mean(total)))


def draw_visible(
    robot: PlantRobot,
    runs: Sequence[Run],
    names: Sequence[str],
    rng: np.random.Generator,
    *,
    cfg: PlantCfg | None = None,
    base: Truth | None = None,
    joints: str = ".*",
    smallest: float | None = None,
) -> Drawn:
    """Draw effects until together they change the motion visibly, and each does alone.

    Draws that change it by less than three times the noise, or that make the loop run wild (by more than the motion
    itself), are drawn again; each round sizes grow, so that effects that this robot hides still end visible.

    Args:
        names: The effects; none for the base alone.
        base: The truth to add to; None draws one.
        joints: Which joints have the effects, a regular expression.
        smallest: Smallest change that counts as visible [rad]; None for three times the noise.
    """
    cfg = cfg or PlantCfg()
    where = joints_of(robot, joints)
    smallest = VISIBLE * cfg.noise if smallest is None else smallest
    truth = base or Truth(base=draw_base(robot, rng))
    plain = simulate_truths(robot, runs, [truth], cfg)[0]
    result = Drawn(truth=truth, recordings=tuple(plain), size=0.0)
    chosen: dict[str, dict[str, dict[str, float]]] = {}
    for name in names:
        alone = _visible_alone(name, robot, runs, truth, plain, where, rng, cfg, smallest)
        chosen[name] = {p: dict(v) for p, v in alone.truth.effects[name].items()}  # type: ignore[arg-type]
        result = alone
    if len(names) > 1:
        both = replace(truth, effects={**truth.effects, **chosen})
        made = simulate_truths(robot, runs, [both], cfg)[0]
        result = Drawn(truth=both, recordings=tuple(made), size=motion_change(made, plain, where))
    return result


def _visible_alone(
    name: str,
    robot: PlantRobot,
    runs: Sequence[Run],
    truth: Truth,
    plain: Sequence[Recording],
    where: Sequence[str],
    rng: np.random.Generator,
    cfg: PlantCfg,
    smallest: float,
) -> Drawn:
    motion = float(np.sqrt(np.mean([r.dof_pos.var() for r in plain])))
    largest = 0.0
    for round_ in range(_ROUNDS):
        for _ in range(_DRAWS):
            values = draw_effect(name, robot, rng, where, _BOOST**round_)
            one = replace(truth, effects={**truth.effects, name: values})
            try:
                made = simulate_truths(robot, runs, [one], cfg)[0]
            except ValueError:  # it diverges
                continue
            size = motion_change(made, plain, where)
            largest = max(largest, size)
            if smallest <= size <= motion and size > 0:
                return Drawn(truth=one, recordings=tuple(made), size=size)
    raise ValueError(
        f"{name} changes the motion by {largest:.2g} rad at most; expected {smallest:.2g} to {motion:.2g}. "
        "Choose a motion that shows it, or less noise."
    )


def with_background(
    robot: PlantRobot,
    runs: Sequence[Run],
    drawn: Drawn,
    rng: np.random.Generator,
    *,
    size: float,
    cfg: PlantCfg | None = None,
) -> Drawn:
    """Add small amounts of other library effects that together change the motion by ``size`` [rad], RMS.

    Their sizes are drawn, then scaled by one factor that three or four simulations find.

    Args:
        size: RMS change of the motion by all of them together [rad].
    """
    cfg = cfg or PlantCfg()
    others = [n for n in library_effects() if n not in drawn.truth.effects and n not in _NOT_IN_BACKGROUND]
    names = sorted(rng.permutation(others)[:_BACKGROUND].tolist())
    values = {name: draw_effect(name, robot, rng) for name in names}
    scale, made, change = 0.05 * size / max(drawn.size, size), list(drawn.recordings), 0.0
    truth = drawn.truth
    for _ in range(5):
        small = {name: scaled(name, values[name], scale) for name in names}
        truth = replace(drawn.truth, effects={**drawn.truth.effects, **small})
        made = simulate_truths(robot, runs, [truth], cfg)[0]
        change = motion_change(made, drawn.recordings)
        if abs(change / size - 1) < 0.1:
            break
        scale *= float(np.clip(size / max(change, 1e-9), 0.1, 10.0))
    return Drawn(truth=truth, recordings=tuple(made), size=drawn.size)


def scaled(name: str, values: Mapping[str, Mapping[str, float]], factor: float) -> dict[str, dict[str, float]]:
    """An effect made smaller by a factor; shapes (speeds, places, time constants of a shape) stay."""
    result = {}
    for parameter, draw in effect_named(name).draws.items():
        of_role = {"size": factor, "inverse": 1 / factor, "shape": 1.0}[draw.role]
        cap = _STIFFEST if draw.role == "inverse" else np.inf
        middle = 1.0 if draw.factor else 0.0
        result[parameter] = {joint: min(middle + (v - middle) * of_role, cap) for joint, v in values[parameter].items()}
    return result
