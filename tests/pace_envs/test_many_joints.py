"""Beyond 60 degrees of freedom MuJoCo factorises sparsely: 70 joints are checked by its dense solver."""

from importlib.metadata import requires, version

import mujoco
import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from pace_envs.simulation import Simulation, SimulationCfg

JOINTS = 70
SOUND_CORE = Version("4.0.1")
"""MuJoCo's first core whose sparse factorisation is right (its issue 3767)."""


def robot(jacobian: mujoco.mjtJacobian) -> mujoco.MjSpec:
    """A trunk with seven chains of ten joints, each with friction, that are pulled together at their ends."""
    spec = mujoco.MjSpec()
    spec.option.jacobian = jacobian
    trunk = spec.worldbody.add_body(name="trunk", pos=[0, 0, 3])
    for chain in range(7):
        turn = 2 * np.pi * chain / 7
        link = trunk
        for k in range(10):
            place = [0.1 * np.cos(turn), 0.1 * np.sin(turn), 0.0] if k == 0 else [0, 0, -0.1]
            link = link.add_body(name=f"link_{chain}_{k}", pos=place)
            link.add_joint(
                name=f"joint_{chain}_{k}",
                axis=[0, 1, 0] if k % 2 else [1, 0, 0],
                armature=0.01,
                frictionloss=0.05 * (k + 1),
            )
            link.add_geom(size=[0.02, 0, 0], mass=0.1 + 0.05 * k)
        if chain:
            loop = spec.add_equality(
                type=mujoco.mjtEq.mjEQ_CONNECT, name1=f"link_{chain - 1}_9", name2=f"link_{chain}_9",
                objtype=mujoco.mjtObj.mjOBJ_BODY,
            )  # fmt: skip
            loop.data[:3] = [0.0, 0.0, 0.0]
    return spec


def moved(jacobian: mujoco.mjtJacobian, integrator: str) -> np.ndarray:
    """Positions after 200 steps under torques that differ from joint to joint."""
    cfg = SimulationCfg(dt=0.0025, integrator=integrator)
    simulation = Simulation(cfg, robot(jacobian), 2)
    assert simulation.model.nv == JOINTS and simulation.model.opt.jacobian == jacobian
    path = []
    for k in range(200):
        simulation.qfrc_applied[0] = 0.3 * np.sin(0.05 * k) * simulation.tensor(np.cos(np.arange(JOINTS)))
        simulation.step()
        path.append(simulation.qpos[0].clone().numpy())
    simulation.close()
    return np.array(path)


@pytest.mark.parametrize("integrator", ["implicitfast", "leapfrog"])
def test_seventy_joints_move_as_by_the_dense_solver(integrator):
    sparse, dense = (
        moved(kind, integrator) for kind in (mujoco.mjtJacobian.mjJAC_SPARSE, mujoco.mjtJacobian.mjJAC_DENSE)
    )
    assert np.abs(dense[-1]).max() > 0.02
    assert np.abs(sparse - dense).max() < 1e-6


def test_the_sound_core_is_required_as_soon_as_mujoco_takes_it():
    """``mujoco`` 4.0.0 asks for exactly the core 4.0.0, so that pip cannot install 4.0.1 beside it."""
    pinned = [Requirement(each) for each in requires("mujoco") or [] if each.startswith("mujoco-core")]
    if pinned and not any(SOUND_CORE in each.specifier for each in pinned) and Version(version("mujoco")) < SOUND_CORE:
        pytest.skip(
            f"mujoco {version('mujoco')} needs {pinned[0]}: mujoco-core {SOUND_CORE} cannot be installed with it"
        )
    ours = [Requirement(each) for each in requires("pace-mujoco") or []]
    oldest = {each.name: each.specifier for each in ours}
    assert not any("4.0.0" in oldest[name] for name in ("mujoco", "mujoco-core") if name in oldest)
