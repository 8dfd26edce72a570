"""The single-joint simulation as one kernel moves as itself, on a GPU and on the processor."""

import os
import shutil
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from effect_envs import EFFECTS, Branching
from problems import ANYMAL, CALM, DT, TRUTH, chirp, env_cfg, legs_chirp, make_problem, physical, record

from pace_actuators.effects import get_effect, registry
from pace_envs.compiler import CannotCompileError, host, host_kernels, kernels_of
from pace_envs.simulation import SimulationCfg, make_simulation
from pace_optim.joints.fits.fits import fits_on
from pace_optim.joints.fits.fitting_cfg import DEFAULT
from pace_optim.joints.fits.model import BASE, JointModel
from pace_optim.joints.fits.side_by_side import SideBySide, Slot
from pace_optim.joints.simulation import reference_path, twin_problem

STEPS = 80
"""Control steps that are simulated."""


@pytest.fixture(scope="module", params=["processor", "GPU"])
def kernels(request):
    """What compiles, and where it runs."""
    if request.param == "GPU":
        if not torch.cuda.is_available():
            pytest.skip("needs a GPU and torch for CUDA")
        device = torch.device("cuda", 0)
        return {"compiler": kernels_of(device), "device": device}
    if (compiler := host_kernels()) is None:
        pytest.skip("needs a compiler of C++")
    return {"compiler": compiler, "device": torch.device("cpu")}


def slots_of(problem, start, *sets):
    """The base model, and one with each set of effects at where searches for them start; values (n, P) of each."""
    here = torch.ones(len(start), dtype=torch.bool)
    result = [(JointModel.base(problem), start)]
    for effects in sets:
        model, physical = result[0]
        for effect in effects:
            values = torch.tensor([[p.start for p in effect.parameters]], dtype=torch.float64).repeat(len(start), 1)
            model, physical = model.extended(physical, effect, here, values)
        result.append((model, physical))
    return result


def both(problem, models, kernels, training=True):
    """Errors of models by the simulation and by kernels, two candidates of each."""
    slots = [Slot(model=model, rows=2) for model, _ in models]
    rows = [torch.stack([values, values * 1.01]) for _, values in models]
    batches = SideBySide(problem, slots, training), SideBySide(problem, slots, training, **kernels)
    where = (batches[0].dataset.train if training else batches[0].dataset.sampled).clone()
    where[STEPS:] = False
    expected, got = (batch.simulate(rows, where, 2) for batch in batches)
    again = batches[1].simulate(rows, where, 2)
    assert batches[1]._kernels is not None  # they did what the drives do
    assert torch.equal(got, again)
    return expected, got.cpu()


@pytest.fixture(scope="module")
def bench():
    """A joint alone on two short recordings, with a payload's influence along its reference."""
    recordings = [record(chirp(0.5, 2.0, 6.0, size), CALM) for size in (0.5, 0.3)]
    problem = make_problem(recordings).with_physics_dt(DT / 2)
    path = reference_path(problem, physical(problem, CALM), ["payload", "com_offset"])
    start = torch.tensor([[CALM[name] for name in BASE]], dtype=torch.float64)
    return SimpleNamespace(problem=problem, twins=twin_problem(problem, path), start=start)


@pytest.fixture(scope="module")
def legs():
    """A robot of twelve joints that move each other, with a payload's influence along its reference."""
    cfg = env_cfg(ANYMAL)
    problem = make_problem(record(legs_chirp(cfg, 0.5), TRUTH, cfg=cfg), cfg=cfg)
    path = reference_path(problem, problem.space.from_dict(TRUTH), ["payload", "com_offset"])
    start = torch.tensor([[TRUTH[name] for name in BASE]], dtype=torch.float64).repeat(12, 1)
    return SimpleNamespace(problem=problem, twins=twin_problem(problem, path).with_physics_dt(0.00125), start=start)


@pytest.mark.slow
def test_every_effect_moves_a_joint_as_in_the_simulation(kernels, bench):
    names = EFFECTS
    models = slots_of(bench.problem, bench.start, *([get_effect(name)] for name in names))
    expected, got = both(bench.twins.in_windows(), models, kernels)
    apart = dict(zip(["base", *names], (expected - got).abs().amax(dim=(1, 2, 3))[::2].tolist(), strict=True))
    assert max(apart.values()) < 1e-8, apart


@pytest.mark.slow
def test_several_joints_recordings_and_effects_at_once(kernels, legs):
    sets = (["payload"], ["com_offset", "backlash"], ["measurement_delay", "stribeck_friction", "torque_gain"])
    models = slots_of(legs.problem, legs.start, *([get_effect(name) for name in names] for names in sets))
    expected, got = both(legs.twins, models, kernels)
    assert float((expected - got).abs().max()) < 1e-8
    rows = expected[::2]
    assert all(float((row - rows[0]).abs().max()) > 1e-5 for row in rows[1:])


def test_drives_that_delay_their_torque_or_run_at_control_steps(kernels, bench):
    for delay_mode in ("command", "effort"):
        cfg = env_cfg()
        for drive in cfg.scene.robot.actuators.values():
            drive.delay_mode, drive.control_decimation = delay_mode, cfg.decimation
        problem = make_problem(bench.problem.dataset.recordings[0], cfg=cfg).with_physics_dt(0.000625)
        twins = twin_problem(problem, bench.twins.path.select([0]))
        models = slots_of(problem, bench.start, [get_effect("other_delay"), get_effect("integral_gain")])
        expected, got = both(twins, models, kernels)
        assert float((expected - got).abs().max()) < 1e-8


def test_drives_that_are_switched_off_and_samples_beside_the_steps(kernels, bench):
    data = bench.twins.dataset
    enable = torch.ones_like(data.sampled)
    enable[20:45] = False
    offset = torch.linspace(-0.5, 0.5, len(enable), dtype=torch.float64)[:, None].expand(enable.shape)
    twins = replace(bench.twins, dataset=replace(data, torque_enable=enable, sample_offset=offset))
    sets = (["off_damping"], ["measurement_delay", "backlash"])
    models = slots_of(bench.problem, bench.start, *([get_effect(name) for name in names] for names in sets))
    expected, got = both(twins, models, kernels)
    assert float((expected - got).abs().max()) < 1e-8
    assert float((expected - both(bench.twins, models, kernels)[0]).abs().max()) > 1e-3


def test_the_processor_simulates_what_no_kernel_can(kernels, bench, monkeypatch):
    monkeypatch.setitem(registry._EFFECTS, Branching.name, Branching)
    models = slots_of(bench.problem, bench.start, [Branching])
    slots, values = [Slot(model=model, rows=1) for model, _ in models], [own[None] for _, own in models]
    batches = SideBySide(bench.twins, slots, True), SideBySide(bench.twins, slots, True, **kernels)
    where = batches[0].dataset.train.clone()
    where[20:] = False
    expected, got = (batch.simulate(values, where) for batch in batches)
    assert torch.equal(expected, got.cpu()) and got.device == kernels["device"] and batches[1]._kernels is None


@pytest.mark.parametrize(
    ("name", "message"),
    [("cuda:99", "torch finds|there are"), ("inf", "expected cpu"), ("os:x", "expected cpu"), ("meta", "expected")],
)
def test_a_device_that_is_not_there_is_refused(name, message):
    with pytest.raises(ValueError, match=message):
        fits_on(name, DEFAULT)
    with pytest.raises(ValueError, match=message):
        make_simulation(SimulationCfg(device=name), None, 1)


def test_no_recording_leaves_a_trace_in_the_drives(kernels, bench):
    """A batch that was simulated by kernels goes on as one that was not."""
    model, values = slots_of(bench.problem, bench.start, [get_effect("backlash")])[1]
    slots = [Slot(model=replace(model), rows=1)]
    one, other = SideBySide(bench.twins, slots, True), SideBySide(bench.twins, slots, True, **kernels)
    where = one.dataset.train.clone()
    where[30:] = False
    other.simulate([values[None]], where)
    other._kernels = None
    assert torch.equal(one.simulate([values[None]], where), other.simulate([values[None]], where).cpu())


def test_a_processor_without_a_compiler_simulates_the_drives_themselves(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    host_kernels.cache_clear()
    try:
        assert host_kernels() is None
        assert fits_on("cpu", DEFAULT).batch.keywords["compiler"] is None
    finally:
        host_kernels.cache_clear()


@pytest.fixture
def keeps(monkeypatch, tmp_path):
    """Makes the kernels of the processor anew, as another process would; they are kept below the given base folder."""
    if shutil.which("c++") is None:
        pytest.skip("needs a compiler of C++")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    host_kernels.cache_clear()
    yield host_kernels.__wrapped__
    host_kernels.cache_clear()


DOUBLE = 'extern "C" void simulate(double* x) { *x *= 2.0; }'


def doubled(kernels):
    kernels.compile([DOUBLE])
    value = torch.tensor(21.0, dtype=torch.float64)
    kernels.launch(DOUBLE, 1, 1, [value])
    return float(value)


def test_kernels_are_kept_in_a_folder_that_is_the_user_s_alone_and_not_compiled_again(keeps, tmp_path):
    folder = tmp_path / "pace" / "kernels"
    assert doubled(keeps()) == 42.0
    kept = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert doubled(keeps()) == 42.0
    assert {path.name: path.stat().st_mtime_ns for path in folder.iterdir()} == kept and len(kept) == 2
    assert all(each.stat().st_mode & 0o777 == 0o700 for each in (folder, folder.parent))
    with pytest.raises(CannotCompileError):
        keeps().compile(["this is no C"])
    assert set(kept) == {path.name for path in folder.iterdir()}


@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a compiler of C++")
@pytest.mark.parametrize("part", [0.0, 0.1, 0.9])
def test_a_kernel_that_was_cut_short_is_compiled_again(warm, tmp_path, part):
    """Loaded, it ended the process with SIGBUS, each time."""
    script = (
        "import torch; from pace_envs.compiler import host_kernels; kernels = host_kernels()\n"
        f"kernels.compile([{DOUBLE!r}]); x = torch.tensor(4.0, dtype=torch.float64)\n"
        f"kernels.launch({DOUBLE!r}, 1, 1, [x]); print(float(x))"
    )
    for _ in range(2):
        done = warm.run("-c", script, env={**os.environ, "XDG_CACHE_HOME": str(tmp_path)})
        assert (done.returncode, done.stdout) == (0, "8.0\n"), done
        for path in (tmp_path / "pace" / "kernels").iterdir():
            path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])


def test_a_compiler_that_never_ends_leaves_the_simulation_without_kernels(monkeypatch, tmp_path):
    compiler = tmp_path / "c++"
    compiler.write_text("#!/bin/sh\nsleep 1000 & wait\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(host, "_FIRST_S", 0.3)
    begin = time.monotonic()
    with pytest.warns(UserWarning, match=r"c\+\+ has not ended after 0\.3 s: the simulation continues without"):
        assert host_kernels.__wrapped__() is None
    assert time.monotonic() - begin < 5.0
