"""The method: each joint alone, from its base model to what is missing (docs/diagnosis.md)."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch

from pace_actuators.effects import Effect, EffectCfg
from pace_optim.diagnosis.candidates.screening import absorbed_effects
from pace_optim.diagnosis.checks.data_check import check_data
from pace_optim.diagnosis.checks.shared_delay import hold_late_joints
from pace_optim.diagnosis.checks.stated_facts import excluded_effects, unlogged_effects
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg
from pace_optim.diagnosis.findings.findings import Findings
from pace_optim.diagnosis.search.one_round import try_effects
from pace_optim.diagnosis.search.pooling import pool
from pace_optim.diagnosis.search.search import add_effects
from pace_optim.diagnosis.search.state import Outcome, Search
from pace_optim.diagnosis.selection.decisions import Log, unlogged
from pace_optim.diagnosis.verdict.free_curves import Curves, fit_curves, take_curves
from pace_optim.diagnosis.verdict.names import beside_curves, earned_names, new_effects, shares_of
from pace_optim.diagnosis.verdict.verdict import part_explained, verdict
from pace_optim.joints.fits.base_fit import fit_base
from pace_optim.joints.fits.block_errors import check_long_enough
from pace_optim.joints.fits.fits import Fits, fits_on
from pace_optim.joints.fits.reference_update import ReferenceUpdate
from pace_optim.problem.problem import Problem
from pace_optim.run.result import FitResult


@contextmanager
def _flushed_denormals() -> Iterator[None]:
    """Take denormal numbers for zeros meanwhile, in this thread and in processes forked from it.

    States that decay to nothing make them, and they are slow. The processor's setting is put back at the end: it
    belongs to the whole program, NumPy's and Python's numbers too.
    """
    before = sys.float_info.min / 2 == 0.0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


@_flushed_denormals()
def search_effects(
    problem: Problem,
    physical: torch.Tensor,
    candidates: Sequence[type[Effect]],
    max_effects: int,
    say: Callable[[str], None] = lambda _: None,
    run: FitResult | None = None,
    *,
    own: Sequence[EffectCfg] = (),
    measured: Sequence[str] = (),
    log: Log = unlogged,
    cfg: DiagnosisCfg = DEFAULT,
    fits: Fits | None = None,
) -> Findings:
    """Look for missing effects, each joint simulated alone.

    Args:
        problem: The whole robot with the base model.
        physical: A first guess of its base parameters, (size,).
        candidates: What is tried.
        max_effects: Most effects of a joint.
        say: Shows how far it is.
        run: The whole robot's own fit, if there is one.
        own: Effects of the run, with its values: the search begins with them.
        measured: Facts that the user measured, of ``MEASURED_FACTS``.
        log: Gets every decision.
        cfg: By what numbers it is decided.
        fits: Fits models; ``None``: on the processor.

    Raises:
        ValueError: If the validation recordings are too short to judge by.
    """
    fits = fits or fits_on("cpu", cfg.fitting)
    carried = problem.dataset.carried
    free = None if carried is None else carried.free
    check_long_enough(problem.dataset.validation, problem.control_dt, free=free, cfg=cfg.fitting)

    # the base model of each joint, and what these recordings can show beside it
    twins, base, effort = fit_base(fits, problem, physical, candidates, say, own)
    data = check_data(fits, problem, twins, base, run, cfg=cfg.judging)
    base, late = hold_late_joints(fits, twins, base, cfg=cfg)
    coarse = twins.with_physics_dt(twins.coarsest_dt)
    absorbed = absorbed_effects(fits, coarse, base, candidates, effort, cfg.candidates)
    n, recordings = base.model.num_joints, problem.dataset.recordings
    excluded, why = excluded_effects(recordings, candidates, measured, n)
    barred = excluded | unlogged_effects(problem.dataset, candidates)
    base = replace(base, model=replace(base.model, barred=barred))

    # one effect after another, as long as they pay on held-out recordings
    enough = cfg.judging.alike * data.floor
    reference = ReferenceUpdate(fits=fits, problem=problem, candidates=candidates, enough=enough, say=say)
    search = Search(
        effects=candidates,
        effort=effort,
        floor=data.floor,
        max_effects=max_effects,
        fits=fits,
        try_effects=try_effects,
        cfg=cfg,
        own=frozenset(base.model.effects),
        begun=[effect for effect in candidates if effect.needs_loads and data.loads > 1],
        trees=[[problem.joint_names.index(name) for name in tree] for tree in problem.trees],
        follow=reference.follow,
        say=say,
        log=log,
    )
    outcome = add_effects(search, twins, base)

    # which of them have earned their names; where none has, a curve
    say("leaving out each effect in turn")
    names = earned_names(fits, outcome, data.floor, log)
    without = pool(fits, names.outcome, data.floor, log)
    curves = fit_curves(fits, without, data.floor, names.named, say, log)

    def findings(outcome: Outcome, named: torch.Tensor, curves: Curves | None = None) -> Findings:
        decision, outcome = verdict(outcome, data.floor, named)
        shares = shares_of(names, outcome)
        kept = new_effects(outcome, outcome.final.model)
        pairs = [(outcome.final.model.effects[row], j) for row, j in kept.nonzero().tolist() if decision == "effect"]
        return Findings(
            outcome=outcome,
            joint_names=problem.joint_names,
            data=replace(data, sentences=[*data.sentences, *late, *why]),
            absorbed={effect: joints for effect, joints in absorbed.items() if effect not in shares},
            verdict=decision,
            explained=part_explained(outcome, data.floor),
            shares=shares,
            named={each: names.evidence[each] for each in pairs},
            hints=[*names.hints, *([] if curves is None else beside_curves(without, names, curves.instead))],
            curves=curves,
        )

    found = findings(take_curves(without, curves), names.named, curves)
    if not names.hints or problem.joints_stand_alone:
        return found
    hinted = torch.tensor([any(hint.joint == j for hint in names.hints) for j in range(n)])
    return replace(found, on_trial=replace(findings(without, names.named | hinted), hints=()))
