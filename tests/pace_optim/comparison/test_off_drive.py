"""A drive that is switched off is another machine."""

import numpy as np
import pytest
import torch
from bench_recordings import Bench, chirp, record

from pace_actuators import ActuatorActions, PaceDCMotor, PaceDCMotorCfg
from pace_optim.commands.compare import main as compare
from pace_optim.comparison.dimensions import dimensions_of, motion_of
from pace_optim.comparison.regions import Region
from pace_optim.comparison.words import place_text
from pace_optim.diagnosis import candidate_effects
from pace_optim.identification.fit import fit
from pace_optim.run.settings import FitSettings

BENCH = "Pace-TestBench-v0"


def motor(damping: float, num_envs: int = 2) -> PaceDCMotor:
    cfg = PaceDCMotorCfg(
        joint_names_expr="j",
        stiffness=40.0,
        damping=1.0,
        viscous_friction=0.5,
        physics_dt=0.0025,
        effects=["off_damping"],
    )
    drive = PaceDCMotor(cfg, ["j"], [0], num_envs, dtype=torch.float64)
    drive.effects.find("off_damping").set_parameter("damping", damping)
    drive.update_effects()
    return drive


def stepped(drive: PaceDCMotor) -> tuple[list[float], list[float]]:
    """Torque and viscous friction of each environment at 0.1 rad and 2 rad/s."""
    at = torch.full((2, 1), 0.1, dtype=torch.float64)
    effort = drive.compute(ActuatorActions(at * 0), at, at * 20).joint_efforts
    return effort[:, 0].tolist(), drive.joint_viscous_friction[:, 0].tolist()


@pytest.mark.parametrize(("damping", "off"), [(0.3, 0.8), (-0.2, 0.3), (-2.0, 0.0), (0.0, 0.5)])
def test_only_a_drive_that_is_off_brakes_otherwise_and_friction_drives_nothing(damping, off):
    drive = motor(damping)
    drive.set_torque_enable(torch.tensor([True, False]))
    assert stepped(drive) == ([pytest.approx(-6.0), 0.0], [0.5, pytest.approx(off)])
    drive.set_torque_enable(None)
    assert stepped(drive)[1] == [0.5, 0.5]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A fit of a drive that is off for the middle of its recording and then has 0.2 of its 0.5 N m s/rad."""
    folder, target = tmp_path_factory.mktemp("off"), chirp(2.0)
    enabled = np.ones(len(target))
    enabled[300:500] = 0.0
    path = record(folder / "off.csv", Bench(off_viscous=0.2), position=target, enabled=enabled)
    settings = {"task": BENCH, "data": [str(path)], "check_consistency": False,
                "log_dir": str(folder)}  # fmt: skip
    return fit(FitSettings(**settings, effects=["off_damping"]))


@pytest.mark.slow
def test_a_fit_finds_how_a_drive_brakes_while_off(run):
    result, _ = run
    assert result.parameters["off_damping.damping"]["servo"] == pytest.approx(-0.3, abs=0.03)


def test_a_comparison_says_that_the_error_sits_where_the_drive_is_off(run, monkeypatch, capsys):
    _, folder = run
    monkeypatch.setattr("sys.argv", ["compare", str(folder)])
    compare()
    assert (folder / "comparison.json").read_text().count('"drive"') >= 1


def test_drive_on_and_off_are_a_dimension_where_both_occur():
    time = np.arange(400) * 0.0025
    motions = [motion_of(np.sin(6 * time), 0.0025, 1e-4)]
    enabled = time < 0.5
    (found,) = [d for d in dimensions_of(motions, [time], None, [enabled]) if d.name == "drive"]
    assert np.array_equal(found.bin, enabled.astype(int))
    region = {"base": 0.5, "share": 0.9}
    assert place_text(found, Region(first=0, last=0, **region)) == "while the drive is off"
    assert place_text(found, Region(first=1, last=1, **region)) == "while the drive is on"
    assert not [d for d in dimensions_of(motions, [time], None, [np.ones(400, bool)]) if d.name == "drive"]


def test_effects_of_a_drive_that_is_off_are_tried_only_where_one_is():
    assert "off_damping" in {effect.name for effect in candidate_effects(switched_off=True)}
    assert "off_damping" not in {effect.name for effect in candidate_effects(switched_off=False)}
