"""A robot that turns and slides: what is said of each joint is in its own unit, from the log to the last picture."""

import json
import re

import matplotlib
import mujoco
import numpy as np
import pytest
from command_lines import run_script
from diagnoses import make_diagnosis
from log_reading import load_recordings
from models import GANTRY
from report_pages import contents_of

from pace_actuators.files import write_json
from pace_actuators.joint_units import units_for
from pace_optim.data_collection import plot_motion
from pace_optim.motion.signals import Trajectory
from pace_optim.recording.conform import check_motion
from pace_optim.recording.logs import Robot
from pace_optim.report import report_text
from pace_optim.report.plots import plot_trajectories
from pace_optim.run.result import FitResult
from pace_optim.run.tensors import read_trajectory

matplotlib.use("Agg")
BOTH = ("slide", "hinge")


@pytest.mark.parametrize(
    ("hinge", "both"),
    [
        ("0.12 mrad", "0.12 mrad or mm"),
        ("N m s/rad", "N m s/rad or N s/m"),
        ("score [rad²]", "score [rad² or m²]"),
        ("rad/s", "rad/s or m/s"),
        ("kg m^2", "kg m^2 or kg"),
        ("a gradient of the radius", "a gradient of the radius"),
    ],
)
def test_what_is_of_joints_of_both_kinds_has_both_units(hinge, both):
    assert units_for(hinge, BOTH) == both
    assert units_for(hinge, ()) == units_for(hinge, ["hinge"]) == hinge


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """The gantry's own MuJoCo, friction on both joints: a .csv whose carriage is in mm, without a unit."""
    folder = tmp_path_factory.mktemp("gantry")
    (folder / "gantry.xml").write_text(GANTRY)
    model = mujoco.MjModel.from_xml_string(GANTRY)
    model.opt.timestep = 5e-4
    model.dof_frictionloss[:] = 3.0, 0.3
    data, rows = mujoco.MjData(model), []
    noise = np.random.default_rng(0).standard_normal((1600, 2)) * (2e-5, 1e-4)
    for k in range(1600):
        time = k * 0.0025
        data.ctrl[:] = 0.15 * np.sin(2 * np.pi * (0.4 * time + 0.2 * time**2)), 0.6 * np.sin(4 * time + time**2)
        rows.append([time, *(1e3, 1.0) * (data.qpos + noise[k]), *(1e3, 1.0) * data.ctrl])
        mujoco.mj_step(model, data, 5)
    header = "time,axis_pos,swing_pos,axis_cmd,swing_cmd"
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=header, comments="", fmt="%.7f")
    return folder


@pytest.fixture(scope="module")
def fitted(log):
    """A fit of it, with what was printed."""
    words = ("--task", log / "gantry.xml", "--data", log / "log.csv", "--optimizer", "least_squares")
    done = run_script("fit", *words, "--log_dir", log / "logs", cwd=log)
    assert done.returncode == 0, done.stderr
    run = next((log / "logs").rglob("result.json")).parent
    return run, done.stdout + done.stderr


def test_a_column_without_a_unit_is_millimetres_where_metres_leave_the_slides_range(log):
    robot = Robot(joint_names=("axis", "swing"), limits=np.array([[-0.3, 0.3], [-np.inf, np.inf]]), joint_types=BOTH)
    said = []
    (recording,) = load_recordings(log / "log.csv", robot, None, said.append)
    assert 0.1 < np.abs(recording.dof_pos[:, 0]).max() < 0.3 < np.abs(recording.dof_pos[:, 1]).max()
    assert np.abs(recording.des_dof_pos[:, 0]).max() == pytest.approx(0.15, rel=1e-2)
    assert "read as millimetres" in " ".join(said) and "degrees" not in " ".join(said)


@pytest.mark.slow
def test_the_fit_tells_each_in_its_unit(fitted):
    _, said = fitted
    assert "train / validation [mrad]" in said and "train / validation [mm]" in said
    assert re.search(r"error, all joints: \S+ / \S+ mrad or mm \(train / validation\); score \S+ rad² or m²", said)


@pytest.mark.slow
def test_the_comparison_tells_each_in_its_unit(fitted):
    run, _ = fitted
    done = run_script("compare", run)
    assert done.returncode == 0, done.stderr
    rows = {line.split()[0]: line for line in done.stdout.splitlines() if line.strip()}
    assert rows["axis"].startswith("axis [mm] ") and rows["swing"].startswith("swing [mrad] ")
    assert rows["joint"].endswith("[mrad or mm]")
    joints = json.loads((run / "comparison.json").read_text())["joints"]
    units = {name: {d: each["unit"] for d, each in joint["where"].items()} for name, joint in joints.items()}
    assert (units["axis"]["position"], units["axis"]["velocity"], units["axis"]["load"]) == ("m", "m/s", "N")
    assert (units["swing"]["position"], units["swing"]["velocity"], units["swing"]["load"]) == ("rad", "rad/s", "N m")
    for joint, theirs in (("axis", r"rad\b|N m\b"), ("swing", r"\d (m|mm|µm|m/s|N)\b(?! m)")):
        assert not re.search(theirs, json.dumps({key: joints[joint][key] for key in ("sentence", "places")}))
    page = report_text(run).decode()
    assert "<b>axis [mm]</b>" in page and "<b>swing [mrad]</b>" in page
    assert "Armature <small>kg</small>" in page and "Armature <small>kg m²</small>" in page  # an axis for each
    data = contents_of(page)
    assert '"position_unit":"m"' in data and '"position_unit":"rad"' in data
    assert "position [m]" in data and "position [rad]" in data and "load force [N]" in data


@pytest.mark.slow
def test_its_pictures_name_the_unit_of_each_axis(fitted, tmp_path):
    run, _ = fitted
    types = FitResult.load(run).joint_types
    assert types == BOTH
    (figure,) = plot_trajectories(read_trajectory(run), joint_types=types).values()
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels[:4] == ["position [m]", "error [mm]", "position [rad]", "error [mrad]"]
    assert re.search(r"\d (m|µ)m,", figure.axes[0].get_title("right"))
    assert re.search(r"\d (m|µ)rad,", figure.axes[2].get_title("right"))
    done = run_script(
        "plot_trajectory", "--robot_name", "gantry", "--log_dir", run.parents[1], "--headless", "--output", tmp_path
    )
    assert done.returncode == 0 and len(list(tmp_path.glob("*.png"))) == 2, done.stderr


def test_a_motion_to_be_recorded_is_drawn_in_metres(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", lambda self, *_, **__: drawn.append(self))
    time = np.arange(100) * 0.01
    trajectory = Trajectory(name="up", joint_names=("axis", "swing"), time=time, des_dof_pos=np.outer(time, [0.1, 1.0]))
    plot_motion(tmp_path / "a.png", trajectory, title="up", joint_types=BOTH)
    assert [axes.get_ylabel() for axes in drawn[0].axes] == ["position [m]", "position [rad]"]


def test_a_diagnosis_tells_each_in_its_unit(fitted):
    run, _ = fitted
    content = make_diagnosis("unknown")
    joints = dict(zip(("axis", "swing"), list(content["joints"].values()), strict=False))
    joints = {name: each | {"type": kind} for (name, each), kind in zip(joints.items(), BOTH, strict=True)}
    content |= {"joints": joints, "ranking": [], "sizes": []}
    content["error_map"] = {"axis": next(iter(content["error_map"].values()))}
    write_json(run / "diagnosis.json", content)
    page = report_text(run).decode()
    (run / "diagnosis.json").unlink()
    assert "<b>axis [mm]</b>" in page and "before [mrad or mm]" in page
    assert "friction [N]" in page


def test_a_carriage_far_from_its_target_is_not_told_in_radians(fitted, log):
    robot = Robot(joint_names=("axis", "swing"), limits=None, joint_types=BOTH)
    (recording,) = load_recordings(log / "log.csv", robot, None, lambda _: None)
    still = recording.dof_pos.copy()
    still[:, 0] = recording.dof_pos[0, 0]
    (note,) = check_motion(recording.__class__(**(vars(recording) | {"dof_pos": still})), None, 0.2, BOTH)
    assert note.startswith("axis: moves less than 2 mm")
    beyond = np.array([[-1e-3, 1e-3], [-np.inf, np.inf]])
    with pytest.raises(ValueError, match=r"axis goes from \S+ to \S+ m; expected -0.001 to 0.001 m"):
        check_motion(recording, beyond, 0.01, BOTH)
