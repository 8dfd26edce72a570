"""The robot in 3-D moves in the browser as MuJoCo moves it."""

import mujoco
import numpy as np
import pytest
import torch
from browser import CHROMIUM, Browser

from pace_actuators import PaceDCMotor, PaceDCMotorCfg
from pace_actuators.files import write_tensors
from pace_envs.closed_loops import ClosedLoops
from pace_envs.model_file import read_model_file
from pace_optim.commands.replay import main
from pace_optim.report import write_report
from pace_optim.report.motion import looks_of, motions_of, scene_of
from pace_optim.report.motion.motion import add_ghost
from pace_optim.run.tensors import RecordingData

from run_folders import JOINTS, make_trajectory, write_run  # isort: skip

LEG = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 0.5" quat="0.9 0.1 -0.2 0.3">
      <geom type="box" size="0.1 0.05 0.03"/>
      <body name="thigh" pos="0.1 0 0" euler="10 20 30">
        <joint name="hip" axis="0 1 0" pos="0.01 0.02 0.03"/>
        <joint name="knee" axis="1 0 0.5"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02"/>
        <body name="foot" pos="0 0 -0.2">
          <joint name="ankle" type="slide" axis="0 0 1" ref="0.1"/>
          <geom type="ellipsoid" size="0.02 0.03 0.04" quat="0.7 0.7 0 0"/>
          <geom type="cylinder" size="0.01 0.05"/><geom type="sphere" size="0.03"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
BASE = (0.3, -0.2, 0.1, 0.6, 0.0, 0.8, 0.0)
"""Where the base is: position [m] and quaternion."""
FOUR_BAR = """
<mujoco>
  <worldbody>
    <body name="crank"><joint name="crank" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .1" size=".01"/>
      <body name="rod" pos="0 0 .1"><joint name="rod" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".01"/></body>
    </body>
    <body name="rocker" pos=".3 0 0"><joint name="rocker" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 .1" size=".01"/></body>
  </worldbody>
  <equality><connect body1="rod" body2="rocker" anchor=".3 0 0"/></equality>
</mujoco>
"""


def recording(n: int, samples: int = 400, seed: int = 0) -> RecordingData:
    rng = np.random.default_rng(seed)
    time = 3.0 + np.arange(samples) * 0.005
    phase, tempo = rng.uniform(0, 6, n), rng.uniform(2, 5, n)
    measured = 0.4 * np.sin(tempo * time[:, None] + phase)
    error = 0.01 * np.cos(7 * time[:, None] + phase)
    train = np.ones(samples, dtype=bool)
    series = {"target": measured, "measured": measured, "simulated": measured + error}
    return RecordingData(name="chirp", time=time, **series, train=train, held_out=~train, enabled=train)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A run's report with a replay, in a browser."""
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here: apt-get install chromium")
    folder = write_run(tmp_path_factory.mktemp("logs") / "leg" / "26_01_01_00-00-00")
    mujoco.mj_saveModel(mujoco.MjModel.from_xml_string(LEG), str(folder / "model.mjb"), None)
    content = make_trajectory()
    for entry in content["recordings"]:
        count = len(entry["time"])
        entry |= {
            "base": torch.tensor(BASE, dtype=torch.float64).repeat(count, 1),
            "standing": torch.ones(count, 1, dtype=torch.bool),
            "feet": [{"body": "foot", "pos": [0.0, 0.0, -0.1]}],
        }
    write_tensors(folder / "best_trajectory.pt", content)
    browser = Browser(tmp_path_factory.mktemp("profile"))
    try:
        browser.open(write_report(folder), ready="document.documentElement?.dataset.drawn === 'true'")
        yield browser
        assert not browser.problems
    finally:
        browser.close()


@pytest.mark.slow
@pytest.mark.parametrize("which", ["measured", "simulated"])
def test_bodies_stand_in_the_browser_where_mujoco_puts_them(page, which):
    model = mujoco.MjModel.from_xml_string(LEG)
    content = page.evaluate("JSON.parse(document.querySelector('.replay script').textContent)")
    assert content["joints"] == list(JOINTS)
    shown = page.evaluate(
        f"[0.0, 0.5, 1.0].map((t) => document.querySelector('.replay').replay.poses('{which}', t)"
        ".map((body) => [...body.pos, ...body.quat]))"
    )
    joints = page.evaluate(
        "[0.0, 0.5, 1.0].map((t) => { const r = document.querySelector('.replay').replay;"
        f"return r.joints('{which}', t); }})"
    )
    data = mujoco.MjData(model)
    for poses, qpos in zip(shown, joints, strict=True):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        poses = np.array(poses)
        place, turned = np.empty((model.nbody, 3)), np.empty((model.nbody, 4))
        for b in range(model.nbody):
            mujoco.mju_rotVecQuat(place[b], data.xpos[b], np.array(BASE[3:]))
            mujoco.mju_mulQuat(turned[b], np.array(BASE[3:]), data.xquat[b])
        assert poses[:, :3] == pytest.approx(place + BASE[:3], abs=1e-5)
        same_turn = np.abs((poses[:, 3:] * turned).sum(axis=1))  # q and -q are one rotation
        assert same_turn == pytest.approx(1.0, abs=1e-5)


def test_the_picture_is_not_empty_and_moves(page):
    look = (
        "(() => { const c = document.querySelector('.replay canvas'), gl = c.getContext('webgl');"
        "const p = new Uint8Array(4 * c.width * c.height); "
        "gl.readPixels(0, 0, c.width, c.height, gl.RGBA, gl.UNSIGNED_BYTE, p);"
        "let hash = 0, drawn = 0; for (let i = 0; i < p.length; i += 4) { drawn += p[i + 3] > 0;"
        "hash = (hash * 31 + p[i] + 7 * p[i + 1] + 13 * p[i + 2]) | 0; } return [drawn, hash]; })()"
    )
    page.evaluate("document.querySelector('.replay').replay.seek(0)")
    drawn, first = page.evaluate(look)
    assert drawn > 2000
    page.evaluate("document.querySelector('.replay').replay.seek(1.3)")
    assert page.evaluate(look)[1] != first


def test_play_goes_on_and_pause_stops(page):
    page.evaluate("document.querySelector('.replay').replay.seek(0)")
    page.click("document.querySelector('.replay .play')")
    page.evaluate("new Promise((done) => setTimeout(done, 300))")
    page.click("document.querySelector('.replay .play')")
    at = page.evaluate("document.querySelector('.replay').replay.state.at")
    assert 0.05 < at < 3.0
    assert page.evaluate("document.querySelector('.replay').replay.state.at") == at


def test_joints_stand_where_an_encoder_with_bias_shows_what_was_measured():
    """The bias was taken off once more: joints stood beside the true position by twice the bias."""
    bias = [0.02, 0.0, -0.01]
    drive = PaceDCMotor(PaceDCMotorCfg(joint_names_expr=".*", encoder_bias=bias), JOINTS, slice(None), 1)
    shown = recording(3)
    (motion,) = motions_of(mujoco.MjModel.from_xml_string(LEG), JOINTS, [shown], bias)
    assert motion.time[0] == 0.0
    for joints, encoder in ((motion.measured, shown.measured), (motion.simulated, shown.measured + shown.error)):
        position = torch.tensor(joints[:1])
        read = drive.observe(position, torch.zeros_like(position)) - drive.encoder_bias
        assert read[0].numpy() == pytest.approx(encoder[0])


def test_joints_of_a_closed_chain_that_no_encoder_measures_follow():
    model = mujoco.MjModel.from_xml_string(FOUR_BAR)
    (motion,) = motions_of(model, ["crank"], [recording(1)], [0.0])
    data = mujoco.MjData(model)
    for qpos in motion.simulated[:: len(motion.time) // 7]:
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        assert np.abs(data.efc_pos[: data.ne]).max() < 1e-6
    assert np.ptp(motion.simulated[:, 2]) > 0.1


FINGERS = "".join(
    f'<body name="{side}" pos="0 {y} 0"><joint name="{side}" type="slide" axis="0 1 0"/><geom size=".01"/></body>'
    for side, y in (("left", 0.2), ("right", -0.2))
)
SECOND = FOUR_BAR.partition("<worldbody>")[2].partition("</worldbody>")[0]
for part in ("crank", "rod", "rocker"):
    SECOND = SECOND.replace(f'"{part}"', f'"{part}2"')


@pytest.mark.parametrize(
    ("bodies", "equality", "encoders"),
    [
        (FINGERS, '<joint joint1="left" joint2="right"/>', ["left", "right"]),
        (SECOND, '<connect body1="rod2" body2="rocker2" anchor=".3 0 0"/>', ["crank2", "rocker2"]),
    ],
    ids=["two measured joints", "two encoders of one freedom"],
)
def test_a_constraint_that_encoders_contradict_leaves_other_loops_closed(bodies, equality, encoders, monkeypatch):
    """No step lowered the largest gap: the passive joints of all loops stood still."""
    looked, constraints = [], ClosedLoops._constraints
    monkeypatch.setattr(ClosedLoops, "_constraints", lambda *args: looked.append(0) or constraints(*args))
    text = FOUR_BAR.replace("</worldbody>", f"{bodies}</worldbody>").replace("</equality>", f"{equality}</equality>")
    model = mujoco.MjModel.from_xml_string(text)
    (motion,) = motions_of(model, ["crank", *encoders], [recording(3)], [0.0, 0.0, 0.0])
    postures = len(motion.measured) + len(motion.simulated)
    assert len(looked) < 20 * postures
    data = mujoco.MjData(model)
    for qpos in motion.simulated[:: len(motion.time) // 7]:
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        gaps = np.abs(data.efc_pos[: data.ne])[data.efc_id[: data.ne] == 0]
        assert len(gaps) == 3 and gaps.max() < 1e-6
    assert np.ptp(motion.simulated[:, 2]) > 0.1


def test_a_joint_that_the_model_does_not_have_is_told_of():
    with pytest.raises(ValueError, match=r"elbow: neither a hinge or slide joint .* Joints: hip, knee, ankle"):
        motions_of(mujoco.MjModel.from_xml_string(LEG), ["elbow"], [recording(1)], [0.0])


def ball(rings: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a ball of 0.1 m."""
    up, around = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, rings), indexing="ij")
    points = 0.1 * np.stack([np.sin(up) * np.cos(around), np.sin(up) * np.sin(around), np.cos(up)], axis=-1)
    i, j = (each.ravel() for each in np.meshgrid(np.arange(rings - 1), np.arange(rings - 1), indexing="ij"))
    a = i * rings + j
    faces = np.concatenate([np.stack([a, a + rings, a + 1], 1), np.stack([a + 1, a + rings, a + rings + 1], 1)])
    return points.reshape(-1, 3), faces


def test_a_fine_mesh_is_drawn_with_fewer_triangles():
    vertices, faces = ball()
    spec = mujoco.MjSpec()
    mesh = spec.add_mesh(name="ball", uservert=vertices.ravel().tolist(), userface=faces.ravel().tolist())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.worldbody.add_body(name="ball").add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="ball")
    (geom,) = scene_of(spec.compile())["geoms"]
    drawn, triangles = np.array(geom["vertices"]).reshape(-1, 3), np.array(geom["faces"]).reshape(-1, 3)
    assert geom["shape"] == "mesh" and triangles.max() < len(drawn) and 500 < len(triangles) <= 1500
    assert np.linalg.norm(drawn, axis=1) == pytest.approx(0.1, abs=0.005)


BARE = """
<mujoco>
  <worldbody>
    <body name="base"><inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/>
      <body name="thigh" pos="0 0.1 0"><joint name="hip" axis="0 1 0"/>
        <inertial pos="0 0 -.1" mass="1" diaginertia=".01 .01 .01"/>
        <body name="shin" pos="0 0 -0.3"><joint name="knee" axis="0 1 0" pos="0.02 0 0"/>
          <inertial pos="0 0 -.2" mass="1" diaginertia=".01 .01 .01"/></body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def test_links_without_a_shape_have_bones_from_joint_to_joint():
    scene = scene_of(mujoco.MjModel.from_xml_string(BARE))
    thigh, shin = (
        next(g for g in scene["geoms"] if scene["bodies"][g["body"]]["name"] == n) for n in ("thigh", "shin")
    )
    assert thigh["shape"] == shin["shape"] == "capsule"
    assert thigh["pos"] == pytest.approx([0.01, 0, -0.15]) and thigh["size"][1] == pytest.approx(
        0.5 * np.hypot(0.3, 0.02)
    )
    assert shin["pos"] == pytest.approx([0.01, 0, -0.1])  # to its centre of mass
    assert 0.4 < scene["size"] < 0.8 and scene["center"][2] == pytest.approx(-0.25, abs=0.05)


def test_a_urdf_s_meshes_are_drawn_though_the_dynamics_leave_them_out(tmp_path):
    vertices, faces = ball(12)
    rows = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "ball.obj").write_text("\n".join(rows))
    mesh = '<visual><origin xyz="0 0 0.2" rpy="0 0 1.5708"/><geometry><mesh filename="package://bot/meshes/{}"/></geometry></visual>'
    mass = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
    joint = '<joint name="{0}" type="continuous"><parent link="{1}"/><child link="{2}"/><axis xyz="0 1 0"/></joint>'
    (tmp_path / "bot.urdf").write_text(
        f'<robot name="bot"><link name="world"/><link name="arm">{mass}{mesh.format("ball.dae")}</link>'
        f'<link name="hand">{mass}{mesh.format("gone.stl")}</link>'
        f"{joint.format('shoulder', 'world', 'arm')}{joint.format('elbow', 'arm', 'hand')}</robot>"
    )
    model = read_model_file(tmp_path / "bot.urdf").spec.compile()
    shapes = {model.body(geom["body"]).name: geom for geom in scene_of(model, looks_of(tmp_path / "bot.urdf"))["geoms"]}
    assert shapes["arm"]["shape"] == "mesh" and shapes["arm"]["pos"][2] == pytest.approx(0.2, abs=0.01)
    assert shapes["hand"]["shape"] == "capsule"


def test_a_link_with_a_mesh_that_cannot_be_read_is_not_in_two_pieces(tmp_path):
    vertices, faces = ball(12)
    rows = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    for name in ("ball.obj", "rod.obj"):  # up is y in rod.glb, so this is not the same
        (tmp_path / name).write_text("\n".join(rows))
    mass = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
    mesh = '<visual><geometry><mesh filename="{}"/></geometry></visual>'
    (tmp_path / "bot.urdf").write_text(
        f'<robot name="bot"><link name="world"/><link name="arm">{mass}{mesh.format("ball.obj")}'
        f'{mesh.format("package://bot/rod.glb")}</link><joint name="shoulder" type="continuous"><parent link="world"/>'
        '<child link="arm"/><axis xyz="0 1 0"/></joint></robot>'
    )
    looks = looks_of(tmp_path / "bot.urdf")
    scene = scene_of(read_model_file(tmp_path / "bot.urdf").spec.compile(), looks)
    assert looks.unread == {"arm": ["rod.glb"]}
    assert {geom["shape"] for geom in scene["geoms"]} == {"mesh", "capsule"}


def test_a_missing_mesh_of_a_model_file_leaves_the_others(tmp_path):
    vertices, faces = ball(12)
    rows = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (tmp_path / "ball.obj").write_text("\n".join(rows))
    (tmp_path / "bot.xml").write_text(
        '<mujoco><asset><mesh file="ball.obj"/><mesh name="rod" file="rod.stl"/></asset><worldbody>'
        '<body name="arm"><joint/><geom type="mesh" mesh="ball"/></body>'
        '<body name="hand"><joint/><geom type="mesh" mesh="rod"/></body></worldbody></mujoco>'
    )
    looks = looks_of(tmp_path / "bot.xml")
    assert looks.unread == {"hand": ["rod.stl"]} and looks.model.ngeom == 1


def test_a_run_without_a_model_has_no_replay(tmp_path):
    folder = write_run(tmp_path / "leg" / "26_01_01_00-00-00")
    assert 'class="replay"' not in write_report(folder).read_text("utf-8")


def test_the_command_writes_a_page_of_its_own(tmp_path, monkeypatch, capsys):
    folder = write_run(tmp_path / "leg" / "26_01_01_00-00-00")
    mujoco.mj_saveModel(mujoco.MjModel.from_xml_string(LEG), str(folder / "model.mjb"), None)
    monkeypatch.setattr("sys.argv", ["replay", str(folder), "--viewer", "none"])
    main()
    page = (folder / "replay.html").read_text("utf-8")
    assert 'class="replay"' in page and "Plotly" not in page and len(page) < 200_000
    assert capsys.readouterr().out.splitlines()[-1] == f"run: {folder}"
    elsewhere = tmp_path / "new" / "folder" / "x.html"
    monkeypatch.setattr("sys.argv", ["replay", str(folder), "--viewer", "none", "--output", str(elsewhere)])
    main()
    assert elsewhere.read_text("utf-8") == page


def test_without_a_model_the_command_says_so(tmp_path, monkeypatch):
    folder = write_run(tmp_path / "leg" / "26_01_01_00-00-00")
    monkeypatch.setattr("sys.argv", ["replay", str(folder), "--viewer", "none"])
    with pytest.raises(ValueError, match=r"no compiled model to draw"):
        main()
    assert not (folder / "replay.html").exists()


def test_the_ghost_of_mujoco_s_viewer_stands_where_it_was_measured():
    model = mujoco.MjModel.from_xml_string(LEG)
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, maxgeom=50)
    data.qpos[:] = (0.3, -0.4, 0.15)
    add_ghost(model, data, scene)
    moving = data.geom_xpos[1:]  # all but the box on the base
    assert np.array([scene.geoms[i].pos for i in range(scene.ngeom)]) == pytest.approx(moving, abs=1e-6)
    assert scene.geoms[0].rgba[3] < 0.5


def test_a_damaged_model_is_told_of(tmp_path, monkeypatch):
    folder = write_run(tmp_path / "leg" / "26_01_01_00-00-00")
    (folder / "model.mjb").write_bytes(b"no model")
    monkeypatch.setattr("sys.argv", ["replay", str(folder), "--viewer", "none"])
    with pytest.raises(ValueError, match=r"model\.mjb is damaged"):
        main()
