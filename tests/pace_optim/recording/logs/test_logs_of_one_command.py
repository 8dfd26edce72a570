"""Logs that a command reads together: one unit, one description, one file of gains."""

import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from pace_optim.problem.recordings import _each
from pace_optim.recording import load_recording
from pace_optim.recording.files import read_facts, unused_facts
from pace_optim.recording.logs import LogReader, Robot
from pace_optim.run.open import input_digests, with_absolute_paths
from pace_optim.run.settings import FitSettings

TIME = np.arange(600) / 200
JOINTS = ("index_q1", "thumb_q1")
ROBOT = Robot(joint_names=JOINTS, limits=np.array([[-2.0, 2.0], [-2.0, 2.0]]))
GAINS = {"position_gain": {"index_q1": 2.0, "thumb_q1": 3.0}, "velocity_gain": {"index_q1": 0.1, "thumb_q1": 0.2}}


def log_of(path, scale=1.0, names=JOINTS, position="{}_pos"):
    motion = scale * np.sin(3 * TIME)
    columns = {"time": TIME} | {position.format(name): motion for name in names}
    columns |= {f"{name}_cmd": scale * np.sin(3 * TIME + 0.1) for name in names}
    rows = [",".join(f"{cell:.6f}" for cell in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join([",".join(columns), *rows]))
    return str(path)


def facts_of(folder, content=GAINS, name="gains.json"):
    (folder / name).write_text(json.dumps(content))
    return folder / name


def test_logs_with_the_same_columns_have_one_unit(tmp_path):
    degrees = 180 / np.pi
    large, small = log_of(tmp_path / "large.csv", degrees), log_of(tmp_path / "small.csv", 0.02 * degrees)
    alone = LogReader([small]).recordings(small, ROBOT)[0]
    assert np.abs(alone.dof_pos).max() == pytest.approx(0.02 * degrees, rel=0.01)  # nothing shows its unit
    for order in ([large, small], [small, large]):
        reader = LogReader(order)
        found = {path: np.abs(reader.recordings(path, ROBOT)[0].dof_pos).max() for path in order}
        assert found == {large: pytest.approx(1.0, rel=0.01), small: pytest.approx(0.02, rel=0.01)}


def test_logs_that_are_read_alike_are_described_once(tmp_path):
    paths = [log_of(tmp_path / f"{name}.csv") for name in ("chirp", "sines", "steps")]
    paths.append(log_of(tmp_path / "other.csv", names=("thumb_q1",)))
    reader = LogReader(paths)
    for path in paths:
        reader.recordings(path, ROBOT)
    lines = reader.lines()
    heads = [line for line in lines if line.endswith("read as")]
    assert heads == [f"{paths[0]}, sines.csv, steps.csv: read as", f"{paths[3]}: read as"]
    assert len(lines) == 2 * 4 and "1800 values at 200 Hz, longest gap 5 ms" in lines[1]


def test_a_file_of_gains_is_of_all_logs_and_that_beside_a_log_wins(tmp_path):
    one, two = log_of(tmp_path / "one.csv"), log_of(tmp_path / "two.csv")
    facts_of(tmp_path, {"kp": 5.0}, "two.json")
    reader = LogReader([one, two], None, facts_of(tmp_path))
    first, second = (reader.recordings(path, ROBOT)[0].drive for path in (one, two))
    assert first.stiffness.tolist() == [2, 3] and first.damping.tolist() == [0.1, 0.2]
    assert second.stiffness.tolist() == [5, 5] and second.damping.tolist() == [0.1, 0.2]
    said = "gains.json: read position_gain as stiffness [N m/rad], velocity_gain as damping [N m s/rad]."
    assert reader.lines()[-1] == f"note: {said}"


def test_gains_of_joints_that_a_log_lacks_are_left_out_and_unknown_joints_are_refused(tmp_path):
    path = log_of(tmp_path / "one.csv", names=("thumb_q1",))
    (found,) = LogReader([path], None, facts_of(tmp_path)).recordings(path, ROBOT)
    assert found.drive.stiffness.tolist() == [3]
    facts_of(tmp_path, {"kp": {"thumb_q1": 3.0, "tumb": 1.0}})
    with pytest.raises(ValueError, match="unknown joint 'tumb'"):
        LogReader([path], None, tmp_path / "gains.json").recordings(path, ROBOT)


def test_a_recording_of_ours_takes_the_gains_too(tmp_path):
    motion = np.sin(3 * TIME)[:, None] * [1, 1]
    np.savez(tmp_path / "own.npz", time=TIME, dof_pos=motion, des_dof_pos=motion, joint_names=np.array(JOINTS))
    path = str(tmp_path / "own.npz")
    (found,) = LogReader([path], None, facts_of(tmp_path)).recordings(path, ROBOT)
    assert found.drive.damping.tolist() == [0.1, 0.2] and load_recording(path).drive.damping is None


def test_a_recording_of_ours_may_lack_joints_that_have_gains(tmp_path):
    motion = np.sin(3 * TIME)[:, None] * [1, 1]
    np.savez(tmp_path / "own.npz", time=TIME, dof_pos=motion, des_dof_pos=motion, joint_names=np.array(JOINTS))
    path = str(tmp_path / "own.npz")
    facts = facts_of(tmp_path, {"stiffness": {name: 1.0 for name in (*JOINTS, "wrist")}})
    robot = Robot(joint_names=(*JOINTS, "wrist"))
    (recording,) = LogReader([path], facts=facts).recordings(path, robot)
    assert recording.drive.stiffness.tolist() == [1.0] * len(JOINTS)
    with pytest.raises(ValueError, match="wrist"):
        LogReader([path], facts=facts).recordings(path, Robot(joint_names=JOINTS))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"kp": 1.0, "stiffness": 2.0}, "are both stiffness"),
        ({"joint_names": ["a"]}, "unknown fact 'joint_names'"),
        ({"stifness": 1.0}, "did you mean 'stiffness'"),
        ([1.0], "holds a list"),
    ],
)
def test_each_fault_of_a_file_of_gains_has_its_message(tmp_path, content, words):
    with pytest.raises(ValueError, match=words):
        LogReader([], None, facts_of(tmp_path, content))


def test_a_file_of_gains_that_no_log_uses_is_named_with_the_cure(tmp_path):
    path = log_of(tmp_path / "one.csv")
    facts = facts_of(tmp_path)
    assert unused_facts([path]) == f"{facts} is not used. If it holds the gains of these logs: --facts {facts}"
    assert unused_facts([path], facts) == ""
    (tmp_path / "elsewhere").mkdir()
    others = facts_of(tmp_path / "elsewhere", name="others.json")  # the same facts, stated there
    assert unused_facts([path], others) == ""
    facts_of(tmp_path / "elsewhere", dict([next(iter(GAINS.items()))]), "others.json")
    assert "gains.json is not used" in unused_facts([path], others)  # one gain is stated nowhere
    facts.rename(tmp_path / "one.json")
    assert unused_facts([path]) == ""
    facts_of(tmp_path, {"version": 1}, "package.json")
    assert unused_facts([path]) == "" and read_facts(tmp_path / "one.json")[0].keys() == {"stiffness", "damping"}


def test_a_refusal_names_the_columns_that_were_not_used(tmp_path):
    path = log_of(tmp_path / "one.csv", names=("thumb_q1", "ring_error"))
    facts_of(tmp_path, {"stiffness": {"thumb_q1": 1.0, "ring": 1.0}}, "one.json")
    robot = Robot(joint_names=("thumb_q1", "ring"))
    reader = LogReader([path])
    with pytest.raises(
        ValueError, match=r"joint 'ring'.* Columns of the log: not used: ring_error_pos, ring_error_cmd"
    ):
        reader.recordings(path, robot)
    assert reader.lines()[0] == f"{path}: read as"  # is told before the refusal


def test_all_files_that_cannot_be_used_are_named(tmp_path):
    def read(path):
        raise ValueError(f"{path}: broken.")

    paths = [log_of(tmp_path / f"{name}.csv") for name in "abc"]
    with pytest.raises(ValueError, match=r"a\.csv: broken\. Neither can b\.csv, c\.csv be used\."):
        _each(paths, read, False, print)


@pytest.mark.slow
def test_import_takes_the_gains(tmp_path):
    path, facts = log_of(tmp_path / "one.csv"), facts_of(tmp_path)
    code = "from pace_optim.commands.import_log import main; main()"
    for more, words in (([], "is not used"), (["--facts", str(facts)], "read position_gain as stiffness")):
        done = subprocess.run(
            [sys.executable, "-c", code, path, *more, "--output", str(tmp_path / "out.csv"), "--overwrite"],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert words in done.stdout + done.stderr
    assert load_recording(tmp_path / "out.csv").drive.stiffness.tolist() == [2, 3]


def test_a_run_keeps_the_file_of_gains_and_a_folder_may_list_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    log_of(tmp_path / "one.csv")
    facts = facts_of(tmp_path)
    settings = FitSettings(task="x", data=["one.csv", "gains.json"], facts="gains.json")
    assert settings.data == ["one.csv"]
    kept = with_absolute_paths(settings, None)
    assert kept.facts == str(facts)
    assert str(facts) in input_digests(kept, SimpleNamespace(code={}, files={}))


@pytest.mark.parametrize("suffix", [".npz", ".pt", ".mcap", ".csv"])
def test_facts_beside_a_recording_of_any_format_are_no_recording_and_have_a_digest(tmp_path, suffix):
    recording, facts = tmp_path / f"leg{suffix}", tmp_path / "leg.json"
    facts.write_text("{}")
    settings = FitSettings(task="x", data=[str(facts), str(recording)])
    assert settings.data == [str(recording)]
    assert input_digests(settings, SimpleNamespace(code={}, files={}))[str(facts)] is not None
