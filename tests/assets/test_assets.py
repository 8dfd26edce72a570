"""The MJCF models carry the published figures, collide only as intended, and hold to closed forms."""

import json
import re

import mujoco
import numpy as np
import pytest
from places import ROOT, SHARED

ASSETS = ROOT / "assets"
FIGURES = SHARED / "robots"

ROBOTS = ("anymal_d", "go2", "so101")
LEGS = {"anymal_d": ("LF", "RF", "LH", "RH"), "go2": ("FL", "FR", "RL", "RR")}
GRAVITY = 9.81

# posture, base height that puts the lowest feet on the ground, stiffness, damping, armature, effort limit
STANDING = {
    "anymal_d": (
        {"_HAA": 0.0, "F_HFE": 0.4, "H_HFE": -0.4, "F_KFE": -0.8, "H_KFE": 0.8},
        0.5885,
        (85.0, 4.0, 0.1, 80.0),
    ),
    "go2": (
        {"L_hip": 0.1, "R_hip": -0.1, "^F._thigh": 0.8, "^R._thigh": 1.0, "_calf": -1.5},
        0.3235,
        (25.0, 1.0, 0.01, 23.5),
    ),
}


def load_spec(robot: str) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_file(str(ASSETS / robot / f"{robot}.xml"))


def load_model(robot: str) -> mujoco.MjModel:
    return load_spec(robot).compile()


def load_figures(robot: str) -> dict:
    path = FIGURES / f"{robot}.json"
    if not path.exists():
        pytest.skip(f"the published figures are not at {path}")
    return json.loads(path.read_text())


def rotation(quat) -> np.ndarray:
    quat = np.asarray(quat, dtype=float)
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat / np.linalg.norm(quat))
    return matrix.reshape(3, 3)


def inertia_tensor(quat, principal) -> np.ndarray:
    axes = rotation(quat)
    return axes @ np.diag(principal) @ axes.T


def with_ground(robot: str) -> mujoco.MjModel:
    spec = load_spec(robot)
    spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], contype=1, conaffinity=1
    )
    return spec.compile()


@pytest.mark.parametrize("robot", ROBOTS)
def test_body_tree_frames_and_inertials_are_the_published_ones(robot):
    figures, model = load_figures(robot), load_model(robot)

    assert [model.body(i).name for i in range(1, model.nbody)] == [body["name"] for body in figures["bodies"]]
    for figure in figures["bodies"]:
        body = model.body(figure["name"])
        assert model.body(body.parentid[0]).name == figure["parent"]
        np.testing.assert_allclose(body.pos, figure["pos"], atol=1e-6)
        np.testing.assert_allclose(rotation(body.quat), rotation(figure["quat"]), atol=1e-6)
        np.testing.assert_allclose(body.mass, figure["mass"], rtol=1e-6)
        np.testing.assert_allclose(body.ipos, figure["com"], atol=1e-6)
        published = inertia_tensor(figure["inertia_quat"], figure["principal_inertia"])
        np.testing.assert_allclose(inertia_tensor(body.iquat, body.inertia), published, atol=1e-6 * np.trace(published))


@pytest.mark.parametrize("robot", ROBOTS)
def test_joints_are_the_published_ones_and_carry_no_drive_dynamics(robot):
    figures, model = load_figures(robot), load_model(robot)

    hinges = [model.joint(i) for i in range(model.njnt) if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE]
    assert {joint.name for joint in hinges} == {joint["name"] for joint in figures["joints"]}
    for figure in figures["joints"]:
        joint = model.joint(figure["name"])
        assert model.body(joint.bodyid[0]).name == figure["body"]
        assert model.jnt_limited[joint.id]
        np.testing.assert_allclose(joint.axis, figure["axis"], atol=1e-6)
        np.testing.assert_allclose(joint.range, figure["range"], atol=1e-6)
        np.testing.assert_allclose(joint.pos, 0)
    for field in (model.dof_armature, model.dof_damping, model.dof_frictionloss, model.jnt_stiffness):
        assert not np.any(field)


@pytest.mark.parametrize("robot", ROBOTS)
def test_collision_geoms_are_the_published_ones(robot):
    figures, model = load_figures(robot), load_model(robot)

    colliding = [model.geom(i) for i in range(model.ngeom) if model.geom_conaffinity[i]]
    published = figures.get("collision_geoms", [])
    assert len(colliding) == len(published)
    assert len({geom.name for geom in colliding} - {""}) == len(colliding), "collision geoms are named"
    for body in figures["bodies"]:
        ours = [geom for geom in colliding if model.body(geom.bodyid[0]).name == body["name"]]
        theirs = [geom for geom in published if geom["body"] == body["name"]]
        for geom, figure in zip(ours, theirs, strict=True):
            assert geom.type[0] == getattr(mujoco.mjtGeom, f"mjGEOM_{figure['type'].upper()}")
            assert geom.group[0] == 3
            np.testing.assert_allclose(geom.size, figure["size"], atol=1e-6)
            np.testing.assert_allclose(geom.pos, figure["pos"], atol=1e-6)
            if figure["type"] != "sphere":
                np.testing.assert_allclose(rotation(geom.quat), rotation(figure["quat"]), atol=1e-6)


@pytest.mark.parametrize("robot", (*ROBOTS, "test_bench"))
def test_models_are_primitive_without_actuators_and_draw_without_contact(robot):
    model = load_model(robot)

    assert model.nmesh == 0 and model.nhfield == 0 and model.nu == 0
    assert model.opt.timestep == 0.0025
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    drawn = model.geom_group == 2
    assert drawn.any()
    assert not model.geom_contype[drawn].any() and not model.geom_conaffinity[drawn].any()
    assert model.camera("track") is not None
    assert model.mat("ground") is not None


@pytest.mark.parametrize("robot", LEGS)
def test_legged_base_is_free_until_the_root_joint_is_deleted(robot):
    spec = load_spec(robot)
    assert spec.compile().nv == 18

    spec.delete(spec.joint("root"))
    assert spec.compile().nv == 12


@pytest.mark.parametrize("robot", LEGS)
def test_feet_meet_the_ground_and_robot_geoms_never_meet_one_another(robot):
    model = with_ground(robot)
    data = mujoco.MjData(model)
    ground = model.geom("ground").id
    feet = {model.geom(f"{leg}_foot").id for leg in LEGS[robot]}
    rng = np.random.default_rng(0)

    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    lower, upper = np.clip(model.jnt_range[hinges], -np.pi, np.pi).T
    touched = set()
    for _ in range(200):
        data.qpos[7:] = rng.uniform(lower, upper)
        data.qpos[2] = 0
        mujoco.mj_kinematics(model, data)
        # the lowest foot reaches 1 mm into the ground, whatever else is under it
        data.qpos[2] = -0.001 - min(data.geom_xpos[foot, 2] - model.geom_size[foot, 0] for foot in feet)
        mujoco.mj_forward(model, data)
        pairs = [contact.geom for contact in data.contact]
        assert all(ground in pair for pair in pairs)
        touched |= {geom for pair in pairs for geom in pair}
    assert feet <= touched


@pytest.mark.parametrize("robot", LEGS)
def test_foot_contact_has_the_friction_of_the_foot(robot):
    model = with_ground(robot)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    data.qpos[2] -= min(data.geom(f"{leg}_foot").xpos[2] for leg in LEGS[robot])
    mujoco.mj_forward(model, data)

    feet = {model.geom(f"{leg}_foot").id for leg in LEGS[robot]}
    contacts = [contact for contact in data.contact if feet & set(contact.geom)]
    assert contacts
    for contact in contacts:
        assert contact.dim == 3
        np.testing.assert_allclose(contact.friction[:2], 0.8)


@pytest.mark.parametrize("robot", LEGS)
def test_foot_sites_sit_in_the_foot_spheres(robot):
    model = load_model(robot)

    assert model.body(model.site("imu").bodyid[0]).name == "base"
    for leg in LEGS[robot]:
        site, geom = model.site(f"{leg}_foot"), model.geom(f"{leg}_foot")
        assert site.bodyid[0] == geom.bodyid[0]
        np.testing.assert_allclose(site.pos, geom.pos)


@pytest.mark.slow
@pytest.mark.parametrize("robot", LEGS)
def test_robot_stands_on_its_feet_without_creeping(robot):
    posture, height, (stiffness, damping, armature, effort_limit) = STANDING[robot]
    model = with_ground(robot)
    model.dof_armature[6:] = armature
    data = mujoco.MjData(model)
    for pattern, angle in posture.items():
        for joint in range(model.njnt):
            if re.search(pattern, model.joint(joint).name):
                data.joint(joint).qpos = angle
    data.qpos[2] = height
    mujoco.mj_forward(model, data)
    lowest = [data.geom(f"{leg}_foot").xpos[2] - model.geom(f"{leg}_foot").size[0] for leg in LEGS[robot]]
    np.testing.assert_allclose(min(lowest), 0, atol=1e-4)
    np.testing.assert_allclose(lowest, lowest[0], atol=0.01)  # the Go2's usual posture stands 1 cm nose up

    feet = {model.geom(f"{leg}_foot").id for leg in LEGS[robot]}
    target, heights = data.qpos[7:].copy(), []
    for _ in range(2000):
        effort = stiffness * (target - data.qpos[7:]) - damping * data.qvel[6:]
        data.qfrc_applied[6:] = np.clip(effort, -effort_limit, effort_limit)
        mujoco.mj_step(model, data)
        heights.append(data.qpos[2])
        assert all(feet & set(contact.geom) for contact in data.contact)
    assert heights[-1] > 0.85 * height
    assert abs(heights[-1] - heights[1000]) < 0.002
    assert data.qpos[3] > 0.99


def set_bench(model: mujoco.MjModel, load_mass: float, load_length: float, arm_mass: float) -> None:
    """Write a load the way the header of test_bench.xml says."""
    arm, load = model.body("arm").id, model.body("load").id
    model.body_mass[load] = load_mass
    model.body_pos[load] = 0, 0, -load_length
    model.body_mass[arm] = arm_mass
    model.body_ipos[arm] = 0, 0, -load_length / 2
    model.body_inertia[arm] = arm_mass * load_length**2 / 12 * np.array([1, 1, 0])


@pytest.mark.parametrize(
    "load_mass, load_length, arm_mass", [(1.0, 0.2, 0.0), (0.3, 0.1, 0.0), (2.5, 0.5, 0.4), (1e-3, 0.3, 0.2)]
)
def test_bench_is_a_pendulum(load_mass, load_length, arm_mass):
    model = load_model("test_bench")
    if (load_mass, load_length, arm_mass) != (1.0, 0.2, 0.0):  # the defaults need no writing
        set_bench(model, load_mass, load_length, arm_mass)
    data = mujoco.MjData(model)
    inertia = (load_mass + arm_mass / 3) * load_length**2
    weight_moment = (load_mass + arm_mass / 2) * GRAVITY * load_length

    for q in np.linspace(-np.pi, np.pi, 9):
        data.qpos[0] = q
        mujoco.mj_forward(model, data)  # at rest, so that the bias is the holding torque
        np.testing.assert_allclose(data.qfrc_bias[0], weight_moment * np.sin(q), atol=1e-9)
        np.testing.assert_allclose(data.M[0], inertia, rtol=1e-6)
        hanging = data.body("load").xpos - data.body("arm").xpos
        np.testing.assert_allclose(hanging, load_length * np.array([-np.sin(q), 0, -np.cos(q)]), atol=1e-9)


def test_bench_turns_without_a_limit():
    model = load_model("test_bench")

    assert model.joint("servo").id == 0 and model.njnt == 1
    assert not model.jnt_limited[0]
    np.testing.assert_allclose(model.jnt_range[0], [-2 * np.pi, 2 * np.pi], atol=1e-6)
    assert model.dof_armature[0] == model.dof_damping[0] == model.dof_frictionloss[0] == 0
