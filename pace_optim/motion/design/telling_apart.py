"""Which recording would separate two models of a robot: they are simulated on a menu of motions and loads."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from pace_actuators.effects import EffectCfg
from pace_actuators.joint_units import units_for
from pace_optim.motion.signals import make_excitation
from pace_optim.problem.drive_facts import configured_drive, in_force
from pace_optim.problem.problem import Problem
from pace_optim.recording import Recording
from pace_optim.recording.dataset import Dataset, make_dataset
from pace_optim.terminal.cli import command
from pace_optim.terminal.parallel import parallel_map

_MOTIONS = ("chirp", "multisine", "ramp", "steps")


@dataclass(frozen=True, kw_only=True)
class MenuCfg:
    """What could be recorded next."""

    duration: float = 10.0
    """Of each recording [s]."""
    factor: float = 1.5
    """Of the proportional gain, and of the load."""
    clear: float = 3.0
    """Predictions part clearly above this many times the noise."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """One entry of the menu."""

    words: str
    """What to record."""
    arguments: str
    """The same for ``scripts/data_collection.py``."""
    recording: Recording
    """Its commands, gains and load; what would be measured is not known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotModel:
    """What a robot may be like."""

    effects: Sequence[EffectCfg]
    values: Mapping[str, Mapping[str, float]]
    """Parameters, as in ``result.json``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rivals:
    """Two models that do equally well on some joints."""

    names: tuple[str, str]
    """Of what they differ in."""
    models: tuple[RobotModel, RobotModel]
    joints: list[int]
    hint: str = ""
    """What separates such models in general."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """How far two models' predictions for an entry of the menu are apart."""

    pair: Rivals
    choice: Choice
    apart: float
    """[rad]."""
    times: float
    """The same as a multiple of the noise."""


def next_experiments(
    problem: Problem, pairs: Sequence[Rivals], noise: torch.Tensor, cfg: MenuCfg | None = None
) -> list[str]:
    """The fewest recordings that would separate what the present ones cannot, as sentences.

    Args:
        problem: The whole robot with the base model.
        noise: Of each joint, (n,) [rad].
    """
    cfg = cfg or MenuCfg()
    by_torque = _told(problem) == "torque"
    if not pairs or problem.env_cfg.sim2real.excitation is None or bool(by_torque.any()):
        own = " Record another motion of your controller, and log its commands." if bool(by_torque.any()) else ""
        return [
            f"These recordings cannot separate {_named(pair, problem)}.{own} {pair.hint}".rstrip() for pair in pairs
        ]
    menus = {joint: list(menu(problem, joint, cfg)) for joint in dict.fromkeys(pair.joints[0] for pair in pairs)}
    recordings = {joint: [choice.recording for choice in choices] for joint, choices in menus.items()}
    apart = distances(problem, pairs, [recordings[pair.joints[0]] for pair in pairs])
    predictions = [
        Prediction(pair=pair, choice=choice, apart=each, times=each / float(noise[pair.joints].mean()))
        for pair, own in zip(pairs, apart, strict=True)
        for choice, each in zip(menus[pair.joints[0]], own.tolist(), strict=True)
    ]
    clear = [each for each in predictions if each.times >= cfg.clear]
    result, left = [], list(pairs)
    while best := _most_telling([each for each in clear if each.pair in left]):
        result.append(_sentence(best, problem))
        left = [pair for pair in left if pair not in [each.pair for each in best]]
    for pair in left:
        count = sum(each.pair is pair for each in predictions)
        text = (
            f"These recordings cannot separate {_named(pair, problem)}. Nor would any of {count} simulated recordings."
        )
        result.append(f"{text} {pair.hint}".rstrip())
    return result


def _most_telling(clear: Sequence[Prediction]) -> list[Prediction]:
    """Predictions for the recording that separates most pairs; among equals, the clearest."""
    by_recording: dict[str, list[Prediction]] = {}
    for each in clear:
        by_recording.setdefault(each.choice.arguments + each.choice.words, []).append(each)
    return max(by_recording.values(), key=lambda own: (len(own), min(each.times for each in own)), default=[])


def _sentence(told: Sequence[Prediction], problem: Problem) -> str:
    choice = told[0].choice
    task = shlex.quote(problem.task)
    unit = units_for("mrad", [problem.joint_types[j] for each in told for j in each.pair.joints])
    pairs = ", nor ".join(_named(each.pair, problem) for each in told)
    apart = _range([1e3 * each.apart for each in told], "{:.2g}")
    times = _range([each.times for each in told], "{:.0f}")
    return (
        f"These recordings cannot separate {pairs}. {choice.words} would: the predicted motions differ by {apart} "
        f"{unit}, {times} times the noise. {command('data_collection')} --task {task} {choice.arguments} "
        "--command_only --export_command next.csv"
    )


def _range(values: Sequence[float], form: str) -> str:
    low, high = form.format(min(values)), form.format(max(values))
    return low if low == high else f"{low} to {high}"


def menu(problem: Problem, joint: int, cfg: MenuCfg) -> Iterator[Choice]:
    """Every motion as the robot was, with a larger proportional gain, and with more load on a joint.

    Drives that follow speeds get speeds.
    """
    like, told = _like(problem), _told(problem)
    conditions = [("", "", like), *_other_gain(like, cfg), *_other_load(problem, like, joint, cfg)]
    by_speed = tuple(np.array(problem.joint_names)[told == "speed"].tolist())
    pattern = ".*" if bool((told == "speed").all()) else "|".join(map(re.escape, by_speed))
    also = f" --velocity_joints {shlex.quote(pattern)}" if by_speed else ""
    for motion in _MOTIONS:
        trajectory = make_excitation(
            motion, problem.env_cfg.sim2real, control_dt=problem.control_dt, duration=cfg.duration
        )[0]
        if by_speed and trajectory.has_jumps:
            continue
        trajectory = replace(trajectory, by_speed=by_speed)
        target, speeds = trajectory.des_dof_pos, trajectory.told_vel
        for words, arguments, facts in conditions:
            yield Choice(
                words=f"Another recording ({motion}, {cfg.duration:g} s{words})",
                arguments=f"--excitation {motion} --duration {cfg.duration:g}{also}{arguments}",
                recording=replace(
                    trajectory.draft(facts.drive, facts.load),
                    name=motion,
                    command=np.where(told == "position", target, target[:1]),
                    command_vel=None if speeds is None else np.nan_to_num(speeds),
                ),
            )


def distances(
    problem: Problem, pairs: Sequence[Rivals], recordings: Sequence[Sequence[Recording]]
) -> list[torch.Tensor]:
    """RMS difference of two models' predictions on each recording, over the joints of the pair, (R,) [rad] each.

    Args:
        pairs: Pairs of models; a model of several pairs is simulated once on the same recordings.
        recordings: What each pair is simulated on.
    """
    of_pairs = [[(model, id(own)) for model in pair.models] for pair, own in zip(pairs, recordings, strict=True)]
    items = list(dict.fromkeys(item for pair in of_pairs for item in pair))
    datasets = {id(own): make_dataset(own, train_fraction=1) for own in recordings}
    found = parallel_map(lambda some: [_predicted(problem, model, datasets[own]) for model, own in some], items)
    errors = dict(zip(items, found, strict=True))
    return [
        (errors[one] - errors[other])[..., pair.joints].square().mean(dim=(0, 2)).sqrt()
        for pair, (one, other) in zip(pairs, of_pairs, strict=True)
    ]


def _predicted(problem: Problem, model: RobotModel, data: Dataset) -> torch.Tensor:
    """A model's motion on recordings, less what is written there, (K, R, n) [rad]."""
    own = replace(problem.with_effects(model.effects), dataset=data)
    return own.evaluator().residuals(own.space.from_dict(model.values)[None], data.sampled).error[0]


def _like(problem: Problem) -> Recording:
    """A recording whose drives and loads the next one has too."""
    return problem.dataset.recordings[problem.dataset.trained()[0]]


def _told(problem: Problem) -> np.ndarray:
    """What each drive follows, (n,): ``position``, ``speed``, or ``torque`` where it has no gains or nothing else."""
    like = _like(problem)
    drive = in_force(configured_drive(problem.env_cfg, problem.joint_names), like)
    kp, kd = np.asarray(drive.stiffness), np.asarray(drive.damping)
    position, speed = like.has_position_command & (kp != 0), like.has_position_command | like.has_velocity_command
    return np.select([position, speed & (kd != 0)], ["position", "speed"], "torque")


def _other_gain(like: Recording, cfg: MenuCfg) -> Iterator[tuple[str, str, Recording]]:
    """The proportional gain, of a velocity drive the derivative one."""
    for name, word in (("stiffness", "proportional"), ("damping", "derivative")):
        gain = getattr(like.drive, name)
        if gain is None or not np.any(gain):
            continue
        same = bool(np.ptp(gain) < 1e-9)
        arguments = f" --{name} {cfg.factor * gain[0]:g}" if same else ""
        drive = replace(like.drive, **{name: cfg.factor * gain})
        yield f", {cfg.factor:g} times the {word} gain", arguments, replace(like, drive=drive)
        return


def _other_load(problem: Problem, like: Recording, joint: int, cfg: MenuCfg) -> Iterator[tuple[str, str, Recording]]:
    if like.load.load_mass is not None:
        mass = round(cfg.factor * like.load.load_mass, 2)
        yield f", {mass:g} kg on the arm", f" --load_mass {mass:g}", _loaded(like, load_mass=mass)
        return
    env = problem.make_env(1)
    model = env.sim.model
    moved = env.scene["robot"].driven.joints[joint]
    body = model.body(int(model.jnt_bodyid[model.joint(moved).id]))
    mass = max(1, round(10 * (cfg.factor - 1) * float(body.mass[0]))) / 10
    env.close()
    added = {**like.load.added_mass, body.name: like.load.added_mass.get(body.name, 0.0) + mass}
    yield (
        f", {mass:g} kg fixed to {body.name}",
        f" --added_mass {shlex.quote(body.name)}={mass:g}",
        _loaded(like, added_mass=added),
    )


def _loaded(like: Recording, **changes: object) -> Recording:
    return replace(like, load=replace(like.load, **changes))  # type: ignore[arg-type]


def _named(pair: Rivals, problem: Problem) -> str:
    names = ", ".join(problem.joint_names[j] for j in pair.joints)
    return f"{pair.names[0]} from {pair.names[1]} ({names})"
