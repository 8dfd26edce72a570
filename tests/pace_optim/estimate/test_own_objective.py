"""An objective of the user's own, as PACE's advanced tutorial writes it, through the usual fit."""

import dataclasses
import json
import os
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from places import ROOT
from problems import BENCH, TRUTH, chirp, env_cfg, make_problem, pendulums_cfg, record

from pace_envs import TerrainCfg
from pace_envs.contact_sensor import ContactSensorCfg
from pace_optim import CMAESOptimizer
from pace_optim.estimate.cmaes_optimizer import CMAESOptimizerCfg
from pace_optim.estimate.convergence import EarlyStopping, Plateau, ScoreGradient, SearchState, stop_rule
from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.least_squares import LeastSquaresCfg, least_squares
from pace_optim.estimate.own_objective import Objective, objective_error_bars, optimizer_class
from pace_optim.identification.fit import fit, resume
from pace_optim.recording import load_recording, save_recording
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.progress import ProgressLine


class Silent(ProgressLine):
    def say(self, text):
        pass


class Plain(CMAESOptimizer):
    """PACE's own objective in the tutorial's words."""

    def tell(self, sim_dof_pos, real_dof_pos):
        self.scores += torch.sum(torch.square(sim_dof_pos - real_dof_pos - self.sim_params[:, self.bias_idx]), dim=1)


class PositionAndVelocity(CMAESOptimizer):
    def tell(self, sim_dof_pos, real_dof_pos):
        error_pos = torch.sum((sim_dof_pos - self.sim_params[:, self.bias_idx] - real_dof_pos) ** 2, dim=1)
        error_vel = torch.sum((self.sim_dof_vel - self.real_dof_vel) ** 2, dim=1)
        self.scores += 0.7 * error_pos + 0.3e-3 * error_vel


class EndEffector(CMAESOptimizer):
    def tell(self, sim_dof_pos, real_dof_pos):
        error = torch.norm(self.sim_ee_pose - self.real_ee_pose, dim=1)
        self.scores += error**2


@pytest.fixture(scope="module")
def recording():
    return record(chirp(0.3), noise=1e-4)


@pytest.fixture(scope="module")
def file(recording, tmp_path_factory):
    return save_recording(tmp_path_factory.mktemp("data") / "chirp.npz", recording)


def one_generation(kind, problem, trees=None) -> CMAESOptimizer:
    """After the first generation."""
    optimizer = kind(problem.space, 8, CMAESOptimizerCfg.of(problem.env_cfg.sim2real), trees=trees, seed=3)
    rollout = problem.evaluator().rollout(8)
    optimizer.ask()
    optimizer.update_simulator(rollout)
    for sim_dof_pos, real_dof_pos in rollout:
        optimizer.tell(sim_dof_pos, real_dof_pos)
    optimizer.evolve()
    return optimizer


def test_the_tutorials_sum_into_scores_is_the_mean_over_all_samples(recording):
    problem = make_problem([recording, record(chirp(0.3), name="shorter")])
    expected = one_generation(CMAESOptimizer, problem).generation_scores
    assert np.allclose(one_generation(Plain, problem).generation_scores, expected, rtol=1e-12)


@pytest.mark.parametrize(
    "line", ["self.scores = self.scores + error", "self.scores[:] += error", "self.add_score(error)"]
)
def test_scores_can_be_added_to_in_any_form(recording, line):
    body = {"torch": torch}
    exec(  # the ways of writing it
        "def tell(self, sim_dof_pos, real_dof_pos):\n"
        "    error = (sim_dof_pos - self.sim_params[:, self.bias_idx] - real_dof_pos).square().sum(dim=1)\n"
        f"    {line}\n",
        body,
    )
    problem = make_problem(recording)
    kind = type("Written", (CMAESOptimizer,), {"tell": body["tell"]})
    expected = one_generation(CMAESOptimizer, problem).generation_scores
    assert np.allclose(one_generation(kind, problem).generation_scores, expected, rtol=1e-12)


def test_scores_of_a_wrong_shape_are_refused(recording):
    class PerJoint(CMAESOptimizer):
        def tell(self, sim_dof_pos, real_dof_pos):
            self.scores = self.scores + (sim_dof_pos - real_dof_pos)

    with pytest.raises(ValueError, match=r"scores has shape .* expected one error per environment"):
        Objective(PerJoint, make_problem(recording))


@pytest.mark.slow
def test_error_bars_of_squared_positions_are_those_of_least_squares():
    problem = make_problem(record(chirp(2.0), noise=1e-4))
    evaluator = problem.training_evaluator()
    x = least_squares(evaluator, [problem.space.start], LeastSquaresCfg())[0].x
    expected = assess(problem, problem.evaluator(), x).uncertainty
    found, score = objective_error_bars(Objective(Plain, problem), evaluator, x)
    assert score == pytest.approx(float(evaluator.residuals(problem.space.to_physical(x[None])).score), rel=1e-9)
    ratio = found.std / expected.std
    assert ratio.min() > 0.5 and ratio.max() < 2.0
    assert np.abs(found.correlation - expected.correlation).max() < 0.3


@pytest.mark.slow
def test_a_fit_takes_a_class_and_writes_all_that_a_fit_writes(file, tmp_path):
    settings = FitSettings(
        task=BENCH,
        data=[str(file)],
        optimizer=PositionAndVelocity,
        num_envs=16,
        max_iteration=20,
        log_dir=str(tmp_path),
    )
    result, folder = fit(settings, Silent())
    assert settings.optimizer == f"{__name__}:PositionAndVelocity" == result.optimizer
    assert result.objective["train"] > 0 and result.objective["validation"] > 0
    assert result.rmse["validation"]["all"] > 0 and result.std["armature"]["servo"] > 0
    names = {path.name for path in folder.iterdir()}
    assert {"result.json", "report.html", "checkpoint.npz", "best_trajectory.pt", "mean_020.pt", "config.pt"} <= names
    assert any(name.startswith("events.out") for name in names)
    record_ = json.loads((folder / "settings.json").read_text())["environment"]["code"]
    assert any(Path(entry["file"]) == Path(__file__) for entry in record_.values())
    more, _ = resume(folder, max_iteration=22, progress=Silent())
    assert more.generations == 22
    report = (folder / "report.html").read_text()
    assert f"<dd>{more.objective['train']:.2e}</dd>" in report
    assert f"Mean over the training samples of the objective {__name__}:PositionAndVelocity." in report
    assert "score [rad²]" not in report


# ---- end effector and contacts


def with_pose(recording, poses):
    return dataclasses.replace(recording, real_ee_pose=poses)


def tip(q):
    """Of the left pendulum in the world, which is its base [m]."""
    return np.stack([-0.25 * np.sin(q), np.full_like(q, -0.3), 1.0 - 0.25 * np.cos(q)], axis=1)


@pytest.mark.slow
def test_an_end_effectors_pose_is_that_of_a_site_and_of_the_recording(tmp_path):
    cfg = pendulums_cfg(tmp_path)
    cfg.sim2real.ee_site = "left_tip"
    truth = {"armature": 0.1, "viscous_friction": 2.0, "friction": 0.2, "encoder_bias": 0.0, "delay": 1.0}
    made = record(np.tile(chirp(1.0), (1, 2)), truth, cfg=cfg)
    problem = make_problem(with_pose(made, tip(made.dof_pos[:, 0])), cfg=cfg)
    objective = Objective(EndEffector, problem)
    assert objective.joins_joints
    vectors = torch.stack([problem.space.from_dict(truth), problem.space.from_dict(truth | {"armature": 0.3})])
    right, wrong = objective.errors(problem.evaluator(), vectors, problem.dataset.train).sum(dim=1).tolist()
    assert right < 1e-20 < 1e-6 < wrong


def test_poses_survive_every_format_and_resampling(tmp_path, recording):
    poses = np.concatenate([tip(recording.dof_pos[:, 0]), np.tile([0.6, 0.0, 0.8, 0.0], (recording.num_samples, 1))], 1)
    for suffix in (".npz", ".pt", ".csv"):
        path = save_recording(tmp_path / f"r{suffix}", with_pose(recording, poses))
        assert np.array_equal(load_recording(path).real_ee_pose, poses)
    with pytest.raises(ValueError, match=r"real_ee_pose has shape \(121, 4\); expected \(121, 3\)"):
        load_recording(save_recording(tmp_path / "bad.npz", with_pose(recording, poses[:, :4])))
    problem = make_problem(with_pose(recording, poses[:, :3]))
    assert torch.equal(problem.dataset.ee_pose[:, 0], torch.as_tensor(poses[:, :3]))


@pytest.mark.parametrize(
    ("site", "poses", "said"),
    [("left_tip", False, "Add the series real_ee_pose"), (None, True, "Available: left_tip, right_tip")],
)
def test_an_end_effector_that_is_missing_is_told_with_the_cure(tmp_path, site, poses, said):
    cfg = pendulums_cfg(tmp_path)
    cfg.sim2real.ee_site = site
    truth = {"armature": 0.1, "viscous_friction": 2.0, "friction": 0.2, "encoder_bias": 0.0, "delay": 1.0}
    made = record(np.tile(chirp(0.2), (1, 2)), truth, cfg=cfg)
    problem = make_problem(with_pose(made, tip(made.dof_pos[:, 0])) if poses else made, cfg=cfg)
    with pytest.raises(ValueError, match=said):
        Objective(EndEffector, problem)


def test_an_objective_may_be_about_contacts(recording):
    class Contact(CMAESOptimizer):
        def tell(self, sim_dof_pos, real_dof_pos):
            sensor = self.rollout.contacts("load")
            self.scores += sensor.in_contact.sum(dim=1).double() + 1e-9

    cfg = env_cfg()
    with pytest.raises(ValueError, match=r"set\s+sim.contacts = True"):
        Objective(Contact, make_problem(recording, cfg=cfg))
    cfg.sim.contacts, cfg.scene.terrain = True, TerrainCfg()
    cfg.scene.contact_sensors = {"load": ContactSensorCfg(geom_names="terrain")}
    problem = make_problem(recording, cfg=cfg)
    errors = Objective(Contact, problem).errors(
        problem.evaluator(), problem.space.from_dict(TRUTH)[None], problem.dataset.train
    )
    assert torch.isfinite(errors).all()


# ---- what is refused


def written(folder, text, name="own_optimizer.py"):
    path = folder / name
    path.write_text("import torch\nfrom pace_optim import CMAESOptimizer\n" + text)
    return path


@pytest.mark.parametrize(
    ("text", "name", "said"),
    [
        ("class Mine(CMAESOptimizer):\n    pass\n", "Other", "has Mine"),
        ("x = 1\n", "Mine", "write class MyOptimizer"),
        (
            "class Mine(CMAESOptimizer):\n    def update_simulator(self, articulation, joint_ids, initial_position):\n"
            "        pass\n",
            "Mine",
            "PaceCfg.extra_parameters",
        ),
        ("class Mine(CMAESOptimizer):\n    def tell(self, sim_dof_pos):\n        pass\n", "Mine", "Write def tell"),
    ],
)
def test_a_class_that_cannot_be_used_is_refused_with_the_line_to_write(tmp_path, text, name, said):
    path = written(tmp_path, text, f"own_{abs(hash((text, name)))}.py")
    with pytest.raises(ValueError, match=said):
        optimizer_class(f"{path}:{name}")


def test_an_objective_that_adds_nothing_is_refused(recording):
    class Nothing(CMAESOptimizer):
        def tell(self, sim_dof_pos, real_dof_pos):
            pass

    with pytest.raises(ValueError, match="adds no error"):
        Objective(Nothing, make_problem(recording))


def test_longer_bounds_are_refused_with_the_declaration_to_write():
    cfg = env_cfg(bounds_params=torch.zeros(6, 2))
    with pytest.raises(ValueError, match=r"extra_parameters"):
        cfg.prepare()


def test_an_unknown_optimizer_is_refused_by_name():
    with pytest.raises(ValueError, match=r"Available: .*or module:Class"):
        FitSettings(task=BENCH, optimizer="cmeas")


# ---- stop rules


def state(best, scores=None):
    scores = np.array(best[-1:] if scores is None else scores)
    return SearchState(generation=len(best), scores=scores, best_scores=best, spread=np.ones(1))


def test_stop_rules_look_at_the_best_scores():
    falling, flat = [0.5**k for k in range(40)], [1.0] * 40
    for rule in (ScoreGradient(), EarlyStopping(), Plateau()):
        assert rule(state(falling)) is None and rule(state(flat))
    slow = [0.999**k for k in range(40)]
    assert EarlyStopping()(state(slow)) is None and ScoreGradient(threshold=0.01)(state(slow))


def test_stop_rules_are_named_with_numbers():
    assert stop_rule("plateau:generations=30,improvement=0.01") == Plateau(generations=30, improvement=0.01)
    assert stop_rule("early_stopping") == EarlyStopping()
    own = EarlyStopping(generations=3)
    assert stop_rule(own) is own
    for wrong, said in (
        ("plato", "Available: spread, plateau"),
        ("plateau:x=1", "expected plateau:generations=NUMBER"),
        ("target", "write target:score=NUMBER"),
        ("window:generations=-1", "expected a number > 0"),
    ):
        with pytest.raises(ValueError, match=said):
            stop_rule(wrong)


@pytest.mark.slow
def test_a_stop_rule_of_the_command_ends_the_search(file, tmp_path):
    settings = FitSettings(
        task=BENCH, data=[str(file)], optimizer="cmaes", num_envs=16, stop=["early_stopping:generations=2"],
        log_dir=str(tmp_path),
    )  # fmt: skip
    result, folder = fit(settings, Silent())
    assert result.stop_reasons == ["no better candidate in 2 generations"] and result.generations < 100
    again, _ = resume(folder, progress=Silent())
    assert again.generations == result.generations


# ---- kill -9


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_killed_fit_of_an_own_objective_resumes_to_the_same_result(warm, file, tmp_path):
    path = written(
        tmp_path,
        "class Mine(CMAESOptimizer):\n"
        "    def tell(self, sim_dof_pos, real_dof_pos):\n"
        "        error = sim_dof_pos - real_dof_pos - self.sim_params[:, self.bias_idx]\n"
        "        self.scores += torch.sum(error.abs(), dim=1)\n",
    )
    words = [ROOT / "scripts/fit.py", "--task", BENCH, "--data", file, "--num_envs", 16]
    words += ["--optimizer", f"{path}:Mine", "--max_iteration", 8]
    env = {**os.environ, "XDG_STATE_HOME": str(tmp_path / "state")}
    whole = warm.run(*words, "--log_dir", tmp_path / "whole", env=env)
    assert whole.returncode == 0, whole.stderr
    running = warm.start(*words, "--log_dir", tmp_path / "killed", env=env, stderr=subprocess.PIPE)
    while not (found := list(tmp_path.glob("killed/*/*/history.json"))) or '"search_best": []' in found[0].read_text():
        time.sleep(0.05)
        assert running.poll() is None
    time.sleep(0.1)
    running.kill()
    running.communicate()  # until no process holds the other end
    folder = found[0].parent
    assert not (folder / "result.json").exists()
    again = warm.run(ROOT / "scripts/fit.py", "--resume", folder, env=env)
    assert again.returncode == 0, again.stderr
    results = [
        json.loads(p.read_text()) for p in (folder / "result.json", next(tmp_path.glob("whole/*/*/result.json")))
    ]
    for key in ("parameters", "objective", "generations", "std", "stop_reasons"):
        assert results[0][key] == results[1][key], key
