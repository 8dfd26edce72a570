"""Inertial parameters of links: always a real body, the same everywhere, found where recordings show them."""

import dataclasses
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from problems import DT, env_cfg, make_problem
from torque_sequence import write_result

from pace_actuators import IdentifiedDrives, PaceDCMotorCfg
from pace_actuators.drive_result import LinkInertia
from pace_envs import ArticulationCfg, ManagerBasedRLEnv, SimulationCfg, load_env_cfg
from pace_envs.identified import use_identified
from pace_envs.link_inertia import NAMES, PARTS, POSITIVE, TEN, Reference
from pace_envs.tasks.pace import PaceCfg, PaceSim2realEnvCfg, PaceSim2realSceneCfg, sought_links
from pace_optim.diagnosis.diagnosis_cfg import DiagnosisCfg, LinksCfg
from pace_optim.diagnosis.wrong_links import LinkFindings, WrongLink, _best_load, find_wrong_links, listed_candidates
from pace_optim.estimate.error_bars.assessment import assess
from pace_optim.estimate.error_bars.undetermined import undetermined
from pace_optim.estimate.least_squares import LeastSquaresCfg, least_squares
from pace_optim.export import export
from pace_optim.identification.balanced_start import balanced_start
from pace_optim.joints.simulation import reference_path
from pace_optim.recording import Drive, Load, Recording
from pace_optim.recording.facts import load_of

ARM = """<mujoco><compiler angle="radian"/><worldbody>
<body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0"/>
  <inertial mass="1.2" pos="0.02 0 -0.15" fullinertia="0.012 0.013 0.003 0.0004 -0.0003 0.0002"/>
  <body name="fore" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0"/>
    <inertial mass="0.8" pos="0 0.01 -0.12" diaginertia="0.005 0.006 0.002"/>
    <body name="tool" pos="0 0 -0.25"><inertial mass="0.1" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/></body></body>
</body></worldbody></mujoco>"""
JOINTS = ("shoulder", "elbow")
TRUE = {"armature": 0.02, "viscous_friction": 0.4, "friction": 0.1, "encoder_bias": 0.0, "delay": 0.0}


def arm_cfg(folder: Path, links=(), **found) -> PaceSim2realEnvCfg:
    path = folder / "arm.xml"
    path.write_text(ARM)
    drive = PaceDCMotorCfg(
        joint_names_expr=".*", stiffness=25.0, damping=0.8, saturation_effort=80.0, effort_limit=50.0,
        velocity_limit=50.0, delay=0.0, max_delay=4.0,
    )  # fmt: skip
    robot = ArticulationCfg(mjcf_path=path, actuators={"all": drive}, fix_base=True, links=found)
    bounds = {
        "armature": (1e-4, 0.2), "viscous_friction": (0.0, 3.0), "friction": (0.0, 1.0), "encoder_bias": (-0.1, 0.1),
        "delay": (0.0, 4.0),
    }  # fmt: skip
    references = sought_links(mujoco.MjModel.from_xml_string(ARM), JOINTS, links)
    return PaceSim2realEnvCfg(
        sim=SimulationCfg(num_threads=1),
        scene=PaceSim2realSceneCfg(robot=robot),
        sim2real=PaceCfg(
            robot_name="arm", data_dir=folder / "missing.npz", joint_order=JOINTS, bounds=bounds, links=references
        ),
    )


def target(seconds: float = 2.0) -> np.ndarray:
    t = np.arange(round(seconds / DT)) * DT
    ramp = np.clip(t / 0.5, 0, 1)[:, None]
    return ramp * np.column_stack([0.8 * np.sin(2.1 * t + 3 * np.sin(1.3 * t)), 1.1 * np.sin(3.7 * t + np.cos(5 * t))])


def recorded(folder: Path, change: dict[str, LinkInertia], load: Load | None = None, noise: float = 1e-5) -> Recording:
    """The arm with other links, simulated by stepping one environment."""
    cfg = arm_cfg(folder, **change)
    cfg.scene.num_envs = 1
    env = ManagerBasedRLEnv(cfg)
    robot, commands, shown = env.scene["robot"], torch.as_tensor(target()), []
    for name, value in TRUE.items():
        robot.write_base_parameter_to_sim(name, torch.full((1, 1 if name == "delay" else 2), value))
    for body, mass in ({} if load is None else load.added_mass).items():
        robot.add_body_mass(body, mass, place=load.added_mass_at.get(body))
    robot.write_joint_state_to_sim(commands[:1], torch.zeros(1, 2))
    for command in commands:
        shown.append(robot.data.joint_pos[0].clone())
        env.step(command[None])
    env.close()
    position = torch.stack(shown).numpy()
    position = position + noise * np.random.default_rng(0).standard_normal(position.shape)
    return Recording(
        name="r", joint_names=JOINTS, time=np.arange(len(position)) * DT, dof_pos=position,
        des_dof_pos=commands.numpy(), drive=Drive(), load=load or Load(),
    )  # fmt: skip


def reference(link: str = "upper", names=NAMES) -> Reference:
    return Reference.of(mujoco.MjModel.from_xml_string(ARM), link, "shoulder", names)


def drawn(link: Reference, seed: int) -> dict[str, float]:
    """Parameters anywhere between their bounds."""
    rng, found = np.random.default_rng(seed), {}
    for name in NAMES:
        low, high = link.bounds(name)
        found[name] = float(
            np.exp(rng.uniform(np.log(low), np.log(high))) if name in POSITIVE else rng.uniform(low, high)
        )
    return found


def fit(problem, iterations: int = 10, held: tuple[str, ...] = ()):
    if held:
        physical = problem.space.to_physical(problem.space.start)
        for name in held:
            physical[problem.space[name]] = TRUE[name]
        labels = [label for label in problem.space.labels if label.split("/")[0] in held]
        problem = dataclasses.replace(problem, space=problem.space.holding(labels, physical))
    evaluator = problem.training_evaluator()
    start = balanced_start(problem)[0]
    known = {name: value for name, value in TRUE.items() if name != "encoder_bias"}
    for name, value in known.items():
        physical = problem.space.to_physical(start)
        physical[problem.space[name]] = value
        start[problem.space[name]] = problem.space.to_normalised(physical)[problem.space[name]]
    best = least_squares(evaluator, [start], LeastSquaresCfg(max_iteration=iterations))[0]
    return best.x, assess(problem, problem.evaluator(), best.x, ended=best).uncertainty


def test_any_parameters_are_those_of_a_body_that_mujoco_compiles():
    link = reference()
    for seed in range(60):
        found = link.inertia(drawn(link, seed))
        spec = mujoco.MjSpec.from_string(ARM)
        body = spec.body("upper")
        body.explicitinertial, body.mass, body.ipos, body.iquat = True, found.mass, found.com, [1, 0, 0, 0]
        body.fullinertia = found.inertia
        moments = spec.compile().body("upper").inertia
        assert moments.min() > 0 and moments.sum() > 2 * moments.max()
    same = link.inertia({})
    assert same.mass == pytest.approx(1.2) and same.com == pytest.approx([0.02, 0.0, -0.15])
    assert same.inertia == pytest.approx([0.012, 0.013, 0.003, 0.0004, -0.0003, 0.0002])


def test_mass_scales_the_inertia_and_a_moved_centre_keeps_it():
    link = reference()
    heavier, moved = link.inertia({"link_mass": 2.4}), link.inertia({"link_com_x": 0.07})
    assert np.allclose(heavier.inertia, 2 * np.array(link.inertia({}).inertia)) and heavier.com == link.inertia({}).com
    assert np.allclose(moved.inertia, link.inertia({}).inertia) and moved.com[0] == pytest.approx(0.07)


def test_parameters_in_a_simulation_are_those_in_its_file_also_beside_a_load(tmp_path):
    link = reference("fore")
    values = drawn(link, 3)
    cfg = arm_cfg(tmp_path)
    cfg.scene.num_envs = 2
    written, compiled = ManagerBasedRLEnv(cfg), ManagerBasedRLEnv(arm_cfg(tmp_path, fore=link.inertia(values)))
    for env in (written, compiled):
        env.scene["robot"].add_body_mass("fore", 0.3, place=(0.05, 0.0, -0.2))
    for name, value in values.items():
        at_file = link.values[NAMES.index(name)]
        both = torch.tensor([[at_file], [value]], dtype=torch.float64)
        written.scene["robot"].write_link_parameter_to_sim([link], name, both)
    for env in (written, compiled):
        env.sim.qpos[:] = torch.tensor([0.4, -0.7])
        env.sim.forward()
    plain = ManagerBasedRLEnv(arm_cfg(tmp_path))
    plain.scene["robot"].add_body_mass("fore", 0.3, place=(0.05, 0.0, -0.2))
    for field in ("M", "qfrc_bias"):
        assert np.allclose(written.sim.bind(field)[1], compiled.sim.bind(field)[0], atol=1e-12), field
    for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        assert torch.equal(written.sim.expand(field)[0], plain.sim.expand(field)[0]), field


def test_a_load_with_a_lever_is_a_body_there(tmp_path):
    bolted = ARM.replace(
        'mass="0.1" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"', 'mass="0.6" pos="0 0 -0.0667" fullinertia="{}"'
    )
    steiner = 0.1 * 0.5 / 0.6 * 0.08**2
    bolted = bolted.format(f"{1e-4 + steiner} {1e-4 + steiner} 1e-4 0 0 0").replace("-0.0667", f"{-0.5 * 0.08 / 0.6}")
    model = mujoco.MjModel.from_xml_string(bolted)
    env = ManagerBasedRLEnv(arm_cfg(tmp_path))
    env.scene["robot"].add_body_mass("tool", 0.5, place=(0.0, 0.0, -0.08))
    own = env.sim.model_of(0)
    for field in ("body_mass", "body_ipos"):
        assert np.allclose(getattr(own, field), getattr(model, field), atol=1e-12)
    assert sorted(own.body("tool").inertia) == pytest.approx(sorted(model.body("tool").inertia), abs=1e-12)


@pytest.mark.slow
def test_candidates_have_links_of_their_own_and_the_compiled_kernel_agrees_with_python(tmp_path, monkeypatch):
    problem = make_problem(recorded(tmp_path, {}), cfg=arm_cfg(tmp_path, ["fore@mass,com"]))
    base = problem.space.to_physical(problem.space.start)
    several = base.repeat(3, 1)
    several[1, problem.space["link_mass"]] = 1.1
    several[2, problem.space["link_com_x"]] = 0.03
    compiled = problem.evaluator().residuals(several).error
    monkeypatch.setattr("pace_envs.compiled_drive.robot_kernel.CompiledRobot.positions", lambda *_: None)
    python = problem.evaluator().residuals(several).error
    assert torch.allclose(compiled, python, rtol=0.0, atol=1e-14)
    assert float((python[1] - python[0]).abs().max()) > 1e-3 < float((python[2] - python[0]).abs().max())


@pytest.mark.slow
def test_a_wrong_mass_and_centre_are_found(tmp_path):
    link = reference("fore")
    true = link.inertia({"link_mass": 0.92, "link_com_x": 0.02})
    problem = make_problem(recorded(tmp_path, {"fore": true}), cfg=arm_cfg(tmp_path, ["fore@mass,com"]))
    x, uncertainty = fit(problem, held=("armature", "viscous_friction", "friction", "delay"))
    found = problem.space.to_dict(problem.space.to_physical(x))
    std = problem.space.to_dict(torch.as_tensor(uncertainty.std))
    assert found["link_mass"]["fore"] * abs(found["link_com_z"]["fore"]) == pytest.approx(0.92 * 0.12, rel=0.02)
    assert found["link_com_x"]["fore"] == pytest.approx(0.02, abs=0.003)
    assert abs(found["link_mass"]["fore"] - 0.92) < 4 * std["link_mass"]["fore"] < 0.4
    assert "link_com_y/fore" in undetermined(problem, x, uncertainty)  # along the axes of both joints
    assert found["link_com_y"]["fore"] == pytest.approx(0.01, abs=1e-4)  # so the file's value stays
    assert std["link_com_y"]["fore"] == pytest.approx(0.25 * (link.bounds("link_com_y")[1] - 0.01), rel=0.02)


@pytest.mark.slow
def test_a_tool_s_mass_and_place_are_found(tmp_path):
    """Five times as heavy as the link that it is on, and off its centre."""
    tool = Load(added_mass={"tool": 0.5}, added_mass_at={"tool": (0.03, 0.0, -0.08)})
    recording = dataclasses.replace(recorded(tmp_path, {}, tool), load=Load())
    problem = make_problem(recording, cfg=arm_cfg(tmp_path, ["tool@load"]))
    x, uncertainty = fit(problem, held=("armature", "viscous_friction", "friction", "delay"))
    found = {name: each["tool"] for name, each in problem.space.to_dict(problem.space.to_physical(x)).items()
             if name.startswith("link")}  # fmt: skip
    assert found["link_load_mass"] == pytest.approx(0.5, rel=0.01)
    assert found["link_load_x"] == pytest.approx(0.03, abs=1e-3)
    assert found["link_load_z"] == pytest.approx(-0.08, abs=1e-3)
    assert "link_load_y/tool" in undetermined(problem, x, uncertainty)  # along the axes of both joints
    whole = problem.env_cfg.sim2real.links[0].inertia(found)
    assert whole.mass == pytest.approx(0.6, rel=0.01) and whole.com[2] == pytest.approx(-0.08 * 0.5 / 0.6, rel=0.02)


@pytest.mark.slow
def test_links_that_a_problem_holds_act_on_joints_alone_too(tmp_path):
    link = reference("fore").inertia({"link_mass": 1.6})
    problem = make_problem(recorded(tmp_path, {"fore": link}), cfg=arm_cfg(tmp_path))
    base = problem.space.from_dict(TRUE)
    plain, held = (reference_path(each, base).feel.inertia for each in (problem, problem.with_links({"fore": link})))
    assert float((held - plain).min()) > 0.01
    assert float(problem.with_links({"fore": link}).evaluator().residuals(base[None]).score[0]) < 1e-9


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        (["fore@weight"], r"'weight'. Available: mass, com, inertia"),
        (["foot"], "foot"),
    ],
)
def test_links_that_cannot_be_sought_are_refused(wanted, message):
    with pytest.raises(ValueError, match=message):
        sought_links(mujoco.MjModel.from_xml_string(ARM), JOINTS, wanted)


def test_links_are_chosen_by_expression_and_part():
    found = sought_links(mujoco.MjModel.from_xml_string(ARM), JOINTS, [".*@com", "fore@mass"])
    assert [(each.link, each.joint) for each in found] == [("upper", "shoulder"), ("fore", "elbow"), ("tool", "elbow")]
    assert found[0].names == PARTS["com"] and found[1].names == PARTS["mass"]


def test_a_result_s_links_are_in_exports_and_in_training(tmp_path):
    path = write_result(tmp_path / "result.json")
    content = json.loads(path.read_text())
    cfg = load_env_cfg("Pace-AnymalD-v0")
    model = mujoco.MjModel.from_xml_path(str(cfg.scene.robot.mjcf_path))
    found = Reference.of(model, "LF_THIGH").inertia({"link_mass": 5.0, "link_com_z": -0.05})
    content["links"] = {"LF_THIGH": dataclasses.asdict(found)}
    path.write_text(json.dumps(content))
    exported = mujoco.MjModel.from_xml_string(export(path, "mjcf", joints_only=True).text).body("LF_THIGH")
    walking = load_env_cfg("Pace-AnymalD-Velocity-v0")
    walking.scene.num_envs = 1
    use_identified(walking, path)
    env = ManagerBasedRLEnv(walking)
    for body in (exported, env.sim.model.body("LF_THIGH")):
        assert float(body.mass[0]) == pytest.approx(5.0) and body.ipos == pytest.approx(found.com, abs=1e-6)
    env.close()
    assert json.loads(export(path, "json").text)["links"]["LF_THIGH"]["mass"] == pytest.approx(5.0)
    for other in ("newton", "cfg"):
        assert any("LF_THIGH" in note and "--format mjcf" in note for note in export(path, other).notes)
    content["links"]["LF_THIGH"]["mass"] = -1.0
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="links/LF_THIGH is no rigid body"):
        IdentifiedDrives.load(path)


def test_a_load_s_place_is_read_and_refused_where_it_means_nothing():
    fields = {"added_mass": {"tool": 0.5}, "added_mass_at": {"tool": [0, 0, 0.08]}}
    assert load_of(fields, "log").added_mass_at == {"tool": (0.0, 0.0, 0.08)}
    with pytest.raises(ValueError, match="no added_mass"):
        load_of({**fields, "added_mass_at": {"hand": [0, 0, 0.08]}}, "log")
    with pytest.raises(ValueError, match=r"expected \{body: \[x, y, z\]\}"):
        load_of({**fields, "added_mass_at": {"tool": [0, 0.08]}}, "log")


def test_nothing_is_sought_without_being_asked_for():
    assert env_cfg().sim2real.links == ()


def test_all_parts_of_a_promising_link_are_fitted_and_other_links_beside_it():
    """A load beyond Bolt's shin needs the third of its candidates; UR5e's tool is on the second link of the list."""
    upper, fore = reference("upper"), reference("fore")
    of_one = [(9.0 - i, dataclasses.replace(upper, names=TEN[: i + 1])) for i in range(5)]
    listed = listed_candidates([(1.0, fore), *of_one], LinksCfg())
    assert [len(each.names) for each in listed if each.link == "upper"] == [1, 2, 3] and listed[-1].link == "fore"


def test_a_load_is_found_among_the_ten_parameters_of_its_link():
    """Residuals that are linear in the pseudo-inertia, as torques are: mass and place to the grid's last step."""
    link, rng = reference("fore"), np.random.default_rng(0)
    file = torch.tensor(link.values, dtype=torch.float64)
    loaded = file.clone()
    loaded[-4:] = torch.tensor([0.3, 0.05, -0.02, -0.31])
    rows = torch.triu_indices(4, 4)
    change = (link.pseudo_inertia(loaded) - link.pseudo_inertia(file))[rows[0], rows[1]]
    of_ten = torch.func.jacrev(link.pseudo_inertia)(file)[rows[0], rows[1], : len(TEN)]
    torques = torch.as_tensor(rng.normal(size=(40, 10))) / change.abs()
    slope = torch.as_tensor(rng.uniform(0.5, 2.0, size=10))
    jacobian, error = torques @ of_ten * slope, -torques @ change
    explained, (mass, *place) = _best_load(link, jacobian.T @ jacobian, jacobian.T @ error, slope, cfg=LinksCfg())
    assert explained == pytest.approx(float(error @ error), rel=1e-3)
    assert (mass, *place) == pytest.approx((0.3, 0.05, -0.02, -0.31), rel=0.02)


def test_a_wrong_link_is_said_in_words():
    value = {"parameter": "link_mass", "unit": "kg", "file": 0.8, "found": 0.92, "std": 0.001}
    wrong = WrongLink(link="fore", parts=("mass",), values=[value])
    said = "The model file is wrong about the link fore (mass): mass 0.92 ± 0.001 kg instead of 0.8."
    assert (wrong.label, wrong.sentence) == ("fore@mass", said)


@pytest.mark.slow
def test_a_fit_of_a_tool_begins_near_it(tmp_path):
    """Armatures and frictions took up the tool, and a fit ended in their valley, at 500 times the noise."""
    tool = Load(added_mass={"tool": 0.5}, added_mass_at={"tool": (0.03, 0.0, -0.08)})
    recording = dataclasses.replace(recorded(tmp_path, {}, tool, noise=1e-4), load=Load())
    space = (problem := make_problem(recording, cfg=arm_cfg(tmp_path, ["tool@load"]))).space
    start = space.to_dict(space.to_physical(balanced_start(problem)[0]))
    assert start["link_load_mass"]["tool"] == pytest.approx(0.5, rel=0.1)
    assert start["link_load_x"]["tool"] == pytest.approx(0.03, abs=0.01)
    assert start["link_load_z"]["tool"] == pytest.approx(-0.08, abs=0.01)
    assert start["friction"]["shoulder"] == pytest.approx(0.1, rel=0.5)


@pytest.mark.slow
def test_a_known_load_stays_where_a_fit_of_its_link_begins(tmp_path):
    true = {"fore": reference("fore").inertia({"link_mass": 0.92})}
    known = Load(added_mass={"fore": 0.6}, added_mass_at={"fore": (0.0, 0.0, -0.25)})
    problem = make_problem(recorded(tmp_path, true, known, noise=1e-4), cfg=arm_cfg(tmp_path, ["fore@mass"]))
    start = problem.space.to_dict(problem.space.to_physical(balanced_start(problem)[0]))
    assert start["link_mass"]["fore"] == pytest.approx(0.92, rel=0.1)
    assert start["armature"]["elbow"] == pytest.approx(0.02, rel=0.5)
    assert start["friction"]["elbow"] == pytest.approx(0.1, rel=0.5)


@pytest.mark.slow
def test_a_fit_of_two_wrong_links_begins_near_them(tmp_path):
    true = {
        "upper": reference("upper").inertia({"link_mass": 1.8}),
        "fore": reference("fore").inertia({"link_com_x": 0.05}),
    }
    problem = make_problem(recorded(tmp_path, true, noise=1e-4), cfg=arm_cfg(tmp_path, ["upper@mass", "fore@com"]))
    start = problem.space.to_dict(problem.space.to_physical(balanced_start(problem)[0]))
    assert start["link_mass"]["upper"] == pytest.approx(1.8, rel=0.1)
    assert start["link_com_x"]["fore"] == pytest.approx(0.05, abs=0.01)


@pytest.mark.slow
def test_a_diagnosis_names_a_tool_that_the_file_lacks(tmp_path, monkeypatch):
    monkeypatch.setattr("pace_optim.diagnosis.wrong_links.LOOK_ALIKES", ("torque_gain",))
    tool = Load(added_mass={"tool": 0.3}, added_mass_at={"tool": (0.03, 0.0, -0.08)})
    recording = dataclasses.replace(recorded(tmp_path, {}, tool, noise=1e-4), load=Load())
    problem = make_problem(recording, cfg=arm_cfg(tmp_path), train_fraction=0.6)
    x, _ = fit(problem)
    found = find_wrong_links(problem, problem.space.to_physical(x), cfg=DiagnosisCfg(links=LinksCfg(tried=2)))
    assert [each.label for each in found.wrong] == ["fore@load"]  # the tool is fixed to it
    assert found.values["link_load_mass"]["fore"] == pytest.approx(0.3, rel=0.03)
    assert found.after < 3e-4 < found.before  # a second of one motion
    assert found.wrong[0].sentence.startswith("The link fore carries 0.") and "(not shown)" in found.wrong[0].sentence


@pytest.mark.slow
def test_what_one_number_on_a_joint_explains_as_well_is_no_wrong_link(tmp_path):
    """Two wrong torques of a robot were two wrong links, which left a ninth of the error."""
    recording = dataclasses.replace(recorded(tmp_path, {}, noise=1e-4), drive=Drive(stiffness=np.array([30.0, 25.0])))
    problem = make_problem(recording, cfg=arm_cfg(tmp_path), train_fraction=0.6)
    x, _ = fit(problem, iterations=4)
    said: list[str] = []
    assert find_wrong_links(problem, problem.space.to_physical(x), said.append) == LinkFindings()
    assert said == ["looking for wrong masses in the model file"]


def test_a_diagnosis_names_no_link_of_a_file_that_is_right(tmp_path):
    problem = make_problem(recorded(tmp_path, {}, noise=1e-4), cfg=arm_cfg(tmp_path), train_fraction=0.6)
    assert find_wrong_links(problem, problem.space.from_dict(TRUE)) == LinkFindings()
