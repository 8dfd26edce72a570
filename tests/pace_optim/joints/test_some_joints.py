"""Some joints of a robot are taken out, worked on and put back: the same results, and the others are as they were."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import pytest
import torch
from diagnoses import errors_of, make_trial, with_effects
from problems import ANYMAL, env_cfg, legs_chirp, make_problem, physical, record

from pace_actuators.effects import get_effect
from pace_envs.simulation import SimulationCfg
from pace_optim.diagnosis.selection.candidate_results import Round
from pace_optim.diagnosis.selection.choice import choose
from pace_optim.joints.fits.base_fit import joint_vectors
from pace_optim.joints.fits.model import BASE, JointModel
from pace_optim.joints.fits.side_by_side import SideBySide, Slot
from pace_optim.joints.simulation import reference_path, twin_problem
from pace_optim.joints.simulation.simulation import TwinSimulation
from pace_optim.recording import Load

ELASTICITY, MOUNT, GAIN, FRICTION, PAYLOAD = (
    get_effect(name)
    for name in ("joint_elasticity", "mount_compliance", "torque_gain", "load_dependent_friction", "payload")
)
N = 12
CHOSEN = (1, 3, 8)
TRUTH = {"armature": 0.1, "viscous_friction": 4.5, "friction": 0.1, "encoder_bias": 0.02, "delay": 2.0}


def these(*indices):
    return torch.tensor([j in indices for j in range(N)])


def legs_cfg():
    """Two groups of drives, values by pattern."""
    cfg = env_cfg(ANYMAL)
    (drive,) = cfg.scene.robot.actuators.values()
    hips = {"LF_HAA": 90.0, "(?!LF).._HAA": 80.0}
    cfg.scene.robot.actuators = {
        "hips": replace(drive, joint_names_expr=".*HAA", stiffness=hips),
        "legs": replace(drive, joint_names_expr=[".*HFE", ".*KFE"], damping={".*HFE": 0.6, ".*KFE": 0.9}),
    }
    cfg.scene.robot.init_state.joint_pos = {".*HFE": 0.1, "RF_HAA": -0.1}
    return cfg


@pytest.fixture(scope="module")
def legs():
    """A short motion of a robot's legs, one with a load; its joints alone."""
    cfg = legs_cfg()
    target = legs_chirp(cfg, 0.3)
    recordings = [
        record(target, TRUTH, cfg=cfg, drive={"effort_limit": 60.0}),
        record(0.5 * target, TRUTH, cfg=cfg, load=Load(added_mass={"LF_SHANK": 0.5})),
    ]
    problem = make_problem(recordings, cfg=cfg, validation=[record(0.7 * target, TRUTH, cfg=cfg)])
    truth = physical(problem, TRUTH)
    path = reference_path(problem, truth, ["payload"])
    return SimpleNamespace(problem=problem, twins=twin_problem(problem, path), values=joint_vectors(problem, truth))


@pytest.mark.slow
@pytest.mark.parametrize("training", [True, False])
def test_they_move_as_they_do_among_all(legs, training):
    part, base = these(*CHOSEN), JointModel.base(legs.problem)
    every = [True] * N
    models = [
        with_effects(base, 1.1 * legs.values),
        with_effects(base, legs.values, (ELASTICITY, every, [300.0, 1.0, 1.0])),
        with_effects(base, legs.values, (FRICTION, every, [0.2])),
        with_effects(base, legs.values, (PAYLOAD, every, [0.3])),
        with_effects(base, legs.values, (MOUNT, every, [800.0, 3.0, 0.5])),
    ]

    def errors(problem, models):
        batch = SideBySide(problem, [Slot(model=m.model, rows=1) for m in models], training=training)
        return batch.simulate([m.model.to_physical(m.x)[None] for m in models], batch.dataset.sampled)

    whole = errors(legs.twins, models)
    alone = errors(legs.twins.on_joints(part), [model.on_joints(part) for model in models])
    assert alone.shape == (*whole.shape[:-1], len(CHOSEN)) and float(whole.abs().max()) > 1e-4
    assert torch.equal(alone, whole[..., list(CHOSEN)])


def test_their_bounds_are_their_own():
    cfg = legs_cfg().sim2real
    cfg.bounds_params = rows = torch.arange(2.0 * (4 * N + 1)).view(-1, 2)
    part = cfg.on_joints([cfg.joint_order[8], cfg.joint_order[1]])
    assert part.joint_order == (cfg.joint_order[1], cfg.joint_order[8])
    assert part.bounds["friction"].tolist() == rows[[2 * N + 1, 2 * N + 8]].tolist()
    assert part.bounds["delay"].tolist() == rows[[-1]].tolist()


def test_all_joints_are_the_problem_itself(legs):
    every, now = these(*range(N)), with_effects(JointModel.base(legs.problem), legs.values)
    assert legs.twins.on_joints(every) is legs.twins and now.on_joints(every) is now


def test_what_ties_joints_together_does_not_keep_them_from_being_taken_out(legs):
    spec = mujoco.MjSpec.from_string("""
        <mujoco>
          <worldbody>
            <body name="thigh"><joint name="LF_HFE" axis="0 1 0"/><geom size=".1"/>
              <body name="shank"><joint name="LF_KFE" axis="0 1 0"/><geom size=".1"/></body>
            </body>
          </worldbody>
          <tendon><fixed name="t"><joint joint="LF_HFE" coef="1"/><joint joint="LF_KFE" coef="1"/></fixed></tendon>
          <equality><joint joint1="LF_HFE" joint2="LF_KFE"/></equality>
          <sensor><jointpos joint="LF_HFE"/><tendonpos tendon="t"/></sensor>
          <actuator><motor joint="LF_HFE"/><motor tendon="t"/></actuator>
        </mujoco>""")
    path = replace(legs.twins.path.on_joints([0]), columns=torch.tensor([1]), names=("LF_KFE",))
    sim = TwinSimulation(SimulationCfg(), spec, legs.twins.dataset.num_recordings, path)
    assert [sim.model.joint(j).name for j in range(sim.model.njnt)] == ["LF_KFE"]
    assert not bool(sim._stands_alone.any())  # in the robot it follows another


def test_they_come_back_and_leave_the_others_as_they_were(legs):
    base, which = JointModel.base(legs.problem), these(*CHOSEN)
    left = these(0, 1, 2).tolist()
    now = with_effects(base, legs.values, (ELASTICITY, left, [300.0, 1.0, 1.0]), (GAIN, these(5).tolist(), [-0.2]))
    own = now.on_joints(which)
    assert own.model.effects == (ELASTICITY,) and own.model.has.tolist() == [[True, False, False]]  # 5 is not there
    values = torch.tensor([[0.1], [0.2], [0.3]], dtype=torch.float64)
    at = own.model.to_physical(own.x)
    at[:, BASE.index("armature")] = 0.07
    model, at = own.model.extended(at, FRICTION, torch.tensor([True, True, False]), values)
    fitted = replace(own, model=model, x=model.to_normalised(at), score=torch.tensor([1.0, 2.0, 3.0]).double())
    after = errors_of(4.0, 5.0, 6.0)
    trial = make_trial(FRICTION, 2, 1e-4)
    found = Round(
        trials=[[], [], [trial]],
        chosen=[None, GAIN, FRICTION],
        rivals=[[], [], [GAIN]],
        models={FRICTION: fitted},
    ).among_all(which, now)
    assert found.chosen == [None] * 3 + [GAIN] + [None] * 4 + [FRICTION] + [None] * 3
    assert found.rivals[8] == [GAIN] and [vars(t) for t in found.trials[8]] == [vars(trial) | {"joint": 8}]
    back = found.models[FRICTION]
    assert back.model.effects == (ELASTICITY, GAIN, FRICTION)
    assert torch.equal(back.model.has, torch.stack([these(0, 1, 2), these(5), these(1, 3)]))
    whole, before = back.model.to_physical(back.x), now.model.to_physical(now.x)
    assert torch.allclose(whole[~which, : now.model.size], before[~which])
    assert whole[which, BASE.index("armature")].tolist() == pytest.approx([0.07] * 3)
    assert whole[[1, 3], back.model.columns(FRICTION)].flatten().tolist() == pytest.approx([0.1, 0.2])
    assert whole[[0, 1], back.model.columns(ELASTICITY)].flatten().tolist() == pytest.approx([300.0, 1.0, 1.0] * 2)
    assert back.score[which].tolist() == [1.0, 2.0, 3.0]
    square = errors_of(*[1.0] * N).with_joints(which, after).square[1]
    assert square.tolist() == [25.0 if j == 3 else 16.0 if j == 1 else 36.0 if j == 8 else 1.0 for j in range(N)]


@pytest.mark.parametrize(("mount", "chosen"), [(2.0, ELASTICITY), (0.5, MOUNT)])
def test_what_moves_the_whole_robot_is_judged_by_all_its_joints(mount, chosen):
    """On the last joint the mount does best, on the others it may do worse than effects of their own."""
    rmse = [(mount, 1.0), (mount, 1.0), (0.1, 0.3)]
    trials = [
        [make_trial(MOUNT, j, 1e-4 * of_mount), make_trial(ELASTICITY, j, 1e-4 * own)]
        for j, (of_mount, own) in enumerate(rmse)
    ]
    assert choose(trials).chosen == [chosen, chosen, chosen]


def test_a_joint_with_little_error_counts_as_much_for_the_whole_robot_as_one_with_much():
    """A carriage at 10 µm beside a hinge at 10 mrad: what moves both was taken although it explains little there."""
    mount, own = [0.5e-2, 0.9e-5], [0.6e-2, 0.1e-5]
    trials = [
        [
            replace(make_trial(effect, j, after[j]), mse_before=before**2)
            for effect, after in ((MOUNT, mount), (ELASTICITY, own))
        ]
        for j, before in enumerate((1e-2, 1e-5))
    ]
    assert choose(trials).chosen == [ELASTICITY, ELASTICITY]
