"""The drive's laws against MuJoCo's own bodies, tendons and friction: a plant that knows nothing of ours."""

import mujoco_plant
import numpy as np
import pytest
import torch

from pace_optim.problem.problem import load_problem

BASE = {"armature": 0.08, "viscous_friction": 1.0, "friction": 0.5, "encoder_bias": 0.02, "delay": 2.3}
HIDDEN = {
    "joint_elasticity": (
        {"stiffness": 250.0, "damping": 0.3},
        {"stiffness": 250.0, "damping": 0.3, "encoder_side": 1.0},
    ),
    "stribeck_friction": ({"stribeck": 0.8, "velocity": 0.2}, {"effort": 0.8, "velocity": 0.2}),
    "quadratic_friction": ({"quadratic": 0.08}, {"coefficient": 0.08}),
    "torque_gain": ({"gain": -0.2}, {"gain": 0.8}),
}


@pytest.fixture(scope="module", autouse=True)
def short():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mujoco_plant, "DURATION", 1.6)
        patch.setattr(mujoco_plant, "NOISE", 0.0)
        patch.setattr(
            mujoco_plant, "PLANT_DT", 5e-5
        )  # MuJoCo's steps are of first order: half of 0.1 ms, half the error
        every = mujoco_plant.commands
        patch.setattr(mujoco_plant, "commands", lambda rng: {name: every(rng)[name] for name in ("stiff", "staircase")})
        yield


def error(folder, effects=(), values=None, physics_dt=0.00125):
    """RMS over all recordings of the model at the true values [rad]."""
    files = sorted(str(path) for path in folder.glob("*.npz"))
    problem = load_problem("Pace-TestBench-v0", data=files, validation=[], physics_dt=physics_dt).with_effects(effects)
    per_joint = {name: {"servo": value} for name, value in BASE.items() if name != "delay"}
    own = {name if "." in name else f"{effect}.{name}": value for effect in effects for name, value in values.items()}
    truth = problem.space.from_dict({**per_joint, "delay": {"all": BASE["delay"]}, **own})
    where = torch.ones_like(problem.dataset.train)
    return float(problem.evaluator().residuals(truth[None], where=where).error.double().square().mean().sqrt())


def written(folder, monkeypatch, sizes, friction_time_constant=4e-4):
    """Recordings of a drive with a hidden effect of this size."""
    monkeypatch.setattr(mujoco_plant, "drawn_base", lambda rng: BASE)
    monkeypatch.setitem(mujoco_plant.EFFECTS, "clean", lambda rng: sizes)
    mujoco_plant.record(folder, "clean", 0, friction_time_constant)
    return folder


@pytest.mark.slow
def test_the_base_model_moves_as_the_bodies_do(tmp_path, monkeypatch):
    assert error(written(tmp_path, monkeypatch, {})) < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("effect", HIDDEN)
def test_a_drive_with_an_effect_moves_as_the_bodies_do(effect, tmp_path, monkeypatch):
    sizes, values = HIDDEN[effect]
    folder = written(tmp_path, monkeypatch, sizes)
    with_it, without = error(folder, [effect], values, physics_dt=0.0003125), error(folder)
    assert without > 1e-3
    assert with_it < 0.1 * without


@pytest.mark.slow
def test_friction_of_mujocos_default_creeps(tmp_path):
    command = np.full(400, 0.3)
    base = {**BASE, "friction": 1.0}
    sharp, soft = (mujoco_plant.simulate(command, 85.0, base, {}, constant) for constant in (4e-4, 0.02))
    assert np.ptp(sharp[200:]) < 1e-6
    assert np.ptp(soft[200:]) > 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("friction_time_constant", [0.02, 0.05])
def test_soft_friction_moves_as_mujocos_own(friction_time_constant, tmp_path, monkeypatch):
    folder = written(tmp_path, monkeypatch, {}, friction_time_constant)
    values = {"time_constant": friction_time_constant}
    with_it, without = error(folder, ["soft_friction"], values, physics_dt=0.000625), error(folder)
    assert without > 1e-3
    assert with_it < 0.15 * without


@pytest.mark.slow
def test_soft_friction_of_a_motor_behind_an_elastic_shaft_moves_as_mujocos_own(tmp_path, monkeypatch):
    sizes, values = HIDDEN["joint_elasticity"]
    folder, fine = written(tmp_path, monkeypatch, sizes, 0.02), 0.0003125
    elastic = {f"joint_elasticity.{name}": value for name, value in values.items()}
    hard = error(folder, ["joint_elasticity"], elastic, physics_dt=fine)
    both = {**elastic, "soft_friction.time_constant": 0.02}
    soft = error(folder, ["joint_elasticity", "soft_friction"], both, physics_dt=fine)
    assert hard > 1e-3
    assert soft < 0.1 * hard
