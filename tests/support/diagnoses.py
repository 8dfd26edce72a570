"""Synthetic diagnoses, and parts of them."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from problems import BENCH, CALM, DT, chirp, env_cfg, make_problem, physical, replayed
from run_folders import JOINTS, make_result

from pace_actuators.effects import Effect, get_effect
from pace_actuators.files import write_json
from pace_envs import set_physics_dt
from pace_optim.data_collection.plant import PlantCfg, draw_visible, make_suite, plant_robot
from pace_optim.diagnosis.diagnosis_cfg import DiagnosisCfg
from pace_optim.diagnosis.search.one_round import try_effects
from pace_optim.diagnosis.search.state import Outcome, Search
from pace_optim.diagnosis.selection.candidate_results import Trial
from pace_optim.diagnosis.selection.naming import Evidence
from pace_optim.joints.fits.block_errors import BlockErrors
from pace_optim.joints.fits.fits import Fits, fits_on
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import BASE
from pace_optim.joints.simulation import reference_path, twin_problem
from pace_optim.problem.problem import load_problem
from pace_optim.recording import save_recording

FITS = fits_on("cpu", DiagnosisCfg().fitting)
"""As a diagnosis has them: compiled, where there is a compiler."""


def make_diagnosis(verdict: str = "effect") -> dict[str, Any]:
    """A plausible ``diagnosis.json`` of the folder that ``write_run`` makes."""
    known = verdict == "effect"

    def entry(effect: str, after: float, **changes: Any) -> dict[str, Any]:
        return {
            "effect": effect,
            "round": 1,
            "added": False,
            "joints": list(JOINTS),
            "validation_rmse_before": 4.3e-3,
            "validation_rmse_after": after,
            "significant": False,
            "evidence": f"On recordings not used for fitting the error falls from 4.3 to {1e3 * after:.3g} mrad.",
            "confounded_with": [],
            "screen_score": 0.5,
            "values": {},
            "tried": {joint: [4.3e-3, after] for joint in JOINTS},
            "status": "does not pay",
        } | changes

    rivals = ["stribeck_friction", "presliding_friction"]
    states = [{"significant": known, "status": status} for status in ("added", "as good")]
    ranking = [
        entry(rivals[0], 4e-4, added=known, confounded_with=rivals[1:], **states[0]),
        entry(rivals[1], 4.2e-4, confounded_with=rivals[:1], **states[1]),
        entry("quadratic_friction", 3.9e-3, joints=["knee"]),
    ]
    explained = {"torque_over_position": 0.2, "friction_over_position": 0.8, "torque_over_time": -0.1}
    curve = {"at": [-0.4, -0.2, 0.0, 0.2, 0.4], "torque": [-0.2, 0.1, 0.0, -0.1, 0.2]}
    carried = {
        "explained": explained,
        "best": "friction_over_position",
        "best_label": "position [rad]",
        "kind": "friction",
        "validation_rmse_before": 4.3e-3,
        "validation_rmse_after": 2e-3,
        "sentence": "a curve of friction over position explains 80 % of it.",
        "curve": curve,
    }
    return {
        "version": 1,
        "run": "logs/pace/leg/26_01_01_00-00-00",
        "verdict": verdict,
        "summary": "Missing: stribeck_friction." if known else "The validation error is 4.3 mrad, the floor 0.1 mrad.",
        "added": ["stribeck_friction"] if known else [],
        "ranking": ranking if verdict != "nothing_missing" else [],
        "joints": {
            name: {
                "validation_rmse_before": 4.3e-3,
                "validation_rmse_after": 4.3e-3 if verdict == "unknown" else 4e-4,
                "floor": 2e-4,
                "effects": ["stribeck_friction"] if known else [],
            }
            for name in JOINTS
        },
        "data": ["Measurement noise: 0.1 mrad."],
        "advice": [
            "These recordings cannot separate stribeck_friction from presliding_friction. Record: "
            "scripts/data_collection.py --task Pace-Leg-v0 --excitation ramp"
        ],
        "runs": ["logs/pace/leg/26_01_01_00-00-00"],
        "tried": ["stribeck_friction", "presliding_friction", "quadratic_friction", "torque_gain"],
        "physics_dt": 0.00125,
        "ladder": [{"model": "base model", "validation_rmse": 4.3e-3}]
        + [{"model": "stribeck_friction", "validation_rmse": 4e-4}] * known,
        "error_map": dict.fromkeys(JOINTS if verdict == "unknown" else (), carried),
        "wall_time_s": 12.0,
    }


def make_evidence(without: float, left: float, floor: float) -> Evidence:
    """Of an effect alone on its joint whose size is sure; squared errors."""
    sure = {"harm": 0.0, "larger": 0.0, "slight": False, "bars": 50.0, "uneven": 0.0}
    return Evidence(without=without, left=left, floor=floor, at_bound=False, implausible=False, **sure)


def make_trial(effect: type[Effect], joint: int, after: float, significant: bool = True) -> Trial:
    """An effect that was tried on a joint, with its RMSE after [rad]."""
    return Trial(
        effect=effect,
        joint=joint,
        screen_score=0.5,
        mse_before=1e-6,
        mse_after=after**2,
        ratio=1e-3 / after,
        t=4.0,
        significant=significant,
        values={},
    )


def outcome_of(before, after, effects=(), has=None, rounds=()):
    """Where a search could have ended: RMSE of each joint before and after."""

    def errors(rmse):
        return BlockErrors(square=torch.tensor([rmse]).double() ** 2, weight=torch.ones(1).double())

    has = torch.ones(len(effects), len(before), dtype=torch.bool) if has is None else torch.tensor(has)
    has = has.reshape(len(effects), len(before))
    model = SimpleNamespace(effects=tuple(effects), has=has, shared={get_effect("torque_gain")})
    model.is_wide = lambda _: torch.zeros(has.shape[1], dtype=torch.bool)
    final = SimpleNamespace(model=model, x=None)
    return Outcome(
        problem=None,
        base=final,
        base_errors=errors(before),
        final=final,
        final_errors=errors(after),
        rounds=list(rounds),
    )


def hidden_run(folder, effect, seed=0, duration=4.0):
    """A short battery from the independent plant, and the folder of a run that was fitted to it."""
    robot = plant_robot(BENCH)
    suite = make_suite(robot, "battery", seed=seed, duration=duration)
    cfg = PlantCfg(control_dt=robot.control_dt, noise=1e-4, seed=seed)
    effects = () if effect is None else (effect,)
    drawn = draw_visible(robot, suite.runs, effects, np.random.default_rng(seed), cfg=cfg)
    paths = [str(save_recording(folder / f"{i}_{r.name}.npz", r)) for i, r in enumerate(drawn.recordings)]
    data, validation = paths[: len(suite.train)], paths[len(suite.train) :]
    run = folder / "logs" / "run"
    run.mkdir(parents=True)
    names = [*BASE[:-1]]
    values = {name: {"servo": CALM[name]} for name in names} | {"delay": {"all": CALM["delay"]}}
    result = {
        "parameters": values,
        "std": {name: dict.fromkeys(own) for name, own in values.items()},
        "at_bound": [],
        "indistinguishable": [],
        "correlation": {"labels": [], "matrix": []},
        "rmse": {part: {"servo": 0.004, "all": 0.004} for part in ("train", "validation")},
    }
    make_result(task=BENCH, joint_names=["servo"], **result).save(run / "result.json")
    settings = {"task": BENCH, "data": data, "validation": validation, "log_dir": str(folder / "logs")}
    write_json(run / "settings.json", {"settings": settings, "digests": {}})
    return SimpleNamespace(folder=run, problem=load_problem(BENCH, data=data, validation=validation))


@cache
def joint_alone() -> SimpleNamespace:
    """A short chirp without noise, its problem with a twin of each joint, and the truth. Made once: change nothing."""
    fine = env_cfg()  # what the robot does, not what a coarse step makes of it
    set_physics_dt(fine, DT / 10)
    recordings = [replayed(target, CALM, fine) for target in (chirp(3.0), chirp(2.5, 0.2, 3.0))]
    problem = make_problem(recordings[:1], validation=recordings[1:]).with_physics_dt(DT / 2)
    truth = physical(problem, CALM)
    return SimpleNamespace(
        problem=problem,
        truth=truth,
        truth_values=torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64),
        twins=twin_problem(problem, reference_path(problem, truth, ["com_offset"])),
    )


def errors_of(*rmse, roll=0):
    """Validation errors of joints with these RMSE [rad], in four blocks that scatter, by ``roll`` in another order."""
    scatter = torch.tensor([1.1, 1.0, 1.0, 0.9]).double().roll(roll)[:, None]
    return BlockErrors(square=scatter * torch.tensor(rmse).double() ** 2, weight=torch.ones(4).double())


class FakeFits(Fits):
    """Models stay where they start; their errors follow from the model."""

    def __init__(self, errors):
        super().__init__()
        object.__setattr__(self, "errors", errors)

    def side_by_side(self, problem, starts, *args, **kwargs):
        return list(starts)

    def coarse_to_fine(self, problem, starts, rough=False):
        return list(starts)

    def to_whole(self, problem, starts):
        return list(starts)

    def over_wide_steps(self, problem, now, kept=None):
        return now

    def validation_errors(self, problem, models):
        return [self.errors(now) for now in models]


def make_search(errors, floor=(1e-4,), effects=(None,) * 30, off=(), **changes):
    """A search whose fits stay where they start, with the errors that a function gives of a model."""
    floor = torch.tensor(floor, dtype=torch.float64)
    fits, cfg = FakeFits(errors), DiagnosisCfg(off=off)
    own = {"effects": effects, "effort": 5 * floor, "floor": floor, "max_effects": 3, "fits": fits, "cfg": cfg}
    return Search(**own, **{"try_effects": try_effects, **changes})


def with_effects(model, values, *effects):
    """A model of joints with effects: (effect, joints, values)."""
    for effect, joints, own in effects:
        own = torch.tensor([own] * model.num_joints, dtype=torch.float64)
        model, values = model.extended(values, effect, torch.tensor(joints), own)
    return Fitted.start(model, values)
