"""Searches of a diagnosis in worlds where a table says how well each set of effects explains each joint."""

from types import SimpleNamespace

import torch
from diagnoses import FakeFits, errors_of, make_trial

from pace_actuators.effects import get_effect
from pace_optim.diagnosis.diagnosis_cfg import DiagnosisCfg
from pace_optim.diagnosis.search.search import add_effects
from pace_optim.diagnosis.search.state import Search
from pace_optim.diagnosis.selection.candidate_results import Round
from pace_optim.diagnosis.selection.decisions import unlogged
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import BASE, JointModel

ELASTICITY, MOUNT, GAIN, SPRING, PAYLOAD = (
    get_effect(name) for name in ("joint_elasticity", "mount_compliance", "torque_gain", "parallel_spring", "payload")
)
FLOOR = 1e-4


class World:
    """Joints whose RMSE [mrad] follows from the effects that the model gives them, or all joints."""

    def __init__(self, *joints):
        self.joints, self.rounds, self.everyone = joints, 0, []

    def rmse(self, joint, effects):
        table = self.joints[joint](self.everyone) if callable(self.joints[joint]) else self.joints[joint]
        return 1e-3 * table.get(frozenset(effects), 40.0 / (1 + len(effects)))

    def effects_of(self, now):
        model = now.model
        return [[e for e, has in zip(model.effects, model.has, strict=True) if has[j]] for j in range(model.num_joints)]

    def errors(self, problem, models):
        """Of whole models, or of some joints beside what the others have."""
        result = []
        for now in models:
            own, joints = self.effects_of(now), getattr(problem, "joints", None)
            if joints is None:
                self.everyone = own
            rmse = [self.rmse(j, effects) for j, effects in zip(joints or range(len(own)), own, strict=True)]
            result.append(errors_of(*rmse, roll=int(now.model.has.sum()) if joints is None else 2))
        return result

    def try_effects(self, search, branch, rough):
        self.rounds += 1
        problem, now, errors, effects = branch.problem, branch.now, branch.errors, search.effects
        joints = getattr(problem, "joints", range(len(self.joints)))
        trials, models = [], {}
        for effect in effects:
            values = torch.zeros(now.model.num_joints, len(effect.parameters)).double()
            model, physical = now.model.extended(
                now.model.to_physical(now.x), effect, now.model.allowed_joints(effect), values
            )
            models[effect] = Fitted.start(model, physical, tried=effect)
        for j, has in enumerate(self.effects_of(now)):
            before = float(errors.mse[j].sqrt())
            own = [e for e in effects if now.model.allowed_joints(e)[j]]
            after = {e: self.rmse(joints[j], [*has, e]) for e in own}
            order = sorted(own, key=after.get)
            trials.append([make_trial(e, j, after[e], 1.2 * after[e] < before) for e in order])
        chosen = [next((t.effect for t in each if t.significant), None) for each in trials]
        return Round(trials=trials, chosen=chosen, rivals=[[] for _ in trials], models=models)


def stays(problem, now):
    return problem, now


def moves(problem, now):
    return SimpleNamespace(on_joints=some), now


class InWorld(FakeFits):
    """Fits that stay where they start, with errors of a world."""

    def validation_errors(self, problem, models):
        return self.errors(problem, models)


def base_model(n=1):
    """The base model of joints that are not simulated."""
    bounds = torch.ones(n, len(BASE)).double()
    return JointModel(
        effects=(),
        has=torch.zeros(0, n, dtype=torch.bool),
        lower=-bounds,
        upper=bounds,
        log=torch.zeros(len(BASE), dtype=torch.bool),
        slides=torch.zeros(n, dtype=torch.bool),
        ranges=torch.zeros(n, 2),
        efforts=torch.full((n,), torch.inf),
        loops=torch.full((n,), 85.0),
    )


def some(joints):
    """The problem of some joints."""
    return SimpleNamespace(joints=joints.nonzero()[:, 0].tolist())


def searched(*joints, follow=stays, say=lambda _: None, log=unlogged, trees=()):
    """Where a search ends, and in which world."""
    world, n = World(*joints), len(joints)
    fits = InWorld(world.errors)
    cfg = DiagnosisCfg(off=("replace", "trim", "wide_steps"))
    model = base_model(n)
    floor = torch.full((n,), FLOOR, dtype=torch.float64)
    base, candidates = (
        Fitted.start(model, 0 * model.upper),
        [ELASTICITY, MOUNT, GAIN, SPRING, *([PAYLOAD] if trees else [])],
    )
    problem = SimpleNamespace(on_joints=some)
    problem.in_windows = lambda: problem
    search = Search(
        effects=candidates,
        effort=5 * floor,
        floor=floor,
        max_effects=3,
        fits=fits,
        cfg=cfg,
        trees=trees,
        follow=follow,
        say=say,
        log=log,
        try_effects=world.try_effects,
    )
    outcome = add_effects(search, problem, base)
    assert torch.equal(outcome.final_errors.mse, world.errors(SimpleNamespace(), [outcome.final])[0].mse)
    return outcome, world


def found(*joints, follow=stays, trees=()):
    """The effects of each joint where a search ends, and how many rounds it tried."""
    outcome, world = searched(*joints, follow=follow, trees=trees)
    return [{e.name for e in effects} for effects in world.effects_of(outcome.final)], world.rounds


def mrad(table):
    return {frozenset(effects): rmse for effects, rmse in table.items()}


STANDS_IN = mrad(
    {
        (MOUNT,): 7.5,
        (ELASTICITY,): 18.0,
        (GAIN,): 39.0,
        (SPRING,): 20.0,
        (MOUNT, GAIN): 6.0,
        (ELASTICITY, GAIN): 0.1,
        (ELASTICITY, SPRING): 15.0,
    }
)
