"""Units and joints in brackets behind names, and speeds that contradict their positions."""

import numpy as np
import pytest
from log_reading import understood

from pace_optim.recording.logs import LogReader, Robot
from pace_optim.recording.logs.log import Channel
from pace_optim.recording.logs.units import no_slopes
from pace_optim.recording.logs.words import joint_places, meaning

TIME = np.arange(400) / 200
MOTION = 0.8 * np.sin(3 * TIME)
TARGET = 0.8 * np.sin(3 * TIME + 0.1)
SPEED = 2.4 * np.cos(3 * TIME)


def table(path, columns):
    rows = [",".join(f"{cell:.6f}" for cell in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join([",".join(columns), *rows]))
    return path


def read(path, columns, robot=None):
    (one,) = understood(table(path, {"time": TIME} | columns), robot or Robot())
    return one


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_speeds_are_held_against_positions_within_each_log_of_several(tmp_path, way):
    parts = [(0.3 * TIME, 0.3 + 0 * TIME), (2.0 - way * 0.5 * TIME, -way * 0.5 + 0 * TIME)]  # both end in motion
    paths = []
    for k, (position, speed) in enumerate(parts):
        columns = {"time": TIME, "q_rad": position, "dq_rad_s": speed, "des_rad": position}
        paths.append(str(table(tmp_path / f"{k}.csv", columns)))
    reader = LogReader(paths)
    assert all(reader.recordings(path, Robot())[0].dof_vel is not None for path in paths)


@pytest.mark.parametrize(("scale", "wrong"), [(1.0, False), (180 / np.pi, True)])
def test_a_long_gap_within_a_log_shows_no_speed(scale, wrong):
    time = np.concatenate([TIME, TIME + 300])
    position = Channel(key="q", table="", time=time, values=np.concatenate([MOTION, 1.0 - MOTION]))
    speed = Channel(key="dq", table="", time=time, values=scale * np.concatenate([SPEED, -SPEED]))
    assert bool(no_slopes({"j": speed}, {"j": position})) == wrong


@pytest.mark.parametrize(
    ("stiffness", "damping"),
    [("kp_hip [Nm/rad]", "kd_hip [Nm s/rad]"), ("stiffness_hip [N·m/rad]", "hip_damping (N*m*s/rad)"),
     ("kp_hip [N/m]", "kd_hip [N s/m]"), ("kp_hip", "kd_hip [Nms/rad]")],
)  # fmt: skip
def test_gains_in_si_units_are_used(tmp_path, stiffness, damping):
    columns = {"q_hip": MOTION, "des_hip": TARGET, stiffness: 30 + 0 * TIME, damping: 0.5 + 0 * TIME}
    drive = read(tmp_path / "log.csv", columns).recording.drive
    assert drive.stiffness.tolist() == [30] and drive.damping.tolist() == [0.5]


@pytest.mark.parametrize("unit", ["Nm/deg", "N m/°", "mNm/rad", "raw"])
def test_gains_in_other_units_are_left_out_with_the_cure(tmp_path, unit):
    found = read(tmp_path / "log.csv", {"q_hip": MOTION, "des_hip": TARGET, f"kp_hip [{unit}]": 30 + 0 * TIME})
    assert found.recording.drive.stiffness is None
    assert any("expected SI units" in line and "--facts" in line for line in found.lines)


def test_a_switch_may_have_a_unit(tmp_path):
    found = read(tmp_path / "log.csv", {"q_hip": MOTION, "des_hip": TARGET, "torque_enable [bit]": TIME < 1})
    assert found.recording.torque_enable is not None


@pytest.mark.parametrize("of_robot", [True, False])
@pytest.mark.parametrize(
    "names", [("LF", "RF", "LB", "RB"), ("FT", "BK"), ("IN", "OUT"), ("1A", "1B"), ("2m", "3m"), ("1A", "2A")]
)
def test_joints_in_brackets_may_look_like_units(tmp_path, names, of_robot):
    columns = {f"{series}[{name}]": values for series, values in (("pos", MOTION), ("cmd", TARGET)) for name in names}
    found = read(tmp_path / "log.csv", columns, Robot(joint_names=names) if of_robot else None)
    assert found.recording.joint_names == names and not any("not known" in line for line in found.lines)


def test_a_bracket_behind_a_joint_or_alone_is_a_unit():
    columns = ["pos hip [lbf in]", "torque [lbf in]", "torque [N m]", "pos [cdeg]", "cmd [0.1 deg]"]
    assert not any("[" in name[slice(*place)] for name, place in joint_places(columns).items())
    assert meaning("torque [lbf in]").unknown_unit == "lbf in"


@pytest.mark.parametrize(
    ("name", "unit"),
    [("vel_hip [rad s^-1]", "rad/s"), ("vel_hip [rad·s^-1]", "rad/s"), ("vel_hip [rad s⁻¹]", "rad/s"),
     ("vel_hip [1/s]", "rad/s"), ("vel_hip [s^-1]", "rad/s"), ("vel_hip [m_s]", "m/s"), ("vel_hip [m s^-1]", "m/s"),
     ("vel_hip [deg s^-1]", "deg/s"), ("vel_hip [rev/min]", "rpm"), ("vel_hip (rev per min)", "rpm"),
     ("vel_hip [rev/s]", "turn/s"),
     ("hipSpeedDegPerSec", "deg/s"), ("hipCmdVelDegPerSec", "deg/s"), ("hip_cmdDegPerSec", "deg/s"),
     ("hipSpeedMdegPerSec", "mdeg/s"), ("hip_legRadPerS_vel", "rad/s"), ("hipVel_mradPerS", "mrad/s")],
)  # fmt: skip
def test_units_are_known_in_many_spellings(name, unit):
    said = meaning(name)
    assert (said.unit, said.unknown_unit) == (unit, "")


@pytest.mark.parametrize("unit", ["rad s^-2", "rad s⁻²", "rad/s^2", "grad/s"])
def test_units_like_known_ones_are_still_unknown(unit):
    assert meaning(f"vel_hip [{unit}]").unknown_unit == unit


def test_raw_positions_are_guessed_unless_they_are_counts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = read(tmp_path / "log.csv", {"q_hip (raw)": MOTION, "des_hip (raw)": TARGET}).recording
    assert found.joint_names == ("hip",) and found.dof_pos[:, 0] == pytest.approx(MOTION, abs=1e-5)
    counts = {"q_hip (raw)": np.round(2048 + 600 * MOTION), "des_hip (raw)": np.round(2048 + 600 * TARGET)}
    with pytest.raises(ValueError, match="the unit is not known"):
        read(tmp_path / "counts.csv", counts)
