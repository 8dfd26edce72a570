"""Each effect is its closed form; names, parameters and bad input."""

import math

import pytest
import torch
from effect_envs import EFFECTS, Drive

from pace_actuators import ActuatorActions, clip_effort
from pace_actuators.dc_motor import clip_to_line
from pace_actuators.effects import (
    Effect,
    EffectCfg,
    EffectParameter,
    available_effects,
    effect_cfgs,
    get_effect,
    probe_points,
    register_effect,
)
from pace_actuators.effects.fading_friction import IMPEDANCE, WIDEST, step_of_constraint

DT = 0.0025


def test_the_library_holds_what_it_should():
    assert {
        "stribeck_friction", "load_dependent_friction", "friction_asymmetry", "quadratic_friction",
        "presliding_friction", "friction_drift", "torque_offset", "parallel_spring", "torque_gain",
        "proportional_gain", "derivative_gain", "drive_bandwidth", "velocity_filter", "torque_limit",
        "torque_speed_limit", "command_rate_limit", "torque_ripple", "joint_elasticity", "backlash", "payload",
        "com_offset", "encoder_scale", "encoder_eccentricity", "other_delay", "measurement_delay", "clock_skew",
        "mount_compliance", "creeping_friction", "soft_friction", "integral_gain",
        "command_acceleration_limit",
    } <= set(EFFECTS)  # fmt: skip


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_says_what_it_is(name):
    effect = get_effect(name)
    assert effect.equation and effect.looks and effect.source and effect.separates
    assert effect.__doc__
    assert all(twin in available_effects() for twin in effect.twins)
    for point in probe_points(effect):
        assert set(point) == {p.name for p in effect.parameters}
        assert all(p.lower <= point[p.name] <= p.upper for p in effect.parameters)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_keeps_type_and_shape_and_acts_on_its_joints_only(name, dtype):
    start = {p.name: p.start for p in get_effect(name).parameters}
    cfg = EffectCfg(effect=name, joint_names_expr="b|c", values=start)
    drive = Drive([cfg], num_envs=2, joints=("a", "b", "c"), dtype=dtype)
    plain = Drive([], num_envs=2, joints=("a", "b", "c"), dtype=dtype)
    for i in range(20):
        torque = drive(0.3, 0.01 * i, 0.2)
        expected = plain(0.3, 0.01 * i, 0.2)
        assert torque.dtype == dtype and torque.shape == (2, 3)
        assert bool(torque.isfinite().all())
        assert torch.equal(torque[:, 0], expected[:, 0])
    for p in get_effect(name).parameters:
        value = getattr(drive.motor.effects.find(name), p.name)
        assert value.dtype == dtype
        assert value[0, 1:].tolist() == pytest.approx([p.start] * 2)


def test_a_lag_of_first_order_steps_as_the_closed_form():
    time_constant = 0.01
    drive = Drive(["drive_bandwidth"], {"drive_bandwidth.time_constant": time_constant})
    assert drive.one(0.0) == 0.0
    for k in range(20):  # the mean over each step of 100 (1 - exp(-t/T))
        mean = 100 * (1 - time_constant / DT * math.exp(-k * DT / time_constant) * -math.expm1(-DT / time_constant))
        assert drive.one(1.0) == pytest.approx(mean, rel=1e-12)


def test_the_controllers_speed_is_filtered():
    drive = Drive(["velocity_filter"], {"velocity_filter.time_constant": 0.01})
    assert drive.one(v=0.0) == 0.0
    for k in range(1, 10):
        assert drive.one(v=1.0) == pytest.approx(math.expm1(-k * DT / 0.01))


def test_the_targets_rate_is_limited_before_it_is_delayed():
    targets, limit, delay = [0.0, 0.0, 0.31, 0.31, 0.31, -0.2, -0.2, -0.2], 40.0, 1.3
    drive = Drive(["command_rate_limit"], {"command_rate_limit.velocity": limit}, delay=delay)
    inside = [targets[0]]
    for target in targets[1:]:
        inside.append(inside[-1] + max(-limit * DT, min(limit * DT, target - inside[-1])))
    late = [0.7 * inside[max(k - 1, 0)] + 0.3 * inside[max(k - 2, 0)] for k in range(len(inside))]
    assert [drive.one(target) / 100.0 for target in targets] == pytest.approx(late)


def test_the_target_speeds_up_and_brakes_on_its_profile():
    limit, way = 40.0, 0.2
    drive = Drive(["command_acceleration_limit"], {"command_acceleration_limit.acceleration": limit}, damping=0.0)
    assert drive.one(0.0) == 0.0
    inside = [drive.one(way) / 100 for _ in range(round(0.2 / DT))]
    whole = 2 * math.sqrt(way / limit)  # half of the way faster and faster, half of it slower and slower
    for k, x in enumerate(inside, start=1):
        t = k * DT
        exact = 0.5 * limit * t**2 if t < whole / 2 else way - 0.5 * limit * max(whole - t, 0.0) ** 2
        assert x == pytest.approx(exact, abs=0.5 * limit * whole * DT)
    assert max(inside) < way + 0.25 * limit * DT**2 and inside[-1] == pytest.approx(way)
    fast = Drive(["command_acceleration_limit"], {"command_acceleration_limit.acceleration": 2e8})
    assert [fast.one(x) for x in (0.0, 0.3, -0.2)] == pytest.approx([0.0, 30.0, -20.0])


@pytest.mark.parametrize("name", ["joint_elasticity", "backlash"])
def test_a_fit_feels_the_damping_of_a_soft_transmission_from_zero_on(name):
    def torque(damping):
        gap = {"backlash.gap": 0.001} if name == "backlash" else {}
        drive = Drive([name], gap | {f"{name}.stiffness": 2000.0, f"{name}.damping": damping})
        for k in range(4):
            force = drive.one(target=0.3, v=0.1 * k)
        return force

    values = [torque(c) for c in (0.0, 1e-3, 2e-3)]
    assert abs(values[1] - values[0]) > 1e-7
    assert values[2] - values[1] == pytest.approx(values[1] - values[0], rel=0.05)


def test_friction_laws():
    drive = Drive(["stribeck_friction"], {"stribeck_friction.effort": 1.5, "stribeck_friction.velocity": 0.2})
    for v in (0.0, 0.1, -0.2, 3.0):
        drive(v=v)
        assert float(drive.motor.joint_friction) == pytest.approx(0.5 + 1.5 * math.exp(-((v / 0.2) ** 2)))
    drive = Drive(["load_dependent_friction"], {"load_dependent_friction.coefficient": 0.1})
    drive.motor.set_load_effort(torch.tensor([[-4.0]], dtype=torch.float64))
    assert drive.one(0.06) == pytest.approx(6.0)
    assert float(drive.motor.joint_friction) == pytest.approx(0.5 + 0.1 * abs(6.0 + 4.0))
    drive = Drive(["quadratic_friction"], {"quadratic_friction.coefficient": 0.7})
    drive(v=-3.0)
    assert float(drive.motor.joint_viscous_friction) == pytest.approx(2.0 + 0.7 * 3)
    drive.motor.effects.find("quadratic_friction").set_parameter("coefficient", -1.0)
    drive(v=-3.0)
    assert float(drive.motor.joint_viscous_friction) == 0.0  # never drives
    drive = Drive(["friction_asymmetry"], {"friction_asymmetry.effort": 0.4})
    assert [drive.one(v=v) + v for v in (2.0, -2.0)] == pytest.approx([-0.4, -0.4], rel=1e-4)
    assert float(drive.motor.joint_friction) == 0.5  # 0.9 forward, 0.1 backward
    drive.motor.effects.find("friction_asymmetry").set_parameter("effort", 0.8)
    assert drive.one() == pytest.approx(-0.65)
    assert float(drive.motor.joint_friction) == pytest.approx(0.65)  # 1.3 forward, never less than none backward


def test_friction_drifts_over_the_session():
    values = {"friction_drift.ratio": 0.6, "friction_drift.time_constant": 20.0}
    drive = Drive(["friction_drift"], values)
    drive.motor.set_session_time(torch.full((1, 1), 40.0, dtype=torch.float64))
    drive()
    factor = 1 + 0.6 * (1 - math.exp(-2))
    assert float(drive.motor.joint_friction) == pytest.approx(0.5 * factor)
    assert float(drive.motor.joint_viscous_friction) == pytest.approx(2.0 * factor)
    for _ in range(400):
        drive()
    drive.motor.reset()  # the session goes on
    drive()
    factor = 1 + 0.6 * (1 - math.exp(-(40 + 401 * DT) / 20))
    assert float(drive.motor.joint_friction) == pytest.approx(0.5 * factor, rel=1e-6)


@pytest.mark.slow
def test_a_bristle_is_a_spring_that_gives_way_at_the_friction_level():
    stiffness, level = 400.0, 0.5
    drive = Drive(["presliding_friction"], {"presliding_friction.stiffness": stiffness}, stiffness=0.0, damping=0.0)
    assert drive.one(q=0.0) == 0.0
    moved = 1e-5
    assert drive.one(q=moved) == pytest.approx(-stiffness * moved, rel=0.01)
    torques = [drive.one(q=moved * i) for i in range(2000)]
    x = moved * 1999
    assert torques[-1] == pytest.approx(-level * (1 - math.exp(-stiffness * x / level)), rel=1e-3)
    # after the turn the slope is twice as steep: the bristle pulls the other way
    assert drive.one(q=x - moved) - torques[-1] == pytest.approx(2 * stiffness * moved, rel=0.02)
    assert float(drive.motor.joint_friction) == 0.0


def drag(drive):
    """What a drive adds to its viscous friction, wherever that acts."""
    return float(drive.motor.joint_viscous_friction + drive.motor.joint_implicit_damping) - 2.0


def test_friction_that_creeps_is_its_tangent_at_the_speed_in_the_middle_of_the_step():
    drive, before = Drive(["creeping_friction"], {"creeping_friction.velocity": 0.05}), 0.0
    for v in (0.0, 1e-6, 0.02, -0.07, 0.4):
        drive(v=v)
        middle, before = abs(1.5 * v - 0.5 * before), v
        level, slope = float(drive.motor.joint_friction), drag(drive)
        assert level + slope * middle == pytest.approx(0.5 * math.tanh(middle / 0.05), abs=1e-12)
        assert slope == pytest.approx(0.5 / 0.05 / math.cosh(middle / 0.05) ** 2)
        assert level >= 0.0
    drive.motor.reset()
    drive(v=0.02)  # as if it had been so before
    assert drag(drive) == pytest.approx(0.5 / 0.05 / math.cosh(0.4) ** 2)
    values = {"stribeck_friction.effort": 1.5, "stribeck_friction.velocity": 0.2, "creeping_friction.velocity": 1e-3}
    for order in (1, -1):  # after all that changes the level
        both = Drive(["creeping_friction", "stribeck_friction"][::order], values)
        both(v=0.1)
        assert float(both.motor.joint_friction) == pytest.approx(0.5 + 1.5 * math.exp(-0.25))


def test_soft_friction_is_left_to_the_simulator():
    drive = Drive(["soft_friction"], {"soft_friction.time_constant": 0.02})
    assert drive.one(0.002) == pytest.approx(0.2) and float(drive.motor.joint_friction) == 0.5
    assert float(drive.motor.joint_friction_time) == 0.02
    assert Drive(["stribeck_friction"], {}).motor.joint_friction_time is None


@pytest.mark.parametrize("time_constant", [1e-6, 1e-3, 0.02, 0.2])
def test_a_step_of_the_soft_constraint_is_of_second_order_and_does_not_ring(time_constant):
    """Alone below its level a joint has v' = -d b v."""
    rate, softness = step_of_constraint(torch.tensor(time_constant, dtype=torch.float64), DT)
    left = 1 - DT * float(rate / (1 + softness))  # of the speed, after a step
    b = 2 / (WIDEST * time_constant)
    assert left >= -1e-12
    x = IMPEDANCE * b * DT
    assert left == pytest.approx((1 - x / 2) / (1 + x / 2) if x < 2 else 0.0, abs=1e-12)


@pytest.mark.parametrize("mode", ["command", "effort"])
def test_an_integral_sums_the_error_that_the_controller_sees_up_to_its_limit(mode):
    values = {"integral_gain.gain": 400.0, "integral_gain.effort": 0.15}
    drive = Drive(["integral_gain"], values, delay_mode=mode, delay=1.0, encoder_bias=0.02)
    errors = [0.1, 0.1, 0.1, -0.5, -0.5, 0.0]
    summed, integral = [], 0.0
    for error in errors:
        integral = max(-0.15, min(0.15, integral + 400 * DT * error))
        summed.append(100 * error + integral)
    expected = summed if mode == "command" else [summed[max(k - 1, 0)] for k in range(len(errors))]
    targets = [e - 0.02 for e in errors]
    late = [*targets[1:], targets[-1]] if mode == "command" else targets
    if mode == "command":  # a target counts one step later
        drive.one(targets[0])
        drive.motor.effects.reset()
    assert [drive.one(target) for target in late] == pytest.approx(expected)
    drive.motor.reset()
    assert drive.one(targets[0]) == pytest.approx(100 * 0.1 + 400 * DT * 0.1)


def test_limits_of_the_drive():
    drive = Drive(["command_rate_limit"], {"command_rate_limit.velocity": 2.0})
    assert drive.one(0.0) == 0.0
    assert [drive.one(1.0) for _ in range(3)] == pytest.approx([100 * 2.0 * DT * k for k in (1, 2, 3)])
    assert drive.one(3.5 * 2.0 * DT) == pytest.approx(100 * 3.5 * 2.0 * DT)  # reached
    drive = Drive(["torque_limit"], {"torque_limit.effort": 3.0})
    assert [drive.one(x) for x in (1.0, -1.0, 0.02)] == pytest.approx([3.0, -3.0, 2.0])
    values = {"torque_speed_limit.velocity": 10.0, "torque_speed_limit.effort": 20.0}
    drive = Drive(["torque_speed_limit"], values, damping=0.0)
    assert drive.one(1.0, v=4.0) == pytest.approx(20 * (1 - 4 / 10))
    assert drive.one(1.0) == pytest.approx(20.0)
    assert drive.one(1.0, v=12.0) == 0.0
    assert [drive.one(-1.0, v=v) for v in (12.0, 4.5)] == pytest.approx([-100.0, -100 * 0.6 - 20 * 0.4])
    assert drive.one(-1.0, v=4.0) == pytest.approx(-100.0)  # it brakes with all it is asked for, until it turns


def test_what_is_asked_is_limited_before_the_current_loop_and_the_torque_constant_and_the_line_comes_last():
    limited = {"stiffness": 100.0, "damping": 0.0, "effort_limit": 8.0, "saturation_effort": 20.0}
    limited["velocity_limit"] = 10.0
    weak = Drive(["torque_gain"], {"torque_gain.gain": 0.5}, **limited)
    assert weak.one(1.0) == pytest.approx(0.5 * 8.0)  # not min(50, 8)
    strong = Drive(["torque_gain"], {"torque_gain.gain": 5.0}, **limited)
    assert strong.one(1.0) == pytest.approx(20.0)  # of 40 the supply leaves the stall torque
    assert strong.one(1.0, v=5.0) == pytest.approx(10.0)
    lag = Drive(["drive_bandwidth"], {"drive_bandwidth.time_constant": 0.01}, **limited)
    lag.one(0.0)
    rise = 1 - math.exp(-DT / 0.01)
    mean = 1 - rise / (DT / 0.01)
    assert lag.one(1.0) == pytest.approx(8.0 * mean)  # of the 8 that flow at last, not of the 100 asked for
    assert lag.one(1.0) == pytest.approx(8.0 * (rise + (1 - rise) * mean))
    order = ("torque_speed_limit", "torque_gain", "torque_limit", "drive_bandwidth")  # as named, not as they act
    values = {"torque_gain.gain": 0.5, "torque_limit.effort": 6.0, "drive_bandwidth.time_constant": 0.0}
    values |= {"torque_speed_limit.velocity": 10.0, "torque_speed_limit.effort": 5.0}
    every = Drive(order, values, **limited)
    assert every.one(1.0) == pytest.approx(3.0)
    assert every.one(1.0, v=8.0) == pytest.approx(1.0)


def test_the_two_limits_without_anything_between_them_are_the_four_quadrant_clip_bit_for_bit():
    generator = torch.Generator().manual_seed(0)
    effort, speed = (60 * torch.randn(20000, generator=generator, dtype=torch.float64) for _ in range(2))
    stall, most, fastest = (torch.rand(20000, generator=generator, dtype=torch.float64) for _ in range(3))
    line = (100 * stall, 60 * most, 1 + 30 * fastest)
    whole = clip_effort(effort, speed, *line)
    assert torch.equal(clip_to_line(effort.clamp(-line[1], line[1]), speed, *line), whole)
    values = {"torque_gain.gain": 1.0, "drive_bandwidth.time_constant": 0.0}
    limits = {"saturation_effort": 140.0, "effort_limit": 89.0, "velocity_limit": 8.5}
    plain, with_null = Drive([], **limits), Drive(["torque_gain", "drive_bandwidth"], values, **limits)
    for target, v in ((0.5, 0.0), (3.0, 2.0), (3.0, 12.0), (3.0, 20.0), (-3.0, 20.0), (-3.0, -20.0)):
        assert plain.one(target, v=v) == with_null.one(target, v=v)


def test_gains_torques_and_encoders():
    assert Drive(["torque_gain"], {"torque_gain.gain": 1.2}).one(0.1) == pytest.approx(12.0)
    assert Drive(["proportional_gain"], {"proportional_gain.gain": 1.2}).one(0.1, v=1.0) == pytest.approx(11.0)
    assert Drive(["derivative_gain"], {"derivative_gain.gain": 1.2}).one(0.1, v=1.0) == pytest.approx(8.8)
    assert Drive(["torque_offset"], {"torque_offset.effort": -0.7}).one(0.1) == pytest.approx(9.3)
    spring = Drive(["parallel_spring"], {"parallel_spring.stiffness": 5.0, "parallel_spring.rest": 0.1})
    assert spring.one(0.3, q=0.3) == pytest.approx(-5.0 * 0.2)
    assert spring.one(50.0, q=50.0) == pytest.approx(-5.0 * 49.9)
    away = Drive(["parallel_spring"], {"parallel_spring.stiffness": -2.0, "parallel_spring.rest": 0.1})
    assert away.one(0.3, q=0.3) == pytest.approx(2.0 * 0.2)
    assert away.one(50.0, q=50.0) == pytest.approx(2.0 * math.pi)  # it throws a joint no harder than that
    ripple = Drive(
        ["torque_ripple"], {"torque_ripple.sine": 1.0, "torque_ripple.cosine": 2, "torque_ripple.periods": 7}
    )
    assert ripple.one(0.3, q=0.3) == pytest.approx(math.sin(2.1) + 2 * math.cos(2.1))
    scale = Drive(["encoder_scale"], {"encoder_scale.error": 0.05})
    assert scale.one(0.0, q=0.2, v=2.0) == pytest.approx(-1.05 * (20 + 2))
    off_centre = {"encoder_eccentricity.sine": 0.03, "encoder_eccentricity.cosine": 0.02}
    ring = Drive(["encoder_eccentricity"], off_centre)
    error = 0.03 * math.sin(0.4) + 0.02 * math.cos(0.4)
    slope = 0.03 * math.cos(0.4) - 0.02 * math.sin(0.4)
    assert ring.one(0.4, q=0.4, v=2.0) == pytest.approx(-100 * error - 2 * (1 + slope))
    for drive in (scale, ring):  # the log shows what the controller sees
        q = torch.tensor([[0.7]], dtype=torch.float64)
        shown = drive.motor.sensed_position(q).clone()
        assert drive.one(0.0, q=0.7) == pytest.approx(-100 * float(shown), abs=1e-9)
        assert torch.allclose(drive.motor.position_that_shows(shown), q, atol=1e-9)


@pytest.mark.parametrize("mode", ["command", "effort"])
def test_the_other_delay_is_the_path_that_the_base_does_not_have(mode):
    targets = [0.0, 0.1, 0.4, 0.2, 0.0, 0.0, 0.0]
    positions = [0.0, 0.01, 0.02, 0.05, 0.03, 0.01, 0.0]
    drive = Drive(["other_delay"], {"other_delay.delay": 1.5 * DT}, delay_mode=mode)

    def late(values, k):
        return 0.5 * (values[max(k - 1, 0)] + values[max(k - 2, 0)])

    torques = [100 * (t - q) for t, q in zip(targets, positions, strict=True)]
    for k in range(len(targets)):
        expected = late(torques, k) if mode == "command" else 100 * (late(targets, k) - positions[k])
        assert drive.one(targets[k], q=positions[k]) == pytest.approx(expected, abs=1e-9), k


def test_rows_and_resets():
    rows = [
        EffectCfg(effect="torque_offset", env_rows=slice(0, 2), values={"effort": 1.0}),
        EffectCfg(effect="torque_offset", env_rows=slice(2, 3), values={"effort": -2.0}),
        EffectCfg(effect="drive_bandwidth", env_rows=slice(1, 4), values={"time_constant": 0.01}),
    ]
    drive = Drive(rows, num_envs=4)
    assert drive()[:, 0].tolist() == [1.0, 1.0, -2.0, 0.0]
    assert drive(1.0)[0, 0] == 101.0
    drive(1.0)
    drive.motor.reset(torch.tensor([2]))  # its next torque counts as settled
    torque = drive(1.0)[:, 0]
    assert float(torque[2]) == pytest.approx(98.0)
    assert float(torque[1]) < 60 and float(torque[3]) < 60


def test_names_and_places_are_read():
    cfg = EffectCfg.parse("stribeck_friction@.*_KFE")
    assert (cfg.effect, cfg.joint_names_expr, cfg.shared) == ("stribeck_friction", ".*_KFE", False)
    assert cfg.joints(["LF_HAA", "LF_KFE", "RF_KFE"]) == ["LF_KFE", "RF_KFE"]
    assert EffectCfg.parse("torque_gain@shared").shared
    assert EffectCfg.parse("clock_skew").shared
    assert not EffectCfg.parse("torque_gain").shared
    for text in ("torque_gain", "torque_gain@a|b", "torque_gain@shared", "torque_gain@a|b@shared", "clock_skew"):
        assert EffectCfg.parse(text).label == text
    own = get_effect(f"{__name__}:CableDrag")
    assert own.name == "cable_drag_of_test" and get_effect(own.name) is own


class CableDrag(Effect):
    """An effect of one's own."""

    name = "cable_drag_of_test"
    stage = "transmission"
    parameters = (EffectParameter(name="effort", unit="N m", lower=-2, upper=2, null=0.0, start=0.1),)

    def transmission(self, s):
        s.effort -= self.effort * torch.tanh(s.joint_pos)


def test_an_effect_of_ones_own_acts():
    drive = Drive([f"{__name__}:CableDrag"], {"cable_drag_of_test.effort": 1.5})
    assert drive.one(0.3, q=0.3) == pytest.approx(-1.5 * math.tanh(0.3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: get_effect("stribek_friction"), "no effect 'stribek_friction'. Did you mean 'stribeck_friction'?"),
        (lambda: get_effect("no_such_module:X"), "cannot be imported"),
        (lambda: get_effect("math:pi"), "is no effect"),
        (
            lambda: EffectCfg.parse("torque_gain@"),
            "'torque_gain@' is not understood. Write torque_gain, torque_gain@JOINTS",
        ),
        (lambda: effect_cfgs(["torque_gain@a", "torque_gain@b"]), "named twice"),
        (lambda: Drive([EffectCfg(effect="torque_gain", values={"gane": 1.0})]), "no parameter 'gane'"),
        (lambda: Drive(["torque_gain"], {"torque_gain.gane": 1.0}), "no parameter 'gane'. Available: gain"),
        (lambda: Drive(["torque_gain"], {"backlash.gap": 1.0}), "no effect 'backlash'. It has: torque_gain"),
        (lambda: Drive(["torque_gain"], physics_dt=None), "need to know the time between two calls"),
    ],
)
def test_what_is_wrong_is_said(call, message):
    with pytest.raises(ValueError, match=message.replace("?", r"\?")):
        call()


GOOD = {"name": "x", "unit": "1", "lower": 0.0, "upper": 1.0, "null": 0.0, "start": 0.5}


@pytest.mark.parametrize(
    ("declaration", "message"),
    [
        ({"name": ""}, "has no name"),
        ({"parameters": ()}, "has no parameters"),
        ({"name": "torque_gain"}, "registered already"),
        ({"probes": ({"y": 1.0},)}, "names 'y'"),
        ({"parameters": (EffectParameter(**{**GOOD, "lower": 2.0}),)}, "lower < upper"),
        ({"parameters": (EffectParameter(**{**GOOD, "scale": "log"}),)}, "expected > 0"),
        ({"parameters": (EffectParameter(**{**GOOD, "start": 3.0}),)}, "starts at 3.0"),
        ({"parameters": (EffectParameter(**{**GOOD, "null": None}),)}, "no parameter with a null value"),
        ({"parameters": (EffectParameter(**{**GOOD, "name": "drive"}),)}, "needs another name"),
    ],
)
def test_a_wrong_declaration_is_refused(declaration, message):
    content = {"name": "wrong", "stage": "drive", "parameters": (EffectParameter(**GOOD),), **declaration}
    with pytest.raises(ValueError, match=message):
        register_effect(type("Wrong", (Effect,), content))
    assert "wrong" not in available_effects()


def test_rows_begin_anew_at_first_and_after_a_reset_and_say_so_once():
    effect = get_effect("command_rate_limit")(3, 2, dt=0.001, control_dt=0.002)
    assert effect.take_new_rows().flatten().tolist() == [True] * 3
    assert effect.take_new_rows() is None
    effect.reset_state(torch.tensor([False, True, False]))
    effect.reset_state(torch.tensor([False, False, True]))
    assert effect.take_new_rows().flatten().tolist() == [False, True, True]
    assert effect.take_new_rows() is None


@pytest.mark.slow
def test_a_step_with_every_effect_is_a_function_of_its_state():
    cfgs = [EffectCfg(effect=name, values={p.name: p.start for p in get_effect(name).parameters}) for name in EFFECTS]
    delays = {"delay": 1.3, "max_delay": 4.0, "control_decimation": 2}
    for changes in (delays, {**delays, "delay_mode": "effort"}, {"drive_dt": 1.5 * DT}):
        drive, other = (Drive(cfgs, num_envs=2, **changes) for _ in range(2))
        q, v, target = 0.1 * torch.randn(3, 11, 2, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        for k in range(5):  # it stops between two runs of the controller, and one environment has just begun anew
            drive(target[k], q[k], v[k])
        drive.motor.reset(torch.tensor([False, True]))
        state = first = drive.motor.snapshot()
        for k in range(5, 11):
            torque, state = drive.motor.step(state, ActuatorActions(target[k], None, None), q[k], v[k])
            other.motor.restore(first)
            after = [other(target[i], q[i], v[i]) for i in range(5, k + 1)]
            assert torch.equal(torque, after[-1])
        assert torch.equal(drive(target[5], q[5], v[5]), after[0]) and float((after[0] - after[-1]).abs().min()) > 1e-3
