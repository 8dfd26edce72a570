"""A bench with one drive: a pendulum whose load each recording states."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.assets_dir import ASSETS_DIR
from pace_envs.robots.anymal_d import anymal_d_drive_cfg
from pace_envs.simulation import EnvIds

if TYPE_CHECKING:
    from pace_envs.manager_based_env import ManagerBasedEnv

TEST_BENCH_JOINTS = ("servo",)
TEST_BENCH_LOAD = {"load_mass": 1.0, "load_length": 0.2, "arm_mass": 0.0}
"""Point mass [kg], its distance from the axis [m], mass of the uniform rod that carries it [kg]."""


def test_bench_cfg() -> ArticulationCfg:
    """The bench with ANYmal's drive, hanging down."""
    drive = anymal_d_drive_cfg()
    drive.joint_names_expr = "servo"
    drive.centred_commands = True
    return ArticulationCfg(
        mjcf_path=ASSETS_DIR / "test_bench" / "test_bench.xml",
        actuators={"servo": drive},
        joint_order=TEST_BENCH_JOINTS,
        fix_base=True,
    )


def apply_test_bench_load(env: ManagerBasedEnv, env_ids: EnvIds, load: Mapping[str, float]) -> None:
    """Write a load to some environments; what ``load`` does not say keeps its default.

    The rod of mass m_a and length l has the inertia m_a l²/12 about its middle; the load is a point.

    Args:
        env_ids: Which environments, ``None`` for all.
        load: ``load_mass`` [kg], ``load_length`` [m], ``arm_mass`` [kg].
    """
    values = {**TEST_BENCH_LOAD, **load}
    mass, length, arm_mass = (float(values[key]) for key in TEST_BENCH_LOAD)
    if not (mass >= 0 and length > 0 and arm_mass >= 0):
        raise ValueError(
            f"The load is {mass:g} kg at {length:g} m on an arm of {arm_mass:g} kg, "
            "expected masses >= 0 and a length > 0."
        )
    rows = env.sim.resolve_env_ids(env_ids)
    model, sim = env.sim.model, env.sim
    arm, point = model.body("arm").id, model.body("load").id
    smallest = 1e-9  # MuJoCo wants moving bodies to weigh something
    across, along = max(arm_mass * length**2 / 12, smallest), smallest
    sim.expand("body_mass")[rows, arm] = max(arm_mass, smallest)
    sim.expand("body_inertia")[rows, arm] = sim.expand("body_inertia").new_tensor([across, across, along])
    sim.expand("body_ipos")[rows, arm] = sim.expand("body_ipos").new_tensor([0.0, 0.0, -length / 2])
    sim.expand("body_mass")[rows, point] = max(mass, smallest)
    sim.expand("body_pos")[rows, point] = sim.expand("body_pos").new_tensor([0.0, 0.0, -length])
    sim.constants_changed()
