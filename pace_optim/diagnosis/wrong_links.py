"""Which link of the model file is wrong, and what is wrong with it: mass, centre of mass, inertia, or a load it lacks.

A robot's torque is linear in the pseudo-inertias of its links (:mod:`pace_envs.link_inertia`). So one set of
derivatives along the measured motion covers all links: those of the whole robot's residuals r by the base parameters
and by the ten parameters of each link. Look-alikes have theirs too: a torque gain, a spring and an offset of each
joint. With H = JᵀJ and g = Jᵀr of the base parameters and of what is tried, a part of a link would lower the score by

    Δ = gᵀ H⁻¹ g - (the same of the base parameters alone)

A load at the place p of a link is one direction of its ten, [p, 1] [p, 1]ᵀ, and p is sought for the largest Δ.

Parts that would explain most of the error, and more than any look-alike on a single joint, are fitted to the whole
robot. Links are named if they lead near the noise on samples that were not fitted. A look-alike that leaves as little
is reported instead.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from pace_actuators.drive_result import LinkInertia
from pace_actuators.effects import effect_cfgs, get_effect
from pace_actuators.text import conjoined, plural
from pace_envs.link_inertia import NAMES, OF_BODY, PARTS, TEN, UNITS, Reference
from pace_envs.tasks.pace import sought_links
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg, LinksCfg
from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.error_bars.far_from_noise import noise_score
from pace_optim.estimate.error_bars.uncertainty import SURE, inverse_of
from pace_optim.estimate.least_squares import Descent, LeastSquaresCfg, least_squares
from pace_optim.problem.problem import Problem

LOOK_ALIKES = ("torque_gain", "proportional_gain", "gravity_compensation", "parallel_spring", "torque_offset")
"""Effects on one joint that look like a wrong link."""
_CHOICES = (("mass",), ("com",), ("mass", "com"), OF_BODY)
"""What may be wrong with a link, the fewest parameters first; and it may carry a load."""


@dataclass(frozen=True, kw_only=True)
class WrongLink:
    """A link whose inertial parameters the model file states wrongly."""

    link: str
    parts: tuple[str, ...]
    """Which of mass, com and inertia; or load, which the file lacks."""
    values: list[dict[str, Any]]
    """Of each of its parameters ``parameter``, ``unit``, ``file``, ``found`` and ``std``."""

    @property
    def label(self) -> str:
        """As ``fit.py --links`` takes it."""
        return f"{re.escape(self.link)}@{','.join(self.parts)}"

    @property
    def sentence(self) -> str:
        """What is wrong, in words."""
        if self.parts == ("load",):
            bars = (f"± {each['std']:.1g}" if math.isfinite(each["std"]) else "(not shown)" for each in self.values)
            mass, *place = (f"{each['found']:.4g} {bar}" for each, bar in zip(self.values, bars, strict=True))
            return f"The link {self.link} carries {mass} kg that the model file lacks, at ({', '.join(place)}) m."
        shown = [each for each in self.values if abs(each["found"] - each["file"]) > SURE * each["std"]] or self.values
        said = [
            f"{each['parameter'].removeprefix('link_').replace('_', ' ')} {each['found']:.4g} ± {each['std']:.1g} "
            f"{each['unit']} instead of {each['file']:.4g}"
            for each in shown
        ]
        what = {"mass": "mass", "com": "centre of mass", "inertia": "inertia"}
        return f"The model file is wrong about the link {self.link} ({', '.join(what[p] for p in self.parts)}): " + (
            f"{', '.join(said)}."
        )


@dataclass(frozen=True, kw_only=True)
class LinkFindings:
    """What the search for wrong links found."""

    wrong: list[WrongLink] = field(default_factory=list)
    links: Mapping[str, LinkInertia] = field(default_factory=dict)
    """Their inertial parameters."""
    values: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """All parameters of the whole robot, fitted beside them."""
    before: float = 0.0
    """RMSE of all joints on what was not fitted, by the file [rad]."""
    after: float = 0.0
    """The same with what was found [rad]."""
    sentences: list[str] = field(default_factory=list)
    """What was noticed beside that."""


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A problem and its best parameters."""

    problem: Problem
    x: torch.Tensor
    rmse: float
    """On samples that were not fitted [rad]."""


def find_wrong_links(
    problem: Problem,
    physical: torch.Tensor,
    say: Callable[[str], None] = lambda _: None,
    *,
    cfg: DiagnosisCfg = DEFAULT,
) -> LinkFindings:
    """Look for links whose inertial parameters the model file states wrongly.

    Args:
        problem: The whole robot, no link sought.
        physical: Its parameters as they were fitted, (size,).
        say: Shows how far it is.
        cfg: By what numbers it is decided.
    """
    own, alike = cfg.links, cfg.judging.alike
    noise = (noise_score(problem) / len(problem.joint_names)) ** 0.5
    base = _Fitted(problem, problem.space.to_normalised(physical), _held_out(problem, physical))
    if not noise > 0 or base.rmse < alike * noise:
        return LinkFindings()
    now, found, joint_of = base, tuple[Reference, ...](), None
    while len(found) < own.most and now.rmse > alike * noise:
        beside = f" beside {', '.join(each.link for each in found)}" if found else ""
        say(f"looking for wrong masses in the model file{beside}")
        screened = _screened(now, found, cfg)
        joint_of = screened.joint_of if joint_of is None else joint_of
        best = _best_addition(now, found, screened, noise, say, cfg)
        if best is None or best.rmse**2 > (1 - own.explains) * now.rmse**2 + own.explains * noise**2:
            break
        now, found = _fit(best.problem, _values_of(best), own, whole=True), best.problem.env_cfg.sim2real.links
    for each in found[:-1]:  # it was chosen beside errors that later ones explain
        say(f"choosing again beside the others: {each.link}")
        others = tuple(other for other in found if other != each)
        without = _fit(base.problem.seeking(others), _values_of(now), own)
        best = _best_addition(without, others, _screened(without, others, cfg), noise, say, cfg)
        if best is not None and best.problem.env_cfg.sim2real.links[-1].link != each.link:
            again = _fit(best.problem, _values_of(best), own, whole=True)
            if again.rmse <= own.same * now.rmse:
                now, found = again, best.problem.env_cfg.sim2real.links
    if not found:
        return LinkFindings()
    part = (base.rmse**2 - now.rmse**2) / max(base.rmse**2 - noise**2, 1e-300)
    if now.rmse > cfg.judging.far * noise or part < cfg.verdict.most:
        return LinkFindings()
    joint_of, left = joint_of or {}, max(now.rmse, noise)
    likes = _look_alikes(base, {effect: [joint] for effect, joint in joint_of.items()}, left, say, own)
    better = likes
    if left > alike * noise:  # more is missing: an effect on every joint may be what the links stand for
        better = likes | _look_alikes(base, dict.fromkeys(joint_of, problem.joint_names), left, say, own)
    if any(rmse * alike < left for rmse in better.values()):
        return LinkFindings()
    if likes := {name: rmse for name, rmse in likes.items() if rmse <= alike * left}:
        names = ", ".join(reference.link for reference in found)
        return LinkFindings(
            sentences=[
                f"Wrong inertial parameters of {names} explain the error too. These recordings cannot separate them "
                f"from {' or '.join(likes)}. Record once with a known added mass (added_mass in the recording)."
            ]
        )
    return _told(base, now, found)


def _told(base: _Fitted, now: _Fitted, found: Sequence[Reference]) -> LinkFindings:
    """What was found, with error bars."""
    problem, space = now.problem, now.problem.space
    values = space.to_dict(space.to_physical(now.x))
    known = assess(problem, problem.evaluator(), now.x)
    std = space.to_dict(torch.as_tensor(known.uncertainty.std))
    wrong = [
        WrongLink(
            link=each.link,
            parts=tuple(part for part, names in PARTS.items() if set(names) <= set(each.names)),
            values=[
                {
                    "parameter": name,
                    "unit": UNITS[name],
                    "file": each.values[NAMES.index(name)],
                    "found": values[name][each.link],
                    "std": std[name][each.link],
                }
                for name in each.names
            ],
        )
        for each in found
    ]
    links = {each.link: each.inertia({name: values[name][each.link] for name in each.names}) for each in found}
    return LinkFindings(wrong=wrong, links=links, values=values, before=base.rmse, after=now.rmse)


def _best_addition(
    now: _Fitted,
    found: tuple[Reference, ...],
    screened: _Screened,
    noise: float,
    say: Callable[[str], None],
    cfg: DiagnosisCfg,
) -> _Fitted | None:
    """The model with one more wrong link that leaves least; of those alike, the one with the fewest parameters.

    A load on the axis of a joint is the same on both sides of it: of those that leave the same, the outermost.
    """
    problem, fitted, alike = now.problem, list[tuple[int, _Fitted]](), cfg.judging.alike
    for addition in sorted(screened.links, key=lambda each: len(each.names)):
        if any(size < len(addition.names) and each.rmse <= alike * noise for size, each in fitted):
            break
        sought = (*(each for each in found if each.link != addition.link), addition)
        names = [f"{each.link} ({plural(len(each.names), 'parameter')})" for each in sought]
        say(f"trying other masses of {', '.join(names)}")
        values = _values_of(now) | screened.loads.get(addition.link, {})
        fitted.append((len(addition.names), _fit(problem.seeking(sought), values, cfg.links)))
    if not fitted:
        return None
    least = max(min(each.rmse for _, each in fitted), noise)
    near = [(size, each.rmse, each) for size, each in fitted if each.rmse <= alike * least]
    if not near:
        return None
    size, rmse, _ = min(near, key=lambda each: each[:2])
    same = [each for own, other, each in near if own == size and other <= cfg.links.same * rmse]
    return max(same, key=lambda each: screened.order.index(each.problem.env_cfg.sim2real.links[-1].link))


@dataclass(frozen=True, eq=False)
class _Screened:
    """What one look says of all links, and of effects on single joints."""

    links: list[Reference]
    """With what may be wrong about each, the most promising first."""
    order: tuple[str, ...]
    """All links, the outermost last."""
    loads: dict[str, dict[str, dict[str, float]]]
    """Where the load of a link is sought first, as values of parameters."""
    joint_of: dict[str, str]
    """The joint on which each look-alike would explain most, of those that would explain as much as a link must."""


def _screened(now: _Fitted, found: tuple[Reference, ...], cfg: DiagnosisCfg) -> _Screened:
    """Links that would explain most of the error, and more than any effect on a single joint does."""
    problem = now.problem
    env = problem.make_env(1)
    every = sought_links(env.sim.model, problem.joint_names, [".*"])
    body = {each.link: int(env.sim.model.body_weldid[env.sim.model.body(each.link).id]) for each in every}
    env.close()
    # what is found stays as the file has it: its parameters begin where the last round left them
    every = tuple(next((each for each in found if each.link == one.link), one) for one in every)
    had = {each.effect_class.name for each in effect_cfgs(problem.env_cfg.sim2real.effects)}
    likes = {effect: get_effect(effect).parameters for effect in LOOK_ALIKES if effect not in had}
    sizes = {effect: next(p for p in own if p.null is not None) for effect, own in likes.items()}
    whole = problem.seeking(tuple(replace(each, names=tuple(dict.fromkeys([*TEN, *each.names]))) for each in every))
    whole = whole.with_effects([*problem.effects, *likes])
    none = {f"{effect}.{p.name}": dict.fromkeys(problem.joint_names, p.null or 0.0) for effect, p in sizes.items()}
    x = _values_in(whole, {**_values_of(now), **none})
    hessian, gradient, left = _look(whole, x, cfg.links)
    place = {label: i for i, label in enumerate(whole.space.labels)}
    tried = {*NAMES, *(f"{effect}.{p.name}" for effect, own in likes.items() for p in own)}
    own = [i for label, i in place.items() if label.split("/")[0] not in tried]
    own += [place[f"{name}/{each.link}"] for each in found for name in each.names]
    score = _score_of(gradient, hessian, own)

    def gain(labels: Sequence[str]) -> float:
        """How much more the score falls with these parameters."""
        return _score_of(gradient, hessian, [*own, *(place[label] for label in labels)]) - score

    on_joints: dict[str, dict[str, float]] = {}
    for effect, p in sizes.items():
        labels = {joint: f"{effect}.{p.name}/{joint}" for joint in problem.joint_names}
        on_joints[effect] = {joint: gain([label]) for joint, label in labels.items() if label in place}
    least = cfg.links.explains * (left - score - noise_score(whole))
    single = max((each for gains in on_joints.values() for each in gains.values()), default=0.0)
    promising: list[tuple[float, Reference]] = []
    loads: dict[str, dict[str, dict[str, float]]] = {}

    is_fitted = left < cfg.judging.alike**2 * noise_score(whole)  # what is left where it was not fitted is no link's

    def consider(explained: float, each: Reference) -> None:
        if explained > max(least, single) and not is_fitted:
            promising.append((explained / len(each.names) ** cfg.links.cost, each))

    for each in every:
        if any(each.link == known.link for known in found):
            continue
        for parts in _CHOICES:
            names = tuple(name for part in PARTS if part in parts for name in PARTS[part])
            consider(gain([f"{name}/{each.link}" for name in names]), replace(each, names=names))
        if not any(body[each.link] == body[link] for link in loads):  # bodies that are welded carry it together
            at = [place[f"{name}/{each.link}"] for name in TEN]
            explained, values = _best_load(
                each, *_beside(hessian, gradient, own, at), whole.space.slope(x)[at], cfg=cfg.links
            )
            loads[each.link] = {name: {each.link: value} for name, value in zip(PARTS["load"], values, strict=True)}
            consider(explained, replace(each, names=PARTS["load"]))
    links = listed_candidates(promising, cfg.links)
    order = tuple(each.link for each in every)
    alike = {effect: max(gains, key=gains.__getitem__) for effect, gains in on_joints.items() if gains}
    joint_of = {effect: joint for effect, joint in alike.items() if on_joints[effect][joint] > least}
    return _Screened(links, order, loads, joint_of)


def listed_candidates(promising: Sequence[tuple[float, Reference]], cfg: LinksCfg) -> list[Reference]:
    """What is fitted in a round, the most promising first: several parts of one link, and other links beside it."""
    links: list[Reference] = []
    for _, each in sorted(promising, key=lambda each: -each[0]):
        if len(links) < cfg.tried and sum(each.link == other.link for other in links) < cfg.of_link:
            links.append(each)
    return links


def _look(problem: Problem, x: torch.Tensor, cfg: LinksCfg) -> tuple[torch.Tensor, torch.Tensor, float]:
    """H, g and the score [rad²] at a normalised vector, on pieces."""
    descent = Descent(x=x)
    hessian, gradient, _ = descent.look(problem.on_pieces(cfg.share).training_evaluator())
    return hessian, gradient, descent.score


def _score_of(gradient: torch.Tensor, hessian: torch.Tensor, entries: Sequence[int]) -> float:
    """How much the score falls where these entries are free, gᵀ H⁻¹ g."""
    at = torch.tensor([i for i in entries if float(hessian[i, i]) > 0])
    g = gradient[at].numpy()
    return float(g @ inverse_of(hessian[at[:, None], at].numpy())[0] @ g)


def _beside(
    hessian: torch.Tensor, gradient: torch.Tensor, known: Sequence[int], entries: Sequence[int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """H and g of some entries where the known ones follow, H_ee - H_ek H_kk⁻¹ H_ke and g_e - H_ek H_kk⁻¹ g_k."""
    at, own = torch.tensor(entries), torch.tensor([i for i in known if float(hessian[i, i]) > 0])
    follow = hessian[at[:, None], own] @ torch.as_tensor(inverse_of(hessian[own[:, None], own].numpy())[0])
    return hessian[at[:, None], at] - follow @ hessian[own[:, None], at], gradient[at] - follow @ gradient[own]


def _best_load(
    reference: Reference, hessian: torch.Tensor, gradient: torch.Tensor, slope: torch.Tensor, *, cfg: LinksCfg
) -> tuple[float, list[float]]:
    """The load on a link that would lower the score most: by how much, and its mass [kg] and place (3,) [m].

    A load m at p adds m u uᵀ, u = [p, 1], to the pseudo-inertia J, which moves the ten parameters θ by m d, with d of
    (∂J/∂θ) d = u uᵀ. To first order it lowers the score by (gᵀd)² / dᵀHd at the best mass m = -gᵀd / dᵀHd.

    Args:
        reference: The link.
        hessian: H of its ten parameters, normalised, (10, 10).
        gradient: g of these, (10,).
        slope: ∂ physical / ∂ normalised of these, (10,).
        cfg: How finely places are tried.
    """
    file = torch.tensor(reference.values, dtype=torch.float64)
    changes = torch.func.jacrev(reference.pseudo_inertia)(file)
    rows, columns = torch.triu_indices(*changes.shape[:2])
    of_ten = changes[rows, columns, : len(TEN)]
    turn = torch.linalg.inv(of_ten) / slope[:, None]
    low, high = (torch.tensor(each) for each in zip(*map(reference.bounds, PARTS["load"][1:]), strict=True))

    def tried(at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """By how much loads at places (…, 3) lower the score, and their masses."""
        at = torch.cat([at, torch.ones_like(at[..., :1])], dim=-1)
        d = (at[..., rows] * at[..., columns]) @ turn.T
        slopes, curvatures = d @ gradient, ((d @ hessian) * d).sum(dim=-1).clamp(min=1e-300)
        return torch.where(slopes < 0, slopes.square() / curvatures, 0.0), -slopes / curvatures

    def grid(steps: torch.Tensor) -> torch.Tensor:
        return torch.cartesian_prod(steps, steps, steps)

    fine = torch.linspace(-1.0, 1.0, cfg.places, dtype=torch.float64)
    wide, near_by = (low + high) / 2 + (high - low) / 2 * grid(fine), grid(torch.tensor([-1.0, 0.0, 1.0]).double())
    of_all = torch.linalg.lstsq(hessian @ turn, -gradient[:, None], driver="gelsd").solution[:, 0]
    first = of_all[(columns == columns.max()) & (rows != rows.max())] / of_all[-1]
    best = wide[tried(wide)[0].topk(cfg.load_starts).indices]
    best = torch.cat([best, first.nan_to_num().clamp(low, high)[None]])
    reach = ((high - low) / (cfg.places - 1)).expand_as(best)
    while float(reach.max()) > cfg.load_place:
        near = (best[:, None] + reach[:, None] * near_by).clamp(low, high)
        falls = tried(near)[0]
        fall, at = falls.max(dim=1)
        moves = (fall > (1 + 1e-9) * falls[:, len(near_by) // 2])[:, None]  # rounding alone would go on for ever
        best = torch.where(moves, near[torch.arange(len(best)), at], best)
        reach = torch.where(moves, reach, reach / 2)
    falls, masses = tried(best)
    k = int(falls.argmax())
    return float(falls[k]), [float(masses[k]), *best[k].tolist()]


def _look_alikes(
    base: _Fitted, joints_of: Mapping[str, Sequence[str]], left: float, say: Callable[[str], None], cfg: LinksCfg
) -> dict[str, float]:
    """The error with each effect on some joints, {effect on joints: RMSE [rad]}.

    An effect of a size that no drive has is not like a link. A fit far above what links leave ends early.

    Args:
        left: The error with links [rad].
    """
    found, values = dict[str, float](), _values_of(base)
    for effect, joints in joints_of.items():
        say(f"fitting {effect} on {plural(len(joints), 'joint')} in place of the links")
        there = "|".join(map(re.escape, joints))
        problem = base.problem.with_effects([*base.problem.effects, f"{effect}@{there}"])
        fitted = _fit(problem, values, cfg, left=left)
        sizes = _values_of(fitted)
        own = [(p, sizes[f"{effect}.{p.name}"][joint]) for p in get_effect(effect).parameters for joint in joints]
        if all(p.is_plausible(size) for p, size in own):
            found[f"{effect} on {conjoined(joints)}"] = fitted.rmse
    return found


def _fit(
    problem: Problem,
    values: Mapping[str, Mapping[str, float]],
    cfg: LinksCfg,
    *,
    whole: bool = False,
    left: float | None = None,
) -> _Fitted:
    """The problem fitted from near, on pieces, or on all that is trained on.

    Args:
        left: The error of a rival [rad]. The fit ends where it gains little and is far above; ``None``: of the noise.
    """
    near = LeastSquaresCfg(
        max_iteration=cfg.iterations, score_tolerance=cfg.tolerance, noise_score=noise_score(problem)
    )
    if left is not None:
        near.noise_score = left**2 * len(problem.joint_names)
        near.loosest_tolerance = near.loosest_enough = cfg.explains
    stage = problem if whole else problem.on_pieces(cfg.share)
    start = _values_in(problem, values)
    x = least_squares(stage.training_evaluator(), [start], near)[0].x
    return _Fitted(problem, x, _held_out(problem, problem.space.to_physical(x)))


def _values_in(problem: Problem, values: Mapping[str, Mapping[str, float]]) -> torch.Tensor:
    """Known values in the vector of a problem that may have more parameters, which are where they start, normalised."""
    space = problem.space
    physical = space.to_physical(space.start)
    for parameter in space.parameters:
        for i, key in enumerate(parameter.keys, start=space[parameter.name].start):
            if key in values.get(parameter.name, {}):
                physical[i] = values[parameter.name][key]
    return space.to_normalised(physical).clamp(-1.0, 1.0)


def _values_of(fitted: _Fitted) -> dict[str, dict[str, float]]:
    space = fitted.problem.space
    return space.to_dict(space.to_physical(fitted.x))


def _held_out(problem: Problem, physical: torch.Tensor) -> float:
    """RMSE of all joints on samples that are not trained on [rad]."""
    residuals = problem.evaluator().residuals(physical[None], problem.dataset.validation)
    return float(residuals.joint_score[0].mean() ** 0.5)
