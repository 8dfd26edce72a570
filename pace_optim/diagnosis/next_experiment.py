"""Which further recording would tell effects apart: the rivals are simulated on a menu of motions, gains and loads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from pace_actuators.effects import Effect
from pace_optim.dataset import make_dataset
from pace_optim.diagnosis.descent import Fitted
from pace_optim.diagnosis.model import whole_values
from pace_optim.diagnosis.search import Outcome
from pace_optim.diagnosis.verdict import labels
from pace_optim.excitation import make_excitation
from pace_optim.problem import Problem
from pace_optim.recording import Recording

_MOTIONS = ("chirp", "multisine", "ramp", "steps")
_DURATION = 10.0
_GAIN = 1.5
_LOAD = 1.5
_CLEAR = 3.0
"""Predictions that part by fewer times the noise than this are not told apart."""


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
class Rivals:
    """Two effects that do equally well on some joints."""

    chosen: type[Effect]
    rival: type[Effect]
    models: tuple[Fitted, Fitted]
    """With either effect, fitted."""
    joints: list[int]


def next_experiments(problem: Problem, outcome: Outcome, noise: torch.Tensor) -> list[str]:
    """For each pair of effects that the recordings cannot tell apart, the recording that would, as a sentence.

    Args:
        problem: The whole robot with the base model.
        outcome: What the search found.
        noise: Of each joint, (n,) [rad].
    """
    pairs = rivals_of(outcome)
    if not pairs or problem.env_cfg.sim2real.excitation is None:
        return [f"{_alike(pair, problem)} {_hint(pair)}".rstrip() for pair in pairs]
    result = []
    for pair in pairs:
        choices = list(menu(problem, pair.joints[0]))
        apart = distances(problem, pair, [choice.recording for choice in choices])
        best = int(apart.argmax())
        times = float(apart[best] / noise[pair.joints].mean())
        if times < _CLEAR:
            result.append(
                f"{_alike(pair, problem)} Nor would any of {len(choices)} others tried. {_hint(pair)}".rstrip()
            )
            continue
        choice = choices[best]
        result.append(
            f"{_alike(pair, problem)} {choice.words} would tell them apart: they predict motions that differ by "
            f"{1e3 * float(apart[best]):.2g} mrad, {times:.0f} times the noise. scripts/data_collection.py --task "
            f"{problem.task} {choice.arguments} --command_only --export_command next.csv"
        )
    return result


def rivals_of(outcome: Outcome) -> list[Rivals]:
    """Pairs of a chosen effect and one that does as well, with the joints where that is so."""
    result = []
    for this in outcome.rounds:
        found: dict[tuple[type[Effect], type[Effect]], list[int]] = {}
        for j, (chosen, rivals) in enumerate(zip(this.chosen, this.rivals, strict=True)):
            for rival in rivals:
                if chosen is not None:
                    found.setdefault((chosen, rival), []).append(j)
        result += [
            Rivals(chosen=a, rival=b, models=(this.models[a], this.models[b]), joints=joints)
            for (a, b), joints in found.items()
        ]
    return result


def menu(problem: Problem, joint: int) -> Iterator[Choice]:
    """Every motion as the robot was, with a larger proportional gain, and with more load on a joint."""
    like = problem.dataset.recordings[problem.dataset.trained()[0]]
    conditions = [("", "", like), *_other_gain(like), *_other_load(problem, like, joint)]
    for motion in _MOTIONS:
        trajectory = make_excitation(
            motion, problem.env_cfg.sim2real, control_dt=problem.control_dt, duration=_DURATION
        )[0]
        target = trajectory.des_dof_pos
        for words, arguments, facts in conditions:
            yield Choice(
                words=f"A {motion} of {_DURATION:g} s{words}",
                arguments=f"--excitation {motion} --duration {_DURATION:g}{arguments}",
                recording=Recording(
                    name=motion,
                    joint_names=problem.joint_names,
                    time=trajectory.time,
                    dof_pos=np.repeat(target[:1], len(target), axis=0),
                    des_dof_pos=target,
                    command=target,
                    drive=facts.drive,
                    load=facts.load,
                ),
            )


def distances(problem: Problem, pair: Rivals, recordings: Sequence[Recording]) -> torch.Tensor:
    """RMS difference of two models' predictions on each recording, over the joints of the pair, (R,) [rad]."""
    data = make_dataset(recordings, train_fraction=1)
    errors = []
    for fitted in pair.models:
        own = replace(problem.with_effects(labels(fitted.model, problem.joint_names)), dataset=data)
        values = own.space.from_dict(whole_values(fitted.model, fitted.x, problem.joint_names))
        errors.append(own.evaluator().residuals(values[None], data.sampled).error[0][..., pair.joints])
    return (errors[0] - errors[1]).square().mean(dim=(0, 2)).sqrt()


def _other_gain(like: Recording) -> Iterator[tuple[str, str, Recording]]:
    stiffness = like.drive.stiffness
    if stiffness is None:
        return
    words = f" with {_GAIN:g} times the proportional gain"
    same = bool(np.ptp(stiffness) < 1e-9)
    arguments = f" --stiffness {_GAIN * stiffness[0]:g}" if same else ""
    yield words, arguments, replace(like, drive=replace(like.drive, stiffness=_GAIN * stiffness))


def _other_load(problem: Problem, like: Recording, joint: int) -> Iterator[tuple[str, str, Recording]]:
    if like.load.load_mass is not None:
        mass = round(_LOAD * like.load.load_mass, 2)
        yield f" with {mass:g} kg on the arm", f" --load_mass {mass:g}", _loaded(like, load_mass=mass)
        return
    env = problem.make_env(1)
    model = env.sim.model
    body = model.body(int(model.jnt_bodyid[model.joint(problem.joint_names[joint]).id]))
    mass = max(0.1, round((_LOAD - 1) * float(body.mass[0]), 1))
    env.close()
    added = {**like.load.added_mass, body.name: like.load.added_mass.get(body.name, 0.0) + mass}
    yield (
        f" with {mass:g} kg fixed to {body.name}",
        f" --added_mass {body.name}={mass:g}",
        _loaded(like, added_mass=added),
    )


def _loaded(like: Recording, **changes: object) -> Recording:
    return replace(like, load=replace(like.load, **changes))  # type: ignore[arg-type]


def _alike(pair: Rivals, problem: Problem) -> str:
    names = ", ".join(problem.joint_names[j] for j in pair.joints)
    return f"These recordings cannot tell {pair.chosen.name} from {pair.rival.name} ({names})."


def _hint(pair: Rivals) -> str:
    separates = pair.chosen.separates or pair.rival.separates
    return f"What would tell them apart: {separates}." if separates else ""
