"""Figures hold the data they claim to show."""

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from run_folders import JOINTS, make_history, make_trajectory

from pace_actuators.text import position_text, position_unit, three_figures
from pace_optim.report.plots import plot_scores, plot_trajectories
from pace_optim.run.history import History
from pace_optim.run.tensors import Trajectories, held_out_spans


def drawn(content, **options) -> dict[str, Figure]:
    return plot_trajectories(Trajectories.of(content), **options)


@pytest.fixture(scope="module")
def trajectory():
    return make_trajectory()


@pytest.fixture(scope="module")
def figures(trajectory) -> dict[str, Figure]:
    return drawn(trajectory, title="leg")


def test_every_recording_has_a_figure_with_every_joint(figures):
    assert list(figures) == ["trajectory_chirp", "trajectory_steps"]
    for figure in figures.values():
        titles = [axes.get_title(loc="left") for axes in figure.axes]
        assert [title for title in titles if title] == list(JOINTS)
        assert len(figure.axes) == 2 * len(JOINTS)


@pytest.mark.parametrize("r", [0, 1])
def test_panels_show_target_measured_simulated_and_the_error_in_mrad(figures, trajectory, r):
    recording, figure = trajectory["recordings"][r], list(figures.values())[r]
    for j in range(len(JOINTS)):
        above, below = figure.axes[2 * j : 2 * j + 2]
        curves = [line.get_ydata() for line in above.get_lines()]
        expected = [recording[key][:, j].numpy() for key in ("des_dof_pos", "dof_pos", "sim_dof_pos")]
        for curve, values in zip(curves, expected, strict=True):
            assert np.array_equal(curve, values)
        error = below.get_lines()[0].get_ydata()
        assert error == pytest.approx(1e3 * (expected[2] - expected[1]))
    assert figure.axes[1].get_ylabel() == "error [mrad]"
    assert "mrad" in figure.axes[0].get_title(loc="right")


def test_what_was_held_out_is_shaded_and_said(figures):
    for figure, start in ((figures["trajectory_chirp"], 0.7 * 799 * 0.005), (figures["trajectory_steps"], 0.0)):
        (span,) = figure.axes[0].patches
        assert span.get_x() == pytest.approx(start, abs=0.006)
        assert "kept for validation" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_data_that_was_all_trained_on_is_not_shaded():
    trajectory = make_trajectory()
    trajectory["recordings"][0]["train"][:] = True
    figure = drawn(trajectory)["trajectory_chirp"]
    assert not figure.axes[0].patches
    assert "kept for validation" not in [text.get_text() for text in figure.legends[0].get_texts()]


def test_a_beginning_that_settles_is_not_called_validation():
    """Its second was shaded and counted as held out, unlike in the report."""
    trajectory = make_trajectory()
    settling = trajectory["recordings"][0]["time"] < 0.5
    trajectory["recordings"][0] |= {"train": ~settling, "settling": settling}
    figure = drawn(trajectory)["trajectory_chirp"]
    assert not figure.axes[0].patches and "validation" not in figure.axes[0].get_title(loc="right")


@pytest.mark.slow
def test_many_joints_go_on_several_figures_and_odd_names_into_file_names():
    names = [f"joint_{i}" for i in range(29)]
    recording = make_trajectory(50)["recordings"][0]
    wide = {key: recording[key][:, :1].repeat(1, 29) for key in ("des_dof_pos", "dof_pos", "sim_dof_pos")}
    content = {
        "joint_names": names,
        "recordings": [recording | wide | {"name": "a/b: ü"}, recording | wide | {"name": "a b: ü"}],
    }
    figures = drawn(content)
    assert len(figures) == 6
    assert all("/" not in name and " " not in name for name in figures)
    shown = [axes.get_title(loc="left") for figure in list(figures.values())[:3] for axes in figure.axes]
    assert [title for title in shown if title] == names


@pytest.mark.slow
def test_a_simulation_that_diverged_is_drawn_as_far_as_it_goes(tmp_path):
    trajectory = make_trajectory(100)
    trajectory["recordings"][0]["sim_dof_pos"][40:] = torch.nan
    drawn(trajectory)["trajectory_chirp"].savefig(tmp_path / "a.png")


@pytest.mark.slow
def test_a_figure_can_be_saved_without_a_display(figures, tmp_path):
    figures["trajectory_chirp"].savefig(tmp_path / "a.png", dpi=50)
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_the_score_goes_on_where_the_search_ended():
    history = make_history(generations=30, iterations=8)
    axes = plot_scores(history).axes[0]
    mean, best, refined = (line.get_xydata() for line in axes.get_lines()[:3])
    assert np.array_equal(mean[:, 0], np.arange(1, 31)) and np.array_equal(mean[:, 1], history.search_mean)
    assert np.array_equal(best[:, 1], history.search_best)
    assert np.array_equal(refined[:, 0], np.arange(31, 39)) and np.array_equal(refined[:, 1], history.refine_best)
    assert axes.get_yscale() == "log"
    upper = axes.child_axes[0]
    assert upper.get_xticks()[-1] == 38
    assert upper.get_xticklabels()[-1].get_text() == "12.7 M"  # 30 * 400k + 8 * 90k


@pytest.mark.slow
@pytest.mark.parametrize(
    "history",
    [make_history(iterations=0), make_history(generations=0), History(), make_history(generations=1, iterations=0)],
    ids=["search alone", "refinement alone", "nothing", "one generation"],
)
def test_any_part_of_a_history_can_be_drawn(history, tmp_path):
    plot_scores(history).savefig(tmp_path / "a.png")


def test_held_out_spans_begin_and_end_with_the_samples():
    time = np.arange(10) * 0.5
    train = np.array([1, 1, 0, 0, 1, 1, 1, 0, 0, 0], bool)
    assert held_out_spans(time, train) == [(1.0, 2.0), (3.5, 4.5)]
    assert held_out_spans(time, np.ones(10, bool)) == []
    assert held_out_spans(time, np.zeros(10, bool)) == [(0.0, 4.5)]


@pytest.mark.parametrize(
    ("angle", "text"), [(6.8e-3, "6.8 mrad"), (2.5e-6, "2.5 µrad"), (3e-11, "0.03 nrad"), (0.0, "0 nrad"), (None, "–")]
)
def test_angles_read_well(angle, text):
    assert position_text(angle, ["hinge"]) == text


def test_a_unit_fits_the_largest_and_survives_what_is_no_number():
    assert position_unit([1e-9, 2e-3], ["hinge"]) == (1e3, "mrad")
    assert position_unit([float("nan"), None, 1e-6], ["hinge"]) == (1e6, "µrad")
    assert position_unit([], ["hinge"]) == (1e3, "mrad")


@pytest.mark.parametrize(("value", "text"), [(0.12, "0.120"), (11.96, "12.0"), (114.2, "114"), (0.0, "0.00")])
def test_numbers_of_a_table_have_three_figures(value, text):
    assert three_figures(value) == text
