"""Recordings cut into windows: the same samples, and the same motion once a window's beginning is forgotten."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from problems import CALM, DT, chirp, env_cfg, make_problem, physical, replayed

from pace_actuators.effects import get_effect
from pace_envs import set_physics_dt
from pace_envs.compiler import host_kernels
from pace_optim.estimate.error_bars.physics_step import step_error
from pace_optim.joints.fits.base_fit import joint_vectors
from pace_optim.joints.fits.model import JointModel
from pace_optim.joints.fits.side_by_side import SideBySide, Slot
from pace_optim.joints.simulation import reference_path, twin_problem
from pace_optim.recording.windows import Windows

DURATION = 6.5
EFFECTS = {
    "clock_skew": [0.003],  # both depend on when a window begins
    "friction_drift": [0.8, 5.0],
    "joint_elasticity": [300.0, 1.0, 0.0],
}


@pytest.fixture(scope="module")
def bench():
    """A long and a short recording, the latter with measured speeds and half as many samples, and one to validate."""
    fine = env_cfg()
    set_physics_dt(fine, DT / 4)
    long, short, other = (replayed(chirp(t, amplitude=0.4), CALM, fine) for t in (DURATION, 3.2, 1.0))
    speed = torch.as_tensor(short.dof_pos)[:, 0].diff(prepend=torch.zeros(1, dtype=torch.float64)) / DT
    half = slice(None, None, 2)
    short = replace(short, time=short.time[half], dof_pos=short.dof_pos[half], dof_vel=speed[half, None].numpy())
    problem = make_problem([long, short], validation=[other]).with_physics_dt(DT / 2)
    truth = physical(problem, CALM)
    return SimpleNamespace(
        problem=problem,
        twins=twin_problem(problem, reference_path(problem, truth)),
        values=joint_vectors(problem, truth),
    )


def windows_of(dataset, recording):
    """Indices of a recording's windows."""
    return [i for i, each in enumerate(dataset.recordings) if each is recording]


@pytest.mark.slow
def test_every_sample_is_in_one_window(bench):
    whole, cut = bench.twins.dataset, bench.twins.in_windows().dataset
    assert [len(windows_of(cut, recording)) for recording in whole.recordings] == [3, 2, 1]
    for r, recording in enumerate(whole.recordings):
        own = windows_of(cut, recording)
        first = (cut.start_time[own] / DT).round().long()
        for name in ("train", "validation"):
            steps = [start + getattr(cut, name)[:, w].nonzero()[:, 0] for w, start in zip(own, first, strict=True)]
            assert torch.equal(torch.cat(steps), getattr(whole, name)[:, r].nonzero()[:, 0])
        for w, start in zip(own, first.tolist(), strict=True):
            at = cut.sampled[:, w].nonzero()[:, 0]
            assert torch.equal(cut.measured[at, w], whole.measured[at + start, r])
            assert torch.equal(cut.command[at, w], whole.command[at + start, r])
            assert torch.equal(cut.measured[0, w], whole.measured[start, r])
            assert bool(whole.sampled[start, r])
    assert torch.allclose(cut.session_start - cut.start_time, whole.session_start[[0, 0, 0, 1, 1, 2]])
    assert len(cut.command) < 0.5 * len(whole.command)


def test_windows_without_samples_that_count_are_left_out(bench):
    data = bench.twins.dataset
    some = torch.zeros_like(data.sampled)
    some[2 * len(some) // 3 :, 0] = True  # the end of the long one
    windows = Windows.of(data, DT).with_samples(some)
    assert windows.recording.tolist() == [0]
    assert int(windows.mask(some).sum()) == int((some & data.sampled).sum())


def test_what_half_the_step_changes_is_as_on_whole_recordings(bench):
    problem, values = bench.problem, physical(bench.problem, CALM)
    where = torch.zeros_like(problem.dataset.train)
    where[round(5.0 / DT) : round(5.2 / DT), 0] = True  # a small part of its window, which changes half as much again
    finer = problem.with_physics_dt(problem.physics_dt / 2)
    coarse, fine = (p.evaluator().residuals(values[None], where) for p in (problem, finer))
    change = float((coarse.error[0] - fine.error[0])[coarse.where].square().mean().sqrt())
    assert change > 1e-5
    assert float(step_error(problem, values, where)) == pytest.approx(change, rel=0.1)


def test_a_window_has_its_own_part_of_the_reference(bench):
    windows, whole = bench.twins.in_windows(), bench.twins.path
    for r, recording in enumerate(bench.twins.dataset.recordings):
        for w in windows_of(windows.dataset, recording):
            start = round(float(windows.dataset.start_time[w]) / DT)
            at = torch.arange(int(windows.dataset.sampled[:, w].nonzero()[-1]))
            assert torch.equal(windows.path.position[at, w], whole.position[at + start, r])
            assert torch.equal(windows.path.feel.torque[at, w], whole.feel.torque[at + start, r])
            assert torch.equal(windows.path.feel.stiffness[at, w], whole.feel.stiffness[at + start, r])


def test_a_window_begins_at_the_measured_speed(bench):
    cut, (long, short) = bench.twins.in_windows().dataset, bench.twins.dataset.recordings[:2]
    first, *later = windows_of(cut, long)
    assert float(cut.start_vel[first].abs().max()) == 0.0  # at rest, and not recorded
    for w in later:
        at = round(float(cut.start_time[w]) / DT)
        speed = (long.dof_pos[at + 1] - long.dof_pos[at - 1]) / (2 * DT)
        assert cut.start_vel[w].tolist() == pytest.approx(speed.tolist(), abs=0.1)
        assert abs(speed[0]) > 0.5
    for w in windows_of(cut, short):
        sample = round(float(cut.start_time[w]) / DT / 2)
        assert cut.start_vel[w].tolist() == short.dof_vel[sample].tolist()


@pytest.fixture(scope="module")
def whole_and_cut(bench):
    """Each with its errors, (steps, recordings or windows, joints) by effect; the simulations lie side by side."""
    model, here = JointModel.base(bench.problem), torch.tensor([True])
    models = {None: (model, bench.values)} | {
        effect: model.extended(bench.values, get_effect(effect), here, torch.tensor([own], dtype=torch.float64))
        for effect, own in EFFECTS.items()
    }

    def errors(problem):
        slots = [Slot(model=own, rows=1) for own, _ in models.values()]
        batch = SideBySide(problem, slots, training=True, compiler=host_kernels())
        found = batch.simulate([values[None] for _, values in models.values()], batch.dataset.train)
        return batch.dataset, dict(zip(models, found, strict=True))

    return errors(bench.twins), errors(bench.twins.in_windows())


@pytest.mark.parametrize("effect", [None, *EFFECTS])
def test_once_its_beginning_is_forgotten_a_window_moves_as_the_whole(whole_and_cut, effect):
    (whole, errors), (cut, of_windows) = whole_and_cut
    _, *later = windows_of(cut, whole.recordings[0])
    for w in later:
        at = cut.train[:, w].nonzero()[:, 0]
        start = round(float(cut.start_time[w]) / DT)
        difference = of_windows[effect][at, w] - errors[effect][at + start, 0]
        assert float(difference.abs().max()) < 1e-3
        assert float(difference.square().mean().sqrt()) < 2e-4
    if effect is not None:
        assert float(errors[effect].abs().max()) > 5e-3  # it is there
