"""Effects in simulated robots: nothing at their null, finite at their bounds, no energy out of nothing."""

import itertools
from functools import cache

import numpy as np
import pytest
import torch
from effect_envs import EFFECTS, Bench, long_chirp, null_values, rms
from problems import ANYMAL, BENCH, CALM, DT, TRUTH, chirp, env_cfg, legs_chirp

from pace_actuators.effects import EffectCfg, get_effect

MOVING = chirp(1.0, high=8.0, amplitude=0.7)
HEAVY = {"load_mass": 2.0, "load_length": 0.375, "arm_mass": 0.33}
FAST = ("joint_elasticity", "backlash", "presliding_friction", "mount_compliance", "creeping_friction", "soft_friction")


def jagged(count, reach, effort):
    """A curve that goes up and down between its knots."""
    return {f"effort_{i}": effort * (-1) ** i for i in range(count)} | {"reach": reach}


ENERGY = {
    "stribeck_friction": [{"effort": 4.0, "velocity": 0.01}, {"effort": 1.0, "velocity": 0.3}],
    "load_dependent_friction": [{"coefficient": 0.5}, {"coefficient": 0.05}],
    "quadratic_friction": [{"coefficient": 3.0}, {"coefficient": -1.0}, {"coefficient": -0.05}],
    "friction_drift": [{"ratio": -0.8, "time_constant": 1.0}, {"ratio": 0.8, "time_constant": 1.0}],
    "presliding_friction": [{"stiffness": k} for k in (10.0, 300.0, 3000.0)],
    "creeping_friction": [{"velocity": v} for v in (1e-4, 0.01, 0.5)],
    "soft_friction": [{"time_constant": t} for t in (1e-3, 0.02, 0.2)],
    "friction_over_speed": [jagged(8, 5.0, effort) for effort in (0.3, -10.0)],
    "friction_over_position": [jagged(16, 1.5, effort) for effort in (0.3, 10.0)],
    "friction_over_load": [jagged(8, 10.0, effort) for effort in (0.3, -10.0)],
    "joint_elasticity": [{"stiffness": k, "damping": c} for k in (80.0, 1e3, 2e4) for c in (0.0, 0.5, 20.0)],
    "backlash": [{"gap": g, "stiffness": k, "damping": 0.0} for g in (0.004, 0.05) for k in (300.0, 2e4)],
}
"""Friction and transmission effects that only store or spend energy; the others are torques of their own."""


def at_knot(name, parameter):
    """Whether it is one of a curve's values."""
    return get_effect(name).free_form and parameter.null is not None


def bounds_corners(name):
    """All combinations of lower and upper bounds, {parameter: (corners,)}; of a curve's values flat and jagged ones."""
    parameters = get_effect(name).parameters
    corners = list(itertools.product(*((p.lower, p.upper) for p in parameters if not at_knot(name, p))))
    if get_effect(name).free_form:
        ends = [(p.lower, p.upper) for p in parameters if at_knot(name, p)]
        curves = [
            [end[(first + i * jagged) % 2] for i, end in enumerate(ends)] for first in (0, 1) for jagged in (0, 1)
        ]
        corners = [(*curve, *shape) for curve in curves for shape in corners]
    return {f"{name}.{p.name}": [c[i] for c in corners] for i, p in enumerate(parameters)}, len(corners)


@pytest.mark.slow
@pytest.mark.parametrize(("calls", "integrator"), [(1, "implicitfast"), (2, "implicitfast"), (2, "leapfrog")])
@pytest.mark.parametrize("delay_mode", ["command", "effort"])
def test_at_their_null_all_effects_are_the_base_model_bit_for_bit(delay_mode, calls, integrator):
    options = {"base": CALM, "delay_mode": delay_mode, "calls": calls, "integrator": integrator, "load": HEAVY}
    targets = MOVING[200:210]
    expected = Bench(**options).follow(targets, sensed=True)[:, 0]
    each_alone = Bench([EffectCfg(effect=name, env_rows=slice(i, i + 1)) for i, name in enumerate(EFFECTS)],
                       num_envs=len(EFFECTS), **options)  # fmt: skip
    write_rows(each_alone, [null_values(name) for name in EFFECTS])
    reached = each_alone.follow(targets, sensed=True)
    assert not [name for i, name in enumerate(EFFECTS) if not torch.equal(reached[:, i], expected)]
    assert torch.equal(Bench(EFFECTS, **options).follow(targets, sensed=True)[:, 0], expected)


def test_a_payload_of_nothing_keeps_a_loaded_robot_bit_for_bit():
    masses = []
    for effects in ((), ("payload", "com_offset")):
        bench = Bench(load={"load_mass": 0.7})
        bench = Bench(effects, load={"load_mass": 0.7}) if effects else bench
        bench.robot.add_body_mass("load", 0.1)
        if effects:
            bench.robot.write_effect_parameter_to_sim("payload", "ratio", torch.zeros(1, 1, dtype=torch.float64))
        masses.append(bench.env.sim.expand("body_mass").clone())
        bench.env.close()
    assert torch.equal(*masses)


def write_rows(bench, values):
    """Write effects that act on some environments each: {parameter: value} of every environment."""
    (actuator,) = bench.robot.actuators.values()
    for effect in bench.effects.effects:
        for key in (p.name for p in effect.parameters):
            own = [each[f"{effect.name}.{key}"] for each in values[effect.rows]]
            effect.set_parameter(key, torch.tensor(own, dtype=torch.float64)[:, None])
        bench.robot._write_passive(actuator)
        if effect.overrides("write_model"):
            bench.robot._write_model(actuator, effect)


def all_corners(names, bases):
    """Rows on which effects have all corners of their bounds, side by side, each with each base.

    Returns the effects' configurations, their values in each row, and the base parameters of all rows.
    """
    cfgs, corners, rows = [], [], []
    for name in names:
        values, count = bounds_corners(name)
        begin = len(corners)
        for base in bases:
            corners += [{key: v[i] for key, v in values.items()} for i in range(count)]
            rows += [base] * count
        cfgs.append(EffectCfg(effect=name, env_rows=slice(begin, len(corners))))
    return cfgs, corners, {key: torch.tensor([row[key] for row in rows], dtype=torch.float64) for key in bases[0]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "seconds"), [("implicitfast", 2.5), ("leapfrog", 5.0)]
)  # the harder one for longer
def test_the_extremes_of_all_bounds_stay_finite_at_the_control_step(integrator, seconds):
    light = {**TRUTH, "armature": 0.01, "friction": 2.0, "viscous_friction": 0.0, "delay": 0.0}
    cfgs, corners, base = all_corners(EFFECTS, (TRUTH, light))
    bench = Bench(cfgs, num_envs=len(corners), base=base, integrator=integrator)
    write_rows(bench, corners)
    reached = bench.follow(long_chirp(seconds))[:, :, 0]
    for i, corner in enumerate(corners):
        assert bool(reached[:, i].isfinite().all()), (i, corner)
        assert float(reached[:, i].abs().max()) < 10.0, (i, corner)


@pytest.mark.slow
@pytest.mark.parametrize(("calls", "integrator"), [(1, "implicitfast"), (2, "leapfrog")])
def test_the_extremes_stay_finite_on_a_robot_with_legs(calls, integrator):
    targets = legs_chirp(env_cfg(ANYMAL), 2.0)
    cfgs, corners, base = all_corners(
        FAST, [{"armature": 0.1, "viscous_friction": 1.0, "friction": 1.0, "encoder_bias": 0.0, "delay": 1.0}]
    )
    bench = Bench(cfgs, num_envs=len(corners), task=ANYMAL, base=base, calls=calls, integrator=integrator)
    write_rows(bench, corners)
    reached = bench.follow(targets)
    far = (reached - torch.as_tensor(targets)[:, None]).abs().amax(dim=(0, 2))
    for i, corner in enumerate(corners):
        assert bool(reached[:, i].isfinite().all()), corner
        # the softest spring resonates: 3.02 at the finest steps
        assert float(far[i]) < 3.1, corner


def mechanical_energy(bench, load, base):
    """Of link, motor and spring, (num_envs,) [J]."""
    mass, length, arm = load["load_mass"], load["load_length"], load["arm_mass"]
    inertia = mass * length**2 + arm * length**2 / 3
    weight = 9.81 * length * (mass + arm / 2)
    q, v = bench.robot.data.joint_pos[:, 0], bench.robot.data.joint_vel[:, 0]
    energy = 0.5 * inertia * v**2 + weight * (1 - torch.cos(q))
    for effect in bench.effects.effects:
        rows = effect.rows
        if hasattr(effect, "spring"):
            moved = effect._angle - q[rows, None]
            torque, stiffness = effect.spring(moved)
            spring = torch.where(stiffness > 0, torque**2 / (2 * stiffness.clamp(min=1e-9)), 0.0)[:, 0]
            assert bool((moved.abs() < 0.3).all())
            energy[rows] += 0.5 * base["armature"] * effect._speed[:, 0] ** 2 + spring
        else:
            energy[rows] += 0.5 * base["armature"] * v[rows] ** 2
        if hasattr(effect, "_bristle"):
            energy[rows] += 0.5 * effect._sigma[:, 0] * effect._bristle[:, 0] ** 2
    return energy


@pytest.mark.slow
@pytest.mark.parametrize(
    ("calls", "integrator", "seconds"),
    [(1, "implicitfast", 2.5), (5, "implicitfast", 2.5), (2, "leapfrog", 2.5), (5, "leapfrog", 2.5)],
)
def test_a_free_swing_never_gains_energy(calls, integrator, seconds):
    load = {"load_mass": 2.0, "load_length": 0.375, "arm_mass": 0.0}
    base = {"armature": 0.1, "viscous_friction": 0.05, "friction": 0.1, "encoder_bias": 0.0, "delay": 0.0}
    cfgs, values = [], []
    for name, cases in ENERGY.items():  # side by side, each on its rows
        cfgs.append(EffectCfg(effect=name, env_rows=slice(len(values), len(values) + len(cases))))
        starts = {p.name: p.start for p in get_effect(name).parameters}
        nulls = {p.name: p.null for p in get_effect(name).parameters if p.null is not None}
        values += [{f"{name}.{key}": value for key, value in (starts | nulls | case).items()} for case in cases]
    bench = Bench(cfgs, num_envs=len(values), base=base, calls=calls, integrator=integrator, load=load)
    write_rows(bench, values)
    bench.disable()
    bench.start(1.5)
    for step in range(round(seconds / DT)):
        bench.robot.sensed_joint_pos()  # brings the motor to the present
        energy = mechanical_energy(bench, load, base)
        if step == 3:  # the spring has taken up the load
            start = lowest = energy
        elif step > 3:  # 0.3 % of 11 J is what steps of 2.5 ms leave at the stiffest contact
            gains = (energy - lowest >= 0.03).nonzero()[:, 0].tolist()
            assert not gains, (step * DT, [values[i] for i in gains])
            lowest = torch.minimum(lowest, energy)
        bench.env.simulate(torch.zeros(len(values), 1, dtype=torch.float64))
    held = (energy >= 0.9 * start).nonzero()[:, 0].tolist()
    assert not held, [values[i] for i in held]
    bench.env.close()


def test_an_effect_acts_only_on_its_rows_and_joints():
    rows = EffectCfg(effect="torque_offset", env_rows=slice(1, 3), values={"effort": 2.0})
    bench = Bench([rows], {"torque_offset.effort": 2.0}, num_envs=4)
    reached = bench.follow(MOVING)
    base = Bench(num_envs=1).follow(MOVING)
    assert torch.equal(reached[:, [0, 3]], base.expand(-1, 2, -1))
    assert float((reached[:, 1:3] - base).abs().max()) > 0.01
    cfg = env_cfg(ANYMAL)
    knees = [i for i, name in enumerate(cfg.sim2real.joint_order) if name.endswith("KFE")]
    base_values = {"armature": 0.1, "viscous_friction": 1.0, "friction": 0.5, "encoder_bias": 0.0, "delay": 1.0}
    targets = legs_chirp(cfg, 0.1)
    bench = Bench(["torque_gain@.*KFE"], {"torque_gain.gain": 1.3}, task=ANYMAL, base=base_values)
    assert [k for p in bench.space.parameters if "." in p.name for k in p.keys] == [
        cfg.sim2real.joint_order[i] for i in knees
    ]
    gain = bench.effects.find("torque_gain").gain
    assert set((gain[0] != 1).nonzero()[:, 0].tolist()) == set(knees)
    bench.follow(targets)


@pytest.mark.slow
def test_environments_with_different_values_do_not_mix():
    for name in ("stribeck_friction", "joint_elasticity", "drive_bandwidth", "other_delay", "payload"):
        values, count = bounds_corners(name)
        together = Bench([name], values, num_envs=count).follow(MOVING[:100])
        for i in range(count):
            alone = Bench([name], {key: v[i] for key, v in values.items()}).follow(MOVING[:100])
            assert rms(together[:, i], alone[:, 0]) < 1e-12, (name, i)


def side_by_side(starts, each):
    """A bench on which each effect acts on that many rows of its own."""
    cfgs = [EffectCfg(effect=name, env_rows=slice(each * i, each * (i + 1))) for i, name in enumerate(starts)]
    bench = Bench(cfgs, num_envs=each * len(starts), base={**TRUTH, "delay": 0.0})
    write_rows(bench, [values for values in starts.values() for _ in range(each)])
    return bench


@pytest.mark.slow
def test_the_reset_of_an_environment_forgets_its_history_only():
    names = [name for name in EFFECTS if name != "friction_drift"]  # it knows the session's time, which goes on
    starts = {name: {f"{name}.{p.name}": p.start for p in get_effect(name).parameters} for name in names}
    bench, fresh, untouched = (side_by_side(starts, each) for each in (3, 1, 1))
    reset = 3 * torch.arange(len(names)) + 1
    run = [torch.as_tensor(t) for t in MOVING[:80]]
    bench.start(0.0)
    untouched.start(0.0)
    for target in run[:40]:
        for each in (bench, untouched):
            each.env.simulate(target.expand(each.env.num_envs, 1))
    fresh.start(0.0)
    bench.env.scene.reset(reset)
    at_rest = torch.zeros(len(names), 1)
    bench.robot.write_joint_state_to_sim(at_rest, at_rest, env_ids=reset)
    bench.env.sim.forward()
    for target in run[40:]:
        for each in (bench, fresh, untouched):
            each.env.simulate(target.expand(each.env.num_envs, 1))
    ends = zip(names, bench.robot.data.joint_pos.unflatten(0, (-1, 3)), strict=True)
    for (name, q), new, old in zip(ends, fresh.robot.data.joint_pos, untouched.robot.data.joint_pos, strict=True):
        # 1e-6: forward() has brought what the joints carry to the present, half a step early
        assert float((q[[0, 2]] - old).abs().max()) < 1e-6, name
        assert float((q[1] - new).abs().max()) < 1e-9, name
        assert float((q[1] - q[0]).abs().max()) > 1e-9, name
    for each in (bench, fresh, untouched):
        each.env.close()


@pytest.mark.slow
def test_payload_and_com_offset_are_a_hand_changed_model():
    payload = Bench(["payload"], {"payload.ratio": 0.25}, load=HEAVY).follow(MOVING)
    heavier = {**HEAVY, "load_mass": 2.0 * 1.25, "arm_mass": 0.33 * 1.25}
    assert rms(payload, Bench(load=heavier).follow(MOVING)) < 1e-9
    assert rms(payload, Bench(load=HEAVY).follow(MOVING)) > 1e-3


def test_turning_the_mass_is_a_joint_whose_zero_is_elsewhere_wherever_the_load_sits():
    """It was turned as if the load sat where the model file has it: one of another length was not found."""
    reads_load = ["load_dependent_friction"]
    turned = Bench(["com_offset", *reads_load], {"com_offset.angle": 0.2}, load=HEAVY, num_envs=2)
    plain = Bench(reads_load, load=HEAVY, num_envs=2)
    for bench, start in ((turned, 0.3), (plain, 0.5)):  # q -> q + α in gravity alone
        bench.start(start)
        bench.env.simulate(torch.full((2, 1), start).double())
    assert torch.allclose(turned.robot.load_effort, plain.robot.load_effort, rtol=1e-6)
    assert float(plain.robot.load_effort[1].abs()) > 2.0
    turned.env.close()
    plain.env.close()


def test_payload_does_not_scale_a_known_added_mass():
    bench = Bench(["payload"], load=HEAVY)
    bench.robot.add_body_mass("load", 0.8)
    bench.robot.write_effect_parameter_to_sim("payload", "ratio", torch.full((1, 1), 0.5, dtype=torch.float64))
    load = bench.env.sim.model.body("load").id
    assert float(bench.env.sim.expand("body_mass")[0, load]) == pytest.approx(2.0 * 1.5 + 0.8)
    bench.env.close()


PAIRS = [
    (
        ("stribeck_friction", "backlash"),
        {"stribeck_friction.effort": 1.0, "backlash.gap": 0.01, "backlash.encoder_side": 1.0},
    ),
    (("joint_elasticity", "torque_gain"), {"joint_elasticity.stiffness": 300.0, "torque_gain.gain": 1.2}),
    (("encoder_scale", "encoder_eccentricity"), {"encoder_scale.error": 0.05, "encoder_eccentricity.cosine": 0.02}),
    (
        ("load_dependent_friction", "measurement_delay", "drive_bandwidth"),
        {"load_dependent_friction.coefficient": 0.1, "drive_bandwidth.time_constant": 0.005},
    ),
    (
        ("presliding_friction", "stribeck_friction"),
        {"presliding_friction.stiffness": 30.0, "stribeck_friction.effort": 3.0, "stribeck_friction.velocity": 1.0},
    ),
    (("parallel_spring", "torque_offset"), {"parallel_spring.stiffness": 5.0, "torque_offset.effort": 1.0}),
    (
        ("friction_asymmetry", "quadratic_friction"),
        {"friction_asymmetry.effort": 0.5, "quadratic_friction.coefficient": 0.5},
    ),
    (
        ("creeping_friction", "stribeck_friction", "joint_elasticity"),
        {"creeping_friction.velocity": 0.02, "stribeck_friction.effort": 1.0, "joint_elasticity.stiffness": 300.0},
    ),
    (
        ("joint_elasticity", "soft_friction"),
        {"joint_elasticity.stiffness": 300.0, "soft_friction.time_constant": 0.05},
    ),
    (("soft_friction", "stribeck_friction"), {"soft_friction.time_constant": 0.02, "stribeck_friction.effort": 1.0}),
    (("integral_gain", "proportional_gain"), {"integral_gain.gain": 100.0, "proportional_gain.gain": 0.2}),
    (
        ("joint_elasticity", "presliding_friction"),
        {"joint_elasticity.stiffness": 300.0, "presliding_friction.stiffness": 10.0},
    ),
    (("joint_elasticity", "torque_offset"), {"joint_elasticity.stiffness": 300.0, "torque_offset.effort": 1.0}),
    (
        ("joint_elasticity", "friction_asymmetry"),
        {"joint_elasticity.stiffness": 300.0, "friction_asymmetry.effort": 1.0},
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("effects", "values"), PAIRS, ids=lambda x: "+".join(x))
def test_effects_compose_in_any_order(effects, values):
    moving = MOVING[:150]
    one = Bench(effects, values).follow(moving, sensed=True)
    other = Bench(effects[::-1], values).follow(moving, sensed=True)
    assert bool(one.isfinite().all())
    assert rms(one, other) < 1e-9
    for name in effects:
        own = {key: value for key, value in values.items() if key.startswith(name)}
        if own:
            assert rms(one, Bench([name], own).follow(moving, sensed=True)) > 1e-4, name


@pytest.mark.slow
def test_the_stiffest_transmission_is_the_rigid_drive_the_more_the_finer_the_step():
    calm = 0.15 * MOVING[:200]
    values = {"joint_elasticity.stiffness": 2e4, "joint_elasticity.damping": 20.0}
    apart = [
        rms(Bench(["joint_elasticity"], values, calls=n).follow(calm), Bench(calls=n).follow(calm)) for n in (1, 5)
    ]
    assert apart[0] < 1e-3
    assert apart[1] < 0.4 * apart[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("calls", "integrator", "tolerance"), [(1, "implicitfast", 0.05), (5, "implicitfast", 0.01), (2, "leapfrog", 0.02)]
)
def test_the_resonance_of_two_masses_has_its_frequency(calls, integrator, tolerance):
    armature, stiffness = 0.1, 300.0
    load = {"load_mass": 2.0, "load_length": 0.375, "arm_mass": 0.0}
    inertia = 2.0 * 0.375**2
    base = {"armature": armature, "viscous_friction": 0.0, "friction": 0.0, "encoder_bias": 0.0, "delay": 0.0}
    values = {"joint_elasticity.stiffness": stiffness, "joint_elasticity.damping": 0.0}
    bench = Bench(["joint_elasticity"], values, base=base, calls=calls, integrator=integrator, load=load)
    bench.disable()
    bench.start(0.0)
    bench.env.sim.step()
    bench.robot.sensed_joint_pos()
    bench.robot.write_joint_state_to_sim(torch.zeros(1, 1), torch.full((1, 1), 0.5))
    deflection = []
    for _ in range(400):
        bench.robot.sensed_joint_pos()
        effect = bench.effects.effects[0]
        deflection.append(float(effect._angle[0, 0] - bench.robot.data.joint_pos[0, 0]))
        bench.env.simulate(torch.zeros(1, 1, dtype=torch.float64))
    bench.env.close()
    signal = np.array(deflection) - np.mean(deflection)
    crossings = np.flatnonzero((signal[:-1] < 0) & (signal[1:] >= 0))
    exact = crossings - signal[crossings] / (signal[crossings + 1] - signal[crossings])
    frequency = 1 / (np.diff(exact).mean() * DT)
    expected = np.sqrt(stiffness * (1 / armature + 1 / inertia)) / (2 * np.pi)
    assert frequency == pytest.approx(expected, rel=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "moving"), [(BENCH, MOVING[:150]), (ANYMAL, None)], ids=["bench", "legs"])
def test_finer_steps_with_a_stiff_effect_converge(task, moving):
    """On all joints, also on those without it."""
    cfgs = [EffectCfg(effect="joint_elasticity", joint_names_expr=".*" if task == BENCH else "LF_.*")]
    values = {"joint_elasticity.stiffness": 300.0, "joint_elasticity.damping": 1.0}
    base = {"armature": 0.1, "viscous_friction": 4.0, "friction": 0.0, "encoder_bias": 0.0, "delay": 0.0}
    targets = legs_chirp(env_cfg(ANYMAL), 0.4) if moving is None else moving
    reached = [
        Bench(cfgs, values, task=task, base=base, calls=n, integrator="leapfrog").follow(targets)[:, 0]
        for n in (2, 4, 16)
    ]
    coarse, fine = ((each - reached[2]).square().mean(dim=0).sqrt() for each in reached[:2])
    # forces that are quadratic in speed, as legs have, are of first order in the held step
    order = 0.3 if task == BENCH else 0.5
    assert float(fine.max()) < min(2e-4, order * float(coarse.max()))


@pytest.mark.slow
def test_the_gap_is_seen_at_a_reversal():
    """Without load the motor crosses the gap before the link follows."""
    gap = 0.03
    base = {"armature": 0.1, "viscous_friction": 1.0, "friction": 0.2, "encoder_bias": 0.0, "delay": 0.0}
    values = {"backlash.gap": gap, "backlash.stiffness": 2e4, "backlash.damping": 20.0}
    bench = Bench(
        ["backlash"], values, base=base, calls=5, load={"load_mass": 0.001, "load_length": 0.2, "arm_mass": 0.0}
    )
    bench.start(0.0)
    t = np.arange(450) * DT
    deflection = []
    for target in 0.3 * np.sin(2 * np.pi * t):
        bench.robot.sensed_joint_pos()
        effect = bench.effects.effects[0]
        deflection.append(float(effect._angle[0, 0] - bench.robot.data.joint_pos[0, 0]))
        bench.env.simulate(torch.full((1, 1), target, dtype=torch.float64))
    bench.env.close()
    assert max(deflection) - min(deflection) == pytest.approx(gap, rel=0.1)


@cache
def two_bodies(mount):
    """Positions (T,) of the drive's joint on a mount of this stiffness, damping and inertia, with steps of 25 µs."""
    (k, c, own), h = mount, DT / 100
    inertia, weight = 2 * 0.375**2, 9.81 * 2 * 0.375
    inverse = np.linalg.inv([[inertia + 0.1, inertia], [inertia, inertia + own]])
    q, v, result = np.zeros(2), np.zeros(2), []
    for target in 0.5 * MOVING[:300, 0]:
        result.append(q[0])
        torque = 85 * (target - q[0]) - 0.6 * v[0]
        for _ in range(100):
            gravity = weight * np.sin(q.sum())
            v = v + h * inverse @ [torque - 2 * v[0] - gravity, -gravity - k * q[1] - c * v[1]]
            q = q + h * v
    return torch.tensor(np.array(result))


@pytest.mark.slow
@pytest.mark.parametrize(("calls", "tolerance"), [(1, 0.08), (5, 0.01)])
@pytest.mark.parametrize("mount", [(300.0, 1.0, 0.3), (4000.0, 10.0, 2.0), (2e4, 0.0, 0.05)], ids=str)
def test_a_mount_that_gives_way_is_a_second_body(mount, calls, tolerance):
    """Against both bodies together, integrated at 25 µs."""
    targets = 0.5 * MOVING[:300]
    load = {"load_mass": 2.0, "load_length": 0.375, "arm_mass": 0.0}
    base = {"armature": 0.1, "viscous_friction": 2.0, "friction": 0.0, "encoder_bias": 0.0, "delay": 0.0}
    linear = {"velocity_limit": 1e6, "effort_limit": 1e4, "saturation_effort": 1e9, "stiffness": 85.0, "damping": 0.6}
    expected = two_bodies(mount) - two_bodies((1e7, 1e4, 2.0))
    values = dict(zip(("stiffness", "damping", "inertia"), mount, strict=True))
    options = {"base": base, "load": load, "drive": linear, "calls": calls}
    moved = Bench(["mount_compliance"], {f"mount_compliance.{n}": x for n, x in values.items()}, **options)
    change = moved.follow(targets)[:, 0, 0] - Bench(**options).follow(targets)[:, 0, 0]
    assert rms(expected) > 1e-3
    assert rms(change, expected) < tolerance * rms(expected)
