"""No command writes over a file of the user's unless it is told to; its own, in a run's folder, it replaces."""

import hashlib
from pathlib import Path

import pytest
from bad_input_world import _MODEL as ARM
from command_lines import run_script
from problems import BENCH, record
from run_folders import write_run

from pace_optim.recording import save_recording

COMMANDS = {
    # what writes: (its words, the file of the user's)
    "export": (("RUN/result.json", "--format", "json", "--output", "mine.json"), "mine.json"),
    "export over the result": (("RUN", "--format", "json", "--output", "RUN/result.json"), "RUN/result.json"),
    "replay": (("RUN", "--viewer", "none", "--output", "page.html"), "page.html"),
    "plot_trajectory": (("--robot_name", "leg", "--plot_score", "--output", "plots"), "plots/score.png"),
    "new_robot": (("arm.xml", "--output", "mine.py"), "mine.py"),
    "import_log": (("leg.npz", "--output", "mine.csv"), "mine.json"),
    "import_log the map": (("log.csv", "--output", "new.csv", "--write_map", "map.toml"), "map.toml"),
    "data_collection": (("--task", BENCH, "--duration", "0.5", "--output", "mine.npz"), "mine.png"),
    "play": (("--checkpoint", "trained", "--video", "walk.gif"), "walk.gif"),
    "play the policy": (("--checkpoint", "trained", "--export", "policies"), "policies/policy.onnx"),
    "demo": (("--log_dir", "lab"), "lab/ramp.npz"),
}
RUN = "logs/pace/leg/26_01_01_00-00-00"


@pytest.fixture
def home(tmp_path):
    write_run(tmp_path / RUN)
    (tmp_path / "arm.xml").write_text(ARM)
    save_recording(tmp_path / "leg.npz", record())
    rows = [f"{0.0025 * k},{0.001 * k},{0.001 * k}" for k in range(100)]
    (tmp_path / "log.csv").write_text("\n".join(["time,hip pos rad,hip cmd rad", *rows]))
    (tmp_path / "trained").mkdir()
    (tmp_path / "trained" / "model_0.pt").touch()
    return tmp_path


def content(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.mark.parametrize("what", COMMANDS)
def test_a_file_of_the_users_is_not_written_over(what, home):
    words, name = COMMANDS[what]
    file = home / name.replace("RUN", RUN)
    file.parent.mkdir(exist_ok=True)
    if not file.exists():
        file.write_text("mine")
    before = content(home)
    done = run_script(what.split()[0], *(word.replace("RUN", RUN) for word in words), cwd=home)
    assert done.returncode == 2, (done.stdout, done.stderr)
    assert str(file.relative_to(home)) in done.stderr and "--overwrite" in done.stderr, done.stderr
    assert content(home) == before


@pytest.mark.parametrize("what", ["export", "plot_trajectory", "new_robot", "import_log", "import_log the map"])
def test_with_overwrite_it_is(what, home):
    words, name = COMMANDS[what]
    (home / name).parent.mkdir(exist_ok=True)
    (home / name).write_text("mine")
    done = run_script(what.split()[0], *(word.replace("RUN", RUN) for word in words), "--overwrite", cwd=home)
    assert done.returncode == 0, done.stderr
    assert (home / name).read_bytes() != b"mine"


def test_its_own_plots_in_a_run_are_replaced(home):
    for words in (("--headless",), ("--output", RUN)):
        (home / RUN / "score.png").write_text("of before")
        done = run_script("plot_trajectory", "--robot_name", "leg", "--plot_score", *words, cwd=home)
        assert done.returncode == 0, done.stderr
        assert (home / RUN / "score.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("place", ["/dev/null", "trained", "leg.npz/out.json"])
def test_no_file_takes_the_place_of_something_else(place, home):
    words = (f"{RUN}/result.json", "--format", "json", "--overwrite", "--output", place)
    done = run_script("export", *words, cwd=home)
    assert done.returncode == 2 and place in done.stderr, done.stderr
    assert not Path("/dev/null").is_file()
