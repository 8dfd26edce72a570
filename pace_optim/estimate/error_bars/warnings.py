"""What a user must know before trusting a result."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch

from pace_actuators.drive_result import ALL
from pace_actuators.effects import get_effect
from pace_actuators.joint_units import JointType, units_for
from pace_actuators.text import conjoined, spoken
from pace_envs.link_inertia import NAMES
from pace_envs.tasks.pace import GLOBAL
from pace_optim.estimate.error_bars.far_from_noise import FAR_ABOVE_NOISE, times_noise
from pace_optim.estimate.error_bars.physics_step import step_error
from pace_optim.estimate.error_bars.uncertainty import Uncertainty
from pace_optim.estimate.least_squares import ROUGH
from pace_optim.problem.problem import Problem

_BY_EFFECT = (1, 19, 3, 2, 4, 5, 17, 18, 8, 7, 6, 9, 10, 11, 12, 13, 15)
"""Codes of warnings: first those of a result that is wrong, then of single values, last of a loss of accuracy."""
_OVERFIT_RATIO = 1.5
_NAMED = 3
"""Joints that a sentence names, at most."""
_SHOWN_BY = {
    "armature": "accelerate it hard, as in a fast chirp",
    "viscous_friction": "move it fast over long strokes",
    "friction": "reverse it slowly and often",
    "encoder_bias": "let gravity load it differently, in several postures (a vertical axis never shows its bias)",
    "delay": "send steps or a fast chirp",
}
"""The motion that shows a parameter."""
_OTHERWISE = "move it further, faster or with another load"
_NOTHING = 1e-6
"""Errors below this are negligible [rad]."""
_OF_THE_STEP = (0.3, 5.0)
"""The physics step matters where halving it changes the motion by so much of the error that is left; where by more, the
recording comes from a simulation with this very step."""


def fit_warnings(
    problem: Problem,
    physical: torch.Tensor,
    uncertainty: Uncertainty,
    rmse: dict[str, dict[str, float]],
    left_open: Sequence[str] = (),
    unsure: Sequence[str] = (),
) -> list[str]:
    """Plain sentences, one for each kind; none if all is well.

    Args:
        rmse: Errors as in ``result.json``.
        left_open: Labels of parameters that the recordings do not determine, at their prior.
        unsure: Labels of those that are not determined either, but fit worse there.
    """
    change = _change_at_half_the_step(problem, physical, rmse)
    return [
        *problem.contradictions,
        *problem.measured.warnings,
        *_overfit(rmse, change, problem.joint_types),
        *_sampled_commands(problem, physical, rmse, uncertainty),
        *_critical_delays(problem, physical),
        *_at_bounds(problem, physical, rmse, uncertainty),
        *_undetermined(problem, physical, left_open),
        *_unsure(unsure),
        *_alike(uncertainty.indistinguishable),
        *_coarse_step(problem, rmse, change),
    ]


def by_effect(warnings: Iterable[str]) -> list[str]:
    """Warnings in the order of their effect on the result, each once."""

    def place(warning: str) -> int:
        return next((i for i, code in enumerate(_BY_EFFECT) if f"[W{code}]" in warning), len(_BY_EFFECT))

    return sorted(dict.fromkeys(warnings), key=place)


def _undetermined(problem: Problem, physical: torch.Tensor, labels: Sequence[str]) -> list[str]:
    """What the recordings leave open, what its value is, and a motion that shows it."""
    if not labels:
        return []
    values = {label: _with_unit(problem, label, float(physical[problem.space.labels.index(label)])) for label in labels}
    kept = {value: [label for label in labels if values[label] == value] for value in values.values()}
    return [
        f"These recordings do not show {'; '.join(f'{_named(own)} (kept at {value})' for value, own in kept.items())}. "
        f"Exports omit it. To identify it, {_motions(labels)}. [W10]"
    ]


def _unsure(labels: Sequence[str]) -> list[str]:
    """The same for those whose error bar leaves open what the error does not, with this physics step."""
    if not labels:
        return []
    return [
        f"These recordings barely show {_named(labels)}: the error bar is as large as the value, its bounds or its "
        f"prior. The best value is kept. To identify it, {_motions(labels)}. [W11]"
    ]


def _with_unit(problem: Problem, label: str, value: float) -> str:
    """A value as "0.01 kg m^2", the delay in ms."""
    name, key = label.split("/", 1)
    if name == "delay":
        return f"{1e3 * problem.control_dt * value:.3g} ms"
    return f"{value:.3g} {problem.space.unit_of(name, key)}".removesuffix(" 1")


def _motions(labels: Iterable[str]) -> str:
    """The motions that show parameters: "reverse slowly and often; send steps or a fast chirp"."""
    return "; ".join(dict.fromkeys(_SHOWN_BY.get(label.split("/")[0], _OTHERWISE) for label in labels))


def _named(labels: Sequence[str]) -> str:
    """Parameters with their joints and links, in words."""
    of_joints = [label for label in labels if label.split("/")[0] not in NAMES]
    named = [f"{spoken(name)}{_of(keys)}" for name, keys in _by_parameter(of_joints).items()]
    return "; ".join([*named, *_of_links(labels)])


def _of_links(labels: Sequence[str]) -> list[str]:
    """The inertial parameters of each link among labels, in words."""
    found: dict[str, list[str]] = {}
    for label in labels:
        name, link = label.split("/", 1)
        if name in NAMES:
            found.setdefault(link, []).append(name.removeprefix("link_").replace("_", " "))
    return [f"{conjoined(names)} of the link {link}" for link, names in found.items()]


def _alike(groups: Sequence[tuple[str, ...]]) -> list[str]:
    """Confounded parameters, with the joints."""
    kinds: dict[tuple[str, ...], list[str]] = {}
    for group in (own for own in groups if not any(set(own) < set(other) for other in groups)):
        keys = {label.split("/", 1)[1] for label in group} - {GLOBAL}
        kind = tuple(label.split("/")[0] for label in group) if len(keys) == 1 else group
        kinds.setdefault(kind, []).extend(sorted(keys) if len(keys) == 1 else [])
    found = [
        conjoined([spoken(name) for name in kind]) + _of(keys) if keys else in_words(kind)
        for kind, keys in kinds.items()
    ]
    if not found:
        return []
    return [f"These recordings cannot separate {'; '.join(found)}. Move these joints more, or in other poses. [W12]"]


def _by_parameter(labels: Sequence[str]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for label in labels:
        name, key = label.split("/", 1)
        found.setdefault(name, []).append(key)
    return found


def _of(keys: Sequence[str]) -> str:
    """On which joints: all of them where they are few, else some and how many."""
    if list(keys) == [GLOBAL]:
        return ""
    if len(keys) <= _NAMED:
        return f" of {conjoined(keys)}"
    return f" of {len(keys)} joints ({', '.join(keys[:_NAMED])}, …)"


def _overfit(rmse: dict[str, dict[str, float]], change: float, joint_types: Sequence[JointType]) -> list[str]:
    """Whether the error on other data is larger than the fit and the physics step (its change [rad]) make it."""
    train, validation = rmse["train"].get(ALL), rmse["validation"].get(ALL)
    if not train or not validation or validation < _NOTHING:
        return []
    of_the_step = change if change <= _OF_THE_STEP[1] * validation else 0.0
    if validation <= math.hypot(_OVERFIT_RATIO * train, of_the_step):
        return []
    unit = units_for("mrad", joint_types)
    return [
        f"The validation error ({1e3 * validation:.3g} {unit}) is {validation / train:.1f} times the training error "
        f"({1e3 * train:.3g} {unit}): the fit does not carry over. Use more recordings, at other gains and speeds. [W6]"
    ]


def _is_far(problem: Problem, rmse: dict[str, dict[str, float]]) -> bool:
    """Whether the fit ended far above the noise [W1]."""
    return (times_noise(problem, rmse["train"].get(ALL)) or 0.0) >= FAR_ABOVE_NOISE


def _sampled_commands(
    problem: Problem, physical: torch.Tensor, rmse: dict[str, dict[str, float]], uncertainty: Uncertainty
) -> list[str]:
    """Whether the drives seem to have got commands more often than they were logged.

    What is logged with slow samples is then early by half of the time between two commands on average: no delay that
    is 0 or more makes up for it, and the motion has none of the steps that held commands make.
    """
    slowest = max(r.sample_stride if r.des_time is None else 1 for r in problem.dataset.recordings)
    of_delay = problem.space["delay"]
    low, high, delay = (float(each[of_delay]) for each in (problem.space.lower, problem.space.upper, physical))
    at_bound = f"delay/{GLOBAL}" in uncertainty.at_bound and low == 0 and delay < high / 2
    if slowest == 1 or not at_bound or not _is_far(problem, rmse):
        return []
    return [
        f"Commands are logged with the samples, every {1e3 * slowest * problem.control_dt:g} ms, and held in between. "
        "Even with a delay of 0 they come too late. The drive probably received more commands than were logged: log "
        "every command, with its instant (des_time). [W7]"
    ]


def rough_motion(noise: float, score: float) -> list[str]:
    """Whether the simulation's own noise [rad] is a notable part of the error (score [rad²])."""
    if noise < max(ROUGH * score**0.5, _NOTHING):
        return []
    return [
        "Contacts or sticking make the simulation rough: a tiny change of a parameter changes the motion by "
        f"{100 * noise / score**0.5:.0f} % of the error. Derivatives use larger steps; error bars are less accurate. "
        "[W14]"
    ]


def _change_at_half_the_step(problem: Problem, physical: torch.Tensor, rmse: dict[str, dict[str, float]]) -> float:
    """RMS change of the motion when the physics step is halved [rad], where errors are judged."""
    data = problem.dataset
    where = data.validation if rmse["validation"].get(ALL) else data.train
    return float(step_error(problem, physical, where).square().mean().sqrt())


def _coarse_step(problem: Problem, rmse: dict[str, dict[str, float]], change: float) -> list[str]:
    """Whether a part of the error may come from the physics step (its change [rad])."""
    left = rmse["validation"].get(ALL) or rmse["train"].get(ALL)
    least, most = _OF_THE_STEP
    if not left or not least * left <= change <= most * left:
        return []
    unit = units_for("mrad", problem.joint_types)
    return [
        f"Halving the physics step of {1e3 * problem.physics_dt:g} ms changes the motion by {1e3 * change:.3g} {unit}; "
        f"the error is {1e3 * left:.3g} {unit}. Part of it may come from the step. Fit with "
        f"--physics_dt {problem.physics_dt / 2:.12g}. [W13]"
    ]


def _at_bounds(
    problem: Problem, physical: torch.Tensor, rmse: dict[str, dict[str, float]], uncertainty: Uncertainty
) -> list[str]:
    """Parameters with the side, the bound and the joints."""
    space = problem.space
    low, high, values = space.lower.tolist(), space.upper.tolist(), physical.tolist()
    places: dict[tuple[str, str, float], list[str]] = {}
    open_above: dict[tuple[str, str, float], list[str]] = {}
    for label in uncertainty.at_bound:
        i = space.labels.index(label)
        name, key = label.split("/", 1)
        side, bound = ("lower", low[i]) if values[i] - low[i] < high[i] - values[i] else ("upper", high[i])
        found = open_above if side == "upper" and _has_no_effect_above(name) else places
        found.setdefault((name, side, bound), []).append(key)
    or_widen = "" if _is_far(problem, rmse) else ", or widen the bound"
    lists = ["; ".join(_in_words(problem, own)) for own in (places, open_above)]
    cures = (
        f"Find the missing physics that the value stands in for{or_widen}.",
        "The motion stays below. So the value is at least the bound, and not identifiable above it.",
    )
    heads = ("At a bound", "Not reached")
    return [f"{head}: {own}. {cure} [W9]" for head, own, cure in zip(heads, lists, cures, strict=True) if own]


def _in_words(problem: Problem, places: dict[tuple[str, str, float], list[str]]) -> list[str]:
    return [
        f"{spoken(name)} ({side}, {_bound(problem, name, bound, keys[0])}){_of(keys)}"
        for (name, side, bound), keys in places.items()
    ]


def _has_no_effect_above(name: str) -> bool:
    """Whether a parameter is a limit, or the like: the larger, the less it does."""
    effect, _, own = name.partition(".")
    parameters = get_effect(effect).parameters if own else ()
    return any(each.name == own and each.null == math.inf for each in parameters)


def _bound(problem: Problem, name: str, bound: float, key: str) -> str:
    """A bound with its unit; of the delay in ms."""
    if (name, key) == ("delay", GLOBAL):
        return f"{1e3 * problem.control_dt * bound:g} ms"
    return f"{bound:g} {problem.space.unit_of(name, key)}"


def in_words(labels: tuple[str, ...]) -> str:
    """Say labels: "encoder bias and friction of LF_HFE" for those of one joint, else one by one."""
    names = [spoken(label.split("/")[0]) for label in labels]
    keys = {label.split("/", 1)[1] for label in labels} - {ALL}
    if len(keys) == 1:
        return f"{conjoined(names)} of {keys.pop()}"
    return conjoined([f"{name} of {label.split('/', 1)[1]}" for name, label in zip(names, labels, strict=True)])


def critical_delay(inertia: float, viscous_friction: float, stiffness: float, damping: float) -> float:
    """The delay of the whole torque at which a PD loop starts to oscillate [s].

    The characteristic equation I s² + d s + (P + D s) e^(-sT) = 0 has a root on the imaginary axis, s = iω, where
    |P + iDω| = |Iω² - idω|; then T = (arg(P + iDω) - arg(Iω² - idω)) / ω.

    Args:
        inertia: I, armature and load [kg m²].
        viscous_friction: d [N m s/rad].
        stiffness: P [N m/rad].
        damping: D [N m s/rad].

    Returns:
        T; infinite if no delay makes it oscillate.
    """
    # I²w² + (d² - D²) w - P² = 0 with w = ω²
    a, b, c = inertia**2, viscous_friction**2 - damping**2, -(stiffness**2)
    if stiffness <= 0 or a <= 0:
        return math.inf
    omega = math.sqrt((-b + math.sqrt(b * b - 4 * a * c)) / (2 * a))
    phase = math.atan2(damping * omega, stiffness) - math.atan2(-viscous_friction * omega, inertia * omega**2)
    return phase % (2 * math.pi) / omega


def _critical_delays(problem: Problem, physical: torch.Tensor) -> list[str]:
    """Only a delay of the whole torque lies inside the loop, whose gains and load are each recording's own."""
    if problem.delay_mode != "effort":
        return []
    rollout, space = problem.evaluator().rollout(1), problem.space
    rollout.start(physical[None])
    robot, sim = rollout.robot, rollout.env.sim
    sim.forward()
    delay_s = float(physical[space["delay"]]) * problem.control_dt
    viscous = physical[space["viscous_friction"]].tolist()
    shortest: dict[str, float] = {}
    for r in range(problem.dataset.num_recordings):
        if robot.driven.are_coupled:  # of the motors, where the recording begins
            felt, armature = sim.felt_link(robot.dof_columns)[0], sim.expand("dof_armature")[:, robot.dof_columns]
            inertia = (felt + armature)[r].tolist()
        else:
            inertia = torch.as_tensor(sim.model_of(r).dof_M0)[robot.dof_columns].tolist()
        for actuator in robot.actuators.values():
            for column, name in enumerate(actuator.joint_names):
                j = robot.joint_names.index(name)
                kp, kd = float(actuator.stiffness[r, column]), float(actuator.damping[r, column])
                limit = critical_delay(inertia[j], viscous[j], kp, kd)
                shortest[name] = min(limit, shortest.get(name, math.inf))
    rollout.env.close()
    beyond = [f"{name} ({1e3 * limit:.1f} ms)" for name, limit in shortest.items() if delay_s > limit]
    if not beyond:
        return []
    return [
        f"The delay of {1e3 * delay_s:.1f} ms is beyond the critical delay of the control loop of "
        f"{conjoined(beyond)}: the simulation oscillates by itself. Lower the delay's bound, or use "
        "--delay_mode command. [W8]"
    ]
