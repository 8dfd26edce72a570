"""Do several recordings agree? Each is fitted alone; where they disagree, misreported gains are tried."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from pace_actuators.text import capitalised, plural
from pace_envs import ManagerBasedEnv
from pace_envs.tasks.pace import GLOBAL, Parameter
from pace_optim.estimate.derivatives import Jacobian, stencil
from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.error_bars.far_from_noise import noise_score
from pace_optim.estimate.error_bars.uncertainty import Uncertainty
from pace_optim.estimate.least_squares import Descent, LeastSquaresCfg, least_squares
from pace_optim.problem.drive_facts import configured_drive, in_force
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.problem.problem import Problem

DISAGREEMENT = 4.0
"""Recordings disagree on a parameter that differs by this many standard deviations of the difference."""
_SHOWN = 2
"""Joints of which a sentence gives the values."""
_SMALLEST_PART = 0.01
"""Differences below this part of the bound range are not worth a sentence."""
_GAINS = {"stiffness": "recording_stiffness", "damping": "recording_damping"}
"""The drive's fields, and what a relative error of one is called among the parameters."""
_GAIN_RANGE = 0.6
_GAIN_SMALLEST = 0.05
_GAIN_PAYS = 1.1
_REFINE = LeastSquaresCfg(max_iteration=12, score_tolerance=1e-4)
"""From the joint result: what is left after that is some tenths of a standard deviation."""


@dataclass(frozen=True, kw_only=True)
class Consistency:
    """What fitting each recording alone says."""

    recordings: tuple[str, ...] = ()
    """Names of the recordings."""
    values: dict[str, list[float]] = field(default_factory=dict)
    """Physical value of each parameter by recording, {label: [per recording]}."""
    std: dict[str, list[float | None]] = field(default_factory=dict)
    """Standard deviations, shaped as ``values``; ``None`` at a bound or without influence."""
    simulated_steps: int = 0
    """What the comparison cost."""
    sentences: tuple[str, ...] = ()
    """What disagrees, in words; empty when all recordings agree."""


def check_consistency(
    problem: Problem,
    x: torch.Tensor,
    score: float,
    report: Callable[[str], None] = lambda text: None,
    there: Jacobian | None = None,
) -> Consistency:
    """Fit each training recording alone, from the joint result, and compare beyond the error bars.

    Args:
        score: Its score [rad²].
        there: Residuals and derivatives at x on the training samples; ``None``: they are simulated.
    """
    trained = problem.dataset.trained()
    problem = replace(problem, dataset=problem.dataset.select(trained))
    if len(trained) < 2 or any(recording.part_of for recording in problem.dataset.recordings):
        return Consistency()
    fits = []
    for r in range(len(trained)):
        report(f"fitting {problem.dataset.recordings[r].name} alone")
        alone = replace(problem, dataset=problem.dataset.select([r]))
        fits.append(_fit_from(alone, x, None if there is None else _of_recording(there, r)))
    names = tuple(recording.name for recording in problem.dataset.recordings)
    values = torch.stack([problem.space.to_physical(fit.x) for fit in fits]).numpy()
    std = np.stack([fit.uncertainty.std for fit in fits])
    sentences = _disagreements(problem.space, names, values, std)
    steps = 0
    if sentences:
        report("trying misreported gains")
        gains, steps = _misreported_gains(problem, x, score)
        sentences = [*gains, *sentences]
    labels = problem.space.labels
    return Consistency(
        recordings=names,
        values={label: values[:, i].tolist() for i, label in enumerate(labels)},
        std={label: [None if np.isnan(v) else float(v) for v in std[:, i]] for i, label in enumerate(labels)},
        simulated_steps=steps + sum(fit.simulated_steps for fit in fits),
        sentences=tuple(sentences),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    """A refinement with its error bars."""

    score: float
    x: torch.Tensor
    uncertainty: Uncertainty
    simulated_steps: int


def _fit_from(problem: Problem, x: torch.Tensor, there: Jacobian | None = None) -> _Fit:
    """Least squares from x, where the derivatives may be known."""
    evaluator = problem.training_evaluator()
    start = Descent(x=x.clamp(-1.0, 1.0).clone())
    if there is not None:
        start.jacobian, (start.hessian, start.gradient) = there, there.normal_equations()
        start.scores = [float(there.residuals.score[0])]
    cfg = replace(_REFINE, noise_score=noise_score(problem))
    best = least_squares(evaluator, [start], cfg)[0]
    known = assess(problem, evaluator, best.x, ended=best, training=evaluator)
    score = float(known.jacobian.residuals.score[0])
    return _Fit(score=score, x=known.x, uncertainty=known.uncertainty, simulated_steps=evaluator.simulated_steps)


def _of_recording(there: Jacobian, r: int) -> Jacobian:
    """Residuals and derivatives of one of the recordings."""
    whole = there.residuals
    at, columns = whole.where[:, r], whole.columns_of(r)
    error, where = whole.error[:, at][:, :, columns], whole.where[at][:, columns]
    own = replace(whole, error=error, where=where, step=whole.step[at], weight=None)
    return replace(there, residuals=own, columns=there.columns[:, at][:, :, columns])


def _disagreements(space: ParameterSpace, names: tuple[str, ...], values: np.ndarray, std: np.ndarray) -> list[str]:
    """Parameters that differ in one recording from the others."""
    width = (space.upper - space.lower).numpy()
    found: dict[tuple[str, str, str], list[str]] = {}
    for i, label in enumerate(space.labels):
        odd = _odd_one_out(values[:, i], std[:, i], _SMALLEST_PART * float(width[i]))
        if odd is not None:
            r, mean, error = odd
            name, key = label.split("/", 1)
            text = f"{values[r, i]:.4g} ± {std[r, i]:.1g} against {mean:.4g} ± {error:.1g}"
            found.setdefault((name, space.unit_of(name, key), names[r]), []).append(
                text if key == GLOBAL else f"{key} {text}"
            )
    most = sorted(found.items(), key=lambda each: -len(each[1]))
    parts = [
        f"{capitalised(name.replace('_', ' '))} [{unit}] differs between {recording} and the others: "
        f"{'; '.join(places[:_SHOWN])}{_more(len(places) - _SHOWN)}."
        for (name, unit, recording), places in most[:_SHOWN]
    ]
    if len(most) > _SHOWN:
        parts.append(f"So do {plural(len(most) - _SHOWN, 'more parameter')} (consistency.json).")
    return [f"{' '.join(parts)} [W17]"] if parts else []


def _more(joints: int) -> str:
    """How many joints are not shown."""
    return "" if joints < 1 else f"; and {plural(joints, 'more joint')}"


def _odd_one_out(values: np.ndarray, std: np.ndarray, smallest: float) -> tuple[int, float, float] | None:
    """The recording whose value is furthest from the others', if that is beyond the error bars.

    Args:
        values: One per recording, (R,).
        std: Their standard deviations, (R,); NaN if unknown.
        smallest: Differences below this do not count.

    Returns:
        The recording, and mean and standard deviation of the others; ``None`` if all agree.
    """
    known = np.flatnonzero(~np.isnan(std))
    furthest, result = DISAGREEMENT, None
    for r in known.tolist() if len(known) > 1 else []:
        others = known[known != r]
        weight = 1 / np.maximum(std[others], 1e-12) ** 2
        mean, error = float((weight * values[others]).sum() / weight.sum()), float(weight.sum() ** -0.5)
        distance = abs(values[r] - mean) / float(np.hypot(std[r], error) + 1e-12)
        if abs(values[r] - mean) > smallest and distance > furthest:
            furthest, result = distance, (r, mean, error)
    return result


def _misreported_gains(problem: Problem, x: torch.Tensor, score: float) -> tuple[list[str], int]:
    """The recording whose gains, were they other than stated, would explain most; none if that does not pay.

    Returns:
        Sentences, and the simulated steps that it took.
    """
    r, left, steps = _most_promising(problem, x)
    if score < _GAIN_PAYS**2 * left:
        return [], steps
    wrong, start = _with_gains(problem, x, [r])
    fit = _fit_from(wrong, start)
    steps += fit.simulated_steps
    if score < _GAIN_PAYS**2 * fit.score:
        return [], steps
    space, physical = wrong.space, wrong.space.to_physical(fit.x)
    found = {
        gain: (float(physical[space[name]]), float(fit.uncertainty.std[space[name]][0]))
        for gain, name in _GAINS.items()
    }
    name = problem.dataset.recordings[r].name
    sentences = []
    for field_name, (value, error) in found.items():
        if abs(value) > _GAIN_SMALLEST and abs(value) > DISAGREEMENT * error:  # false where error is NaN: at its bound
            nominal = float(np.mean(_nominal_gain(problem, r, field_name).numpy()))
            direction = "higher" if value > 0 else "lower"
            sentences.append(
                f"{name} behaves as if its {field_name} were {abs(value):.0%} {direction} than stated "
                f"({nominal * (1 + value):.3g} instead of {nominal:.3g}, ± {abs(nominal) * error:.1g}): check the "
                f"{field_name} that was in force. [W18]"
            )
    return sentences, steps


def _nominal_gain(problem: Problem, r: int, field_name: str) -> torch.Tensor:
    """The gain of every joint as the recording, or else the configuration, states it, (n,)."""
    configured = configured_drive(problem.env_cfg, problem.joint_names)
    return torch.tensor(np.nan_to_num(getattr(in_force(configured, problem.dataset.recordings[r]), field_name)))


def _most_promising(problem: Problem, x: torch.Tensor) -> tuple[int, float, int]:
    """The recording of which other gains would explain most, by the derivatives at x.

    With J the derivatives of the residuals r by all parameters and by one recording's gains, a Gauss–Newton step would
    lower the score by rᵀJ (JᵀJ)⁻¹ Jᵀr. The gains of all recordings are perturbed at once, as each moves its own only.

    Returns:
        Its index, the score that the step would leave [rad²], and the simulated steps that it took.
    """
    problem, x = _with_gains(problem, x, range(problem.dataset.num_recordings))
    evaluator = problem.training_evaluator()
    around = stencil(x, evaluator.colouring)
    there = around.jacobian(evaluator.residuals(problem.space.to_physical(torch.cat([x[None], around.vectors]))))
    gains = {problem.space.slices[name].start for name in _GAINS.values()}
    rows = sorted({evaluator.colouring.row_of[entry] for entry in gains})
    falls = []
    for r in range(problem.dataset.num_recordings):
        columns = there.columns.clone()
        columns[rows] = 0.0
        columns[rows, :, r] = there.columns[rows, :, r]
        hessian, gradient = replace(there, columns=columns).normal_equations()
        falls.append(float(gradient @ torch.linalg.pinv(hessian, hermitian=True) @ gradient))
    best = int(np.argmax(falls))
    return best, float(there.residuals.score[0]) - falls[best], evaluator.simulated_steps


def _with_gains(problem: Problem, x: torch.Tensor, which: Sequence[int]) -> tuple[Problem, torch.Tensor]:
    """The problem with relative errors of some recordings' gains, common to all joints, and x with none yet."""
    extra = [_gain_parameter(problem, which, name) for name in _GAINS]
    space = ParameterSpace((*problem.space.parameters, *extra))
    return replace(problem, space=space), torch.cat([x, torch.zeros(len(extra), dtype=torch.float64)])


def _gain_parameter(problem: Problem, which: Sequence[int], field_name: str) -> Parameter:
    """A relative error of a gain in some recordings."""
    nominal, count = {r: _nominal_gain(problem, r, field_name) for r in which}, problem.dataset.num_recordings

    def apply(env: ManagerBasedEnv, values: torch.Tensor) -> None:
        for actuator in env.scene["robot"].actuators.values():
            for r, gain in nominal.items():
                rows = slice(r, None, count)
                getattr(actuator, field_name)[rows] = gain[actuator.joint_indices] * (1 + values[rows])

    return Parameter(
        name=_GAINS[field_name], unit="1", lower=(-_GAIN_RANGE,), upper=(_GAIN_RANGE,), apply=apply, keys=(GLOBAL,)
    )
