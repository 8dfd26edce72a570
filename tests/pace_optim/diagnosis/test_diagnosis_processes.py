"""Effects tried side by side in several processes."""

import gc
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from diagnoses import FITS, joint_alone

from pace_actuators.effects import Effect, get_effect
from pace_optim.diagnosis.candidates.multistart import multistart
from pace_optim.diagnosis.candidates.screening import screen
from pace_optim.diagnosis.diagnosis_cfg import DEFAULT
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import BASE, JointModel, start_values
from pace_optim.terminal import parallel as processes
from pace_optim.terminal.parallel import parallel_map

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux only")

GAIN, STRIBECK, RIPPLE = (get_effect(name) for name in ("torque_gain", "stribeck_friction", "torque_ripple"))
ELASTICITY = get_effect("joint_elasticity")
CFG = DEFAULT.candidates


@pytest.fixture(autouse=True)
def two_processors(monkeypatch):
    monkeypatch.setattr(processes, "available_processors", lambda: 2)


def test_results_come_back_in_order_from_two_processes():
    items, effects = list("abcde"), [GAIN, STRIBECK, GAIN, None, RIPPLE]
    found = parallel_map(lambda own: [(item, os.getpid()) for item in own], items, effects)
    assert [item for item, _ in found] == items
    assert len({process for _, process in found}) == 2
    assert found[0][1] == found[2][1], "items of one effect stay together"


def test_one_effect_needs_no_second_process():
    assert set(parallel_map(lambda own: [os.getpid()] * len(own), "ab", [GAIN, GAIN])) == {os.getpid()}


def test_every_process_gets_about_as_much():
    assert processes._shares([GAIN, STRIBECK, ELASTICITY, RIPPLE], 2) == [[0, 2], [1, 3]]
    assert processes._shares([GAIN, GAIN, GAIN, None, STRIBECK, RIPPLE], 2) == [[0, 1, 2], [3, 4, 5]]
    assert processes._shares([GAIN, RIPPLE], 8) == [[0], [1]]


def test_worker_processes_and_other_systems_do_it_alone(monkeypatch):
    def pids():
        return set(parallel_map(lambda own: [os.getpid()] * len(own), "ab", [GAIN, RIPPLE]))

    monkeypatch.setattr(processes.sys, "platform", "darwin")
    assert pids() == {os.getpid()}
    monkeypatch.setattr(processes.sys, "platform", "linux")
    assert len(pids()) == 2
    monkeypatch.setattr(processes.multiprocessing, "parent_process", lambda: SimpleNamespace())
    assert pids() == {os.getpid()}


def test_effects_and_tensors_of_a_user_survive_the_way_back():
    class Own(Effect):
        """Defined where pickle cannot find it."""

        name = "own"
        is_stiff = False

    def work(own):
        return [SimpleNamespace(effect=effect, x=torch.full((2, 3), 0.1, dtype=torch.float64)) for effect in own]

    for order in ([GAIN, Own], [Own, GAIN]):
        found = parallel_map(work, order, order)
        assert [each.effect for each in found] == order
        assert all(torch.equal(each.x, torch.full((2, 3), 0.1, dtype=torch.float64)) for each in found)


@pytest.mark.parametrize("wrong", ["first", "other"])
def test_an_error_reaches_the_caller_and_leaves_nothing_behind(wrong):
    here = os.getpid()
    children = Path(f"/proc/self/task/{here}/children")
    before, collects, others = os.sched_getaffinity(0), gc.isenabled(), children.read_text()

    def work(own):
        if (os.getpid() == here) == (wrong == "first"):
            raise ValueError(f"{own[0]} is wrong")
        return own

    with pytest.raises(ValueError, match="is wrong"):
        parallel_map(work, "ab", [GAIN, RIPPLE])
    assert os.sched_getaffinity(0) == before and gc.isenabled() == collects
    assert children.read_text() == others  # no process is left


def test_a_process_that_is_killed_is_told():
    here = os.getpid()

    def work(own):
        if os.getpid() != here:
            os.kill(os.getpid(), 9)
        return own

    with pytest.raises(RuntimeError, match=r"exit code -9.*taskset"):
        parallel_map(work, "ab", [GAIN, RIPPLE])


class TwoWordsError(Exception):
    """Pickle cannot make it again."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


@pytest.mark.parametrize("error", [ValueError("this and that"), TwoWordsError("this", "that")])
def test_what_went_wrong_elsewhere_is_told_with_its_place(error):
    here = os.getpid()

    def work_of_a_user(own):
        if os.getpid() != here:
            raise error
        return own

    with pytest.raises(Exception, match="this and that") as caught:
        parallel_map(work_of_a_user, "ab", [GAIN, RIPPLE])
    told = "".join([str(caught.value), *getattr(caught.value, "__notes__", [])])
    assert "in work_of_a_user" in told


@pytest.mark.slow
def test_a_process_ends_with_the_one_that_started_it(warm, tmp_path):
    """A result that nobody reads must not keep it."""
    script = tmp_path / "started.py"
    script.write_text(
        "import os, sys\n"
        "from pace_actuators.effects import get_effect\n"
        "from pace_optim.terminal import parallel as processes\n"
        "processes.available_processors = lambda: 2\n"
        "here = os.getpid()\n"
        "def work(own):\n"
        "    if os.getpid() == here:\n"
        "        sys.stdin.readline()\n"
        "        os.kill(here, 9)\n"
        "    print(os.getpid(), flush=True)\n"
        "    return [bytes(10**7)]\n"
        "processes.parallel_map(work, 'ab', [get_effect('torque_gain'), get_effect('torque_ripple')])\n"
    )
    first = warm.start(script, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    other = int(first.stdout.readline())
    first.stdin.write("\n")
    first.stdin.flush()
    first.wait(timeout=60)
    for _ in range(100):
        if not Path(f"/proc/{other}").exists():
            return
        time.sleep(0.1)
    pytest.fail("the other process still runs")


def test_a_collection_in_the_fork_does_not_touch_simulations(monkeypatch):
    found = parallel_map(lambda own: [gc.isenabled()] * len(own), "ab", [GAIN, RIPPLE])
    assert found == [True, False]


@pytest.mark.slow
def test_what_is_found_does_not_depend_on_the_number_of_processes(monkeypatch):
    bench = joint_alone()
    model, yes = JointModel.base(bench.problem), torch.tensor([True])
    base = FITS.side_by_side(bench.twins, [Fitted.start(model, bench.truth_values)], 2, keep_jacobian=True)[0]
    effects, effort = [GAIN, ELASTICITY, RIPPLE], torch.tensor([5.0], dtype=torch.float64)
    heavy = bench.truth_values.clone()
    heavy[:, BASE.index("armature")] *= 2  # takes longer than one at the truth

    def found():
        own = [start_values(effect, {})[None] for effect in effects]
        starts = [
            Fitted.start(*model.extended(values, effect, yes, each), effect)
            for effect, values, each in zip(effects, (bench.truth_values, heavy, heavy), own, strict=True)
        ]
        fits = FITS.side_by_side(bench.twins, starts, 4, keep_jacobian=True, part=0.4)
        return (
            screen(FITS, bench.twins, base, effects, effort, CFG),
            fits,
            multistart(FITS, bench.twins, base, effects, CFG),
        )

    probes, fits, far = found()
    monkeypatch.setattr(processes, "available_processors", lambda: 1)
    probes_alone, fits_alone, far_alone = found()
    assert [p.effect for p in probes] == [p.effect for p in probes_alone]
    assert [float(p.score) for p in probes] == pytest.approx([float(p.score) for p in probes_alone], abs=1e-6)
    without_combs = [effect for effect in effects if effect.comb is None]  # those are scanned by the screening
    for several, alone, tried in ((fits, fits_alone, effects), (far, far_alone, without_combs)):
        assert list(dict.fromkeys(fit.tried for fit in several)) == tried
        for one, other in zip(several, alone, strict=True):
            assert torch.allclose(one.x, other.x, atol=1e-5) and one.model.effects == other.model.effects
    for one, other in zip(fits, fits_alone, strict=True):
        assert torch.allclose(one.score, other.score, rtol=1e-3)
        assert torch.allclose(one.error, other.error, atol=1e-6)
        assert torch.allclose(one.jacobian, other.jacobian, rtol=1e-2, atol=1e-3)
