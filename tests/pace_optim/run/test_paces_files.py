"""A run's files, tags and plots under PACE's names, while a fit goes on and after it."""

from pathlib import Path

import pytest
import torch
from command_lines import run_script
from problems import BENCH, chirp, record
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pace_optim.identification.fit import fit
from pace_optim.identification.optimization import Optimization
from pace_optim.recording import save_recording
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.progress import ProgressLine


class Silent(ProgressLine):
    def say(self, text):
        pass


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return save_recording(tmp_path_factory.mktemp("data") / "chirp.pt", record(chirp(0.5), noise=1e-4))


@pytest.fixture(scope="module")
def searched(file, tmp_path_factory):
    """A run of PACE's search, with its process."""
    settings = FitSettings(
        task=BENCH, data=[str(file)], optimizer="cmaes", num_envs=8, max_iteration=10, epsilon=1e-9,
        save_optimization_process=True, log_dir=str(tmp_path_factory.mktemp("logs")),
    )  # fmt: skip
    return fit(settings, Silent())[1]


@pytest.mark.slow
def test_config_holds_the_data_set_by_paces_names(searched):
    config = torch.load(searched / "config.pt", weights_only=True)
    assert config["bounds"].shape == (5, 2) and config["joint_order"] == ["servo"]
    count = len(config["time"])
    assert config["dof_pos"].shape == config["des_dof_pos"].shape == (count, 1)
    assert torch.equal(config["recordings"][0]["dof_pos"], config["dof_pos"])


def test_progress_holds_every_generation_by_paces_names(searched):
    progress = torch.load(searched / "progress.pt", weights_only=True)
    assert progress["params_buffer"].shape == (10, 8, 5) and progress["scores_buffer"].shape == (10, 8)
    assert torch.equal(progress["scores_buffer"], progress["scores"])


def test_tensorboard_has_paces_tags(searched):
    events = EventAccumulator(str(searched)).Reload()
    tags = {f"{n}/best_servo" for n in ("1_Armature", "2_Damping", "3_Friction", "4_Bias")}
    tags |= {"0_Delay/best", "0_Episode/score", "0_Episode/max_score", "0_Episode/diff_score"}
    assert tags <= set(events.Tags()["scalars"])
    assert {"0_Delay/distribution", "1_Armature/distribution_servo"} <= set(events.Tags()["histograms"])
    progress = torch.load(searched / "progress.pt", weights_only=True)
    first = events.Scalars("0_Episode/score")[0]
    assert first.value == pytest.approx(float(progress["scores_buffer"][0].min()), rel=1e-6)


@pytest.mark.slow
def test_a_plot_needs_no_more_than_the_runs_folder(searched, tmp_path):
    done = run_script("plot_trajectory", str(searched), "--plot_trajectory", "--output", str(tmp_path), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.glob("*.png"))


@pytest.mark.slow
def test_least_squares_keep_a_mean_of_each_iteration_and_can_be_plotted_meanwhile(file, tmp_path, monkeypatch):
    after = Optimization._after_iteration

    def interrupt(self, descents):
        after(self, descents)
        if len(self.history.refine_best) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(Optimization, "_after_iteration", interrupt)
    found: list[Path] = []
    settings = FitSettings(task=BENCH, data=[str(file)], optimizer="least_squares", log_dir=str(tmp_path / "logs"))
    with pytest.raises(KeyboardInterrupt):
        fit(settings, Silent(), on_start=found.append, assess_interrupted=False)
    folder = found[0]
    names = {path.name for path in folder.glob("mean_*.pt")}
    assert names - {"mean_000.pt"} == {"mean_001.pt"}  # 000: on the way to the first
    assert not (folder / "best_trajectory.pt").exists()
    done = run_script("plot_trajectory", str(folder), "--plot_trajectory", "--output", str(tmp_path), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "has not ended" in done.stderr and list(tmp_path.glob("*mean_001.png"))


def test_a_fit_without_a_task_says_what_it_takes(tmp_path):
    done = run_script("fit", "--headless", cwd=tmp_path)
    assert done.returncode == 2
    for words in ("Pace-AnymalD-v0", "my_module:Name", "my_file.py:Name", "robot.xml"):
        assert words in done.stderr


def test_data_collection_takes_paces_flags_and_several_parameters(tmp_path):
    words = "--task Pace-TestBench-v0 --num_envs 1 --device cpu --headless --duration 0.3 --max_frequency 5 --no_plot"
    truth = "--parameter armature=0.2 friction=0.1 --parameter delay=2"
    done = run_script("data_collection", *words.split(), *truth.split(), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "data/test_bench/chirp.npz").exists()
