"""Operations that are put off and done in few kernels give what torch gives; here by kernels of the processor."""

from __future__ import annotations

import contextlib

import pytest
import torch
from without_chance import NUM_ENVS, without_chance

from pace_actuators import ActuatorActions, DelayBuffer, Effect, PaceDCMotor, PaceDCMotorCfg
from pace_actuators.effects import EffectCfg, get_effect
from pace_envs import ManagerBasedRLEnv
from pace_envs.compiler import host_kernels
from pace_envs.compiler.fusion import Fusion, fusion_for, launch_pending

pytestmark = pytest.mark.skipif(host_kernels() is None, reason="needs a compiler of C++")
N = 37
DRIVE = {
    "stiffness": 85.0,
    "damping": 0.6,
    "armature": 0.1,
    "friction": 0.5,
    "viscous_friction": 2.0,
    "delay": 2.4,
    "max_delay": 6.0,
    "saturation_effort": 120.0,
    "effort_limit": 80.0,
    "velocity_limit": 7.5,
}


@pytest.fixture
def fusion() -> Fusion:
    found = fusion_for(N, torch.device("cpu"))
    assert found is not None
    return found


def numbers(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)), dtype=torch.float64)


def both(fusion: Fusion, function, *tensors: torch.Tensor) -> None:
    """The function gives and changes the same with and without, and its kernels are all its own."""
    plain, own = [t.clone() for t in tensors], [t.clone() for t in tensors]
    expected = function(*plain)
    with fusion:
        got = function(*own)
    assert not fusion.left and fusion.launched
    for a, b in zip((*expected, *plain), (*got, *own), strict=True):
        torch.testing.assert_close(b, a, rtol=1e-12, atol=1e-12, equal_nan=True)


def test_elements_rows_and_sums_over_them(fusion):
    def function(x, y, done, scale):
        z = (x * scale + y[:, :1] - 0.3).clamp(-1.0, 2.0).abs().sqrt()
        w = torch.where(done[:, None], z, x.exp()).square().sum(dim=1)
        far = (w > 1.0) | ~done
        norm = x.norm(dim=1) / (1.0 + y.mean(dim=1))
        x[:, 1:3] += y[:, :2]
        y[done] = 0.0
        return z, w, far, norm, torch.stack([w, norm], dim=1), torch.cat([x, y], dim=1), x.any(dim=1), far.long().sum()

    both(fusion, function, numbers(N, 4), numbers(N, 5), numbers(N) > 0.0, numbers(4))


def test_what_only_leads_to_a_result_is_not_written_to_memory(fusion, monkeypatch):
    sources, compiled = [], fusion._compiler.compile
    monkeypatch.setattr(fusion._compiler, "compile", lambda each: (sources.extend(each), compiled(each)))
    x = numbers(N, 3)
    with fusion:
        y = torch.cat([(x * 2.0 + 1.0).abs().sqrt(), torch.linalg.cross(x, x + 1.0)], dim=1).sum(dim=1)
    (source,) = sources
    assert source.partition("simulate(")[2].count("] = ") == 1 and y.shape == (N,)


def test_what_all_rows_make_comes_back_to_each(fusion):
    def function(totals, done, level):
        mean = torch.where(done, totals, 0.0).sum(dim=1) / done.sum()
        totals.masked_fill_(done, 0.0)
        level.copy_(torch.where(done.any() & (mean[0] > -1.0), (level + 0.1).clamp(max=1.0), level))
        totals[0] += level
        return mean, totals.sum(dim=0) * level, torch.stack([mean[0], level])

    both(fusion, function, numbers(3, N), numbers(N) > 0.0, torch.tensor(0.5, dtype=torch.float64))


def test_all_rows_are_known_by_their_indices_and_columns_by_their_numbers(fusion):
    columns = torch.tensor([3, 0, -1])

    def function(x, y):
        ids = torch.arange(N)
        x[ids, 1:3] = y[ids][:, :2]
        x[ids[:, None], columns[None, :]] = y[:, :3] * 2.0
        x[:, columns] *= 0.5
        return x.index_select(1, torch.tensor([1, 2])), x[ids, :2] + 1.0

    expected = numbers(N, 5), numbers(N, 4)
    wanted = function(*[t.clone() for t in expected])
    got_in = [t.clone() for t in expected]
    with fusion:
        got = function(*got_in)
    assert all(torch.equal(a, b) for a, b in zip(wanted, got, strict=True))
    assert not [name for name in fusion.left if "index" in name]


def test_indices_that_were_changed_are_not_taken_for_all_rows(fusion):
    x = numbers(N, 2)
    with fusion:
        ids = torch.arange(N)
        ids.fmod_(2)
        got = x[ids] * 1.0
    assert torch.equal(got, x[torch.arange(N) % 2])


def test_rows_that_read_other_rows_wait_for_them(fusion):
    def function(ring):
        ring[N:] = ring[:N] + 1.0
        ring[1 : N + 1] = ring[:N] * 2.0
        return (ring[:N] - ring[N:],)

    both(fusion, function, numbers(2 * N, 3))


def test_rows_find_their_entries_by_numbers_and_write_them(fusion):
    place = torch.arange(N)[:, None] % 4

    def function(ring, x):
        table = ring.view(5, N, 3)
        table.scatter_(0, (place + 1).expand_as(x)[None], x[None])
        return (table.gather(0, place.expand_as(x)[None])[0] * 2.0,)

    both(fusion, function, numbers(5 * N, 3), numbers(N, 3))


@pytest.mark.slow
@pytest.mark.parametrize("effects", [(), ("stribeck_friction", "drive_bandwidth", "other_delay", "joint_elasticity")])
def test_a_drive_is_one_kernel_a_call_with_effects_too(fusion, effects):
    """As on a GPU: delays and effects count in tensors, and are reset by a mask."""
    wanted = [EffectCfg(effect=name, values={p.name: p.start for p in get_effect(name).parameters}) for name in effects]
    cfg = PaceDCMotorCfg(joint_names_expr=".*", effects=wanted, physics_dt=0.0025, **DRIVE)
    plain, own = (PaceDCMotor(cfg, ["hip", "knee"], slice(None), N, dtype=torch.float64) for _ in range(2))
    for part in own.parts().values():
        if isinstance(part, Effect | DelayBuffer):
            part._on_device = True
        if isinstance(part, DelayBuffer):
            part._index_lags()
    launched = []
    for k in range(12):
        target, q, v = (0.1 * (k + 1) * numbers(N, 2) * scale for scale in (1.0, 0.9, 3.0))
        before = fusion.launched
        for drive, context in ((plain, contextlib.nullcontext()), (own, fusion)):
            with context:
                if k == 7:
                    drive.reset(torch.arange(N) % 3 == 0)
                drive.compute(ActuatorActions(target, None, None), q, v)
        torch.testing.assert_close(own.applied_effort, plain.applied_effort, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(own.joint_friction, plain.joint_friction, rtol=1e-10, atol=1e-10)
        launched.append(fusion.launched - before)
    assert not fusion.left and launched[-1] == 1


def test_what_a_kernel_cannot_do_is_done_by_torch_in_its_order(fusion):
    x = numbers(N, 3)
    with fusion:
        y = (x * 2.0).sort(dim=0).values + 1.0
        first = float(y[0, 0])  # looked at
        x += 1.0
        launch_pending()
    assert any("sort" in name for name in fusion.left)
    expected = (numbers(N, 3) * 2.0).sort(dim=0).values + 1.0
    assert torch.equal(y, expected) and first == float(expected[0, 0])


def test_draws_repeat_with_the_seed_and_are_not_the_same_twice(fusion):
    generator, seen = torch.Generator(), []
    for seed in (1, 1, 1, 2):
        generator.manual_seed(seed)
        with fusion:
            draws = [torch.rand((N, k), generator=generator, device="cpu") * 1.0 for k in (2, 3)]
        seen.append(torch.cat(draws, dim=1))
    assert torch.equal(seen[1], seen[2]) and not torch.equal(seen[2], seen[3])
    assert len(seen[2].unique()) == 5 * N and 0.4 < float(seen[2].mean()) < 0.6


@pytest.mark.slow
def test_what_follows_the_physics_is_the_same_in_few_kernels():
    plain, fused = ManagerBasedRLEnv(without_chance()), ManagerBasedRLEnv(without_chance())
    fusion = fusion_for(NUM_ENVS, torch.device("cpu"))
    assert fusion is not None
    for env in (plain, fused):
        env.masks_resets = True
        env.reset(seed=1)
        env.episode_length_buf[:] = torch.arange(NUM_ENVS) + 15
    after, rows, reset, forward = fused._after_physics, fused.sim.rows, fused.sim.reset, fused.sim.forward

    def in_few_kernels() -> dict[str, torch.Tensor]:
        with fusion:
            return after()

    fused._after_physics = in_few_kernels  # type: ignore[method-assign]
    fused.sim.rows = lambda ids: ids if isinstance(ids, torch.Tensor) else rows(ids)  # type: ignore[method-assign]
    fused.sim.reset = lambda *args: (launch_pending(), reset(*args))[1]  # type: ignore[method-assign]  # MuJoCo's own
    fused.sim.forward = lambda *args: (launch_pending(), forward(*args))[1]  # type: ignore[method-assign]
    generator = torch.Generator().manual_seed(0)
    for _ in range(16):
        action = 1.5 * torch.randn(NUM_ENVS, 12, generator=generator)
        expected, got = plain.step(action), fused.step(action)
        for a, b in zip((expected[0]["policy"], *expected[1:4]), (got[0]["policy"], *got[1:4]), strict=True):
            torch.testing.assert_close(b, a, rtol=1e-9, atol=1e-9)
        for a, b in zip(plain.sim.state, fused.sim.state, strict=True):
            torch.testing.assert_close(b, a, rtol=1e-9, atol=1e-9)
        log = {name: float(value) for name, value in got[4]["log"].items()}
        assert log == pytest.approx({n: float(v) for n, v in expected[4]["log"].items()}, abs=1e-6, nan_ok=True)
    assert fusion.launched < 12 * 16
