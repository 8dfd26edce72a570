"""The drive's torque law, against figures worked out by hand."""

import math

import pytest
import torch

from pace_actuators import ActuatorActions, PaceDCMotor, PaceDCMotorCfg, resolve_joint_values

JOINTS = ["hip", "knee"]


def drive_cfg(**fields) -> PaceDCMotorCfg:
    defaults = {"joint_names_expr": ".*", "stiffness": 10.0, "damping": 0.0}
    return PaceDCMotorCfg(**(defaults | fields))


def drive(num_envs=1, joints=JOINTS, dtype=torch.float64, **fields) -> PaceDCMotor:
    return PaceDCMotor(drive_cfg(**fields), joints, slice(None), num_envs, dtype=dtype)


def row(*values: float) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


def torque(motor: PaceDCMotor, target=None, pos=0.0, vel=0.0, *, target_vel=None, effort=None) -> torch.Tensor:
    """One call; numbers stand for every environment and joint."""

    def full(value):
        if value is None or isinstance(value, torch.Tensor):
            return value
        return torch.full_like(motor.stiffness, value)

    action = ActuatorActions(full(target), full(target_vel), full(effort))
    return motor.compute(action, full(pos), full(vel)).joint_efforts


# ---- torque-speed limit: stall torque 100 N m, continuous limit 60 N m, no-load speed 10 rad/s; corner at 4 rad/s


@pytest.mark.parametrize(
    ("speed", "asked", "given"),
    [
        (0.0, 200.0, 60.0),  # standing: the continuous limit
        (0.0, -200.0, -60.0),
        (0.0, 59.0, 59.0),
        (4.0, 200.0, 60.0),  # driving forward, at the corner
        (7.0, 200.0, 30.0),  # beyond the corner
        (7.0, 20.0, 20.0),
        (7.0, -200.0, -60.0),  # braking while moving forward
        (10.0, 200.0, 0.0),  # no-load speed
        (12.0, 200.0, -20.0),  # faster than no load: the motor brakes
        (16.0, 200.0, -60.0),
        (50.0, 200.0, -60.0),  # never more than the continuous limit
        (50.0, -200.0, -60.0),
        (-4.0, -200.0, -60.0),  # driving backward
        (-7.0, -200.0, -30.0),
        (-7.0, 200.0, 60.0),  # braking while moving backward
        (-10.0, -200.0, 0.0),
        (-12.0, -200.0, 20.0),
        (-50.0, -200.0, 60.0),
        (-50.0, 200.0, 60.0),
    ],
)
def test_the_torque_speed_limit_in_four_quadrants(speed, asked, given):
    motor = drive(saturation_effort=100.0, effort_limit=60.0, velocity_limit=10.0, damping=0.0)
    assert torque(motor, vel=speed, effort=asked).tolist() == [[given, given]]
    assert motor.computed_effort.tolist() == [[asked, asked]]
    assert motor.applied_effort.tolist() == [[given, given]]


@pytest.mark.parametrize("speed", [0.0, 9.0, -1e6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_without_a_torque_speed_curve_only_the_effort_limit_holds(speed, dtype):
    assert torque(drive(dtype=dtype, effort_limit=60.0), vel=speed, effort=200.0).tolist() == [[60.0, 60.0]]
    capped = drive(dtype=dtype, effort_limit=60.0, velocity_limit=1.0)
    assert torque(capped, vel=speed, effort=200.0).tolist() == [[60.0, 60.0]]
    infinite_speed = drive(dtype=dtype, effort_limit=60.0, saturation_effort=100.0)
    assert torque(infinite_speed, vel=speed, effort=200.0).tolist() == [[60.0, 60.0]]
    assert torque(drive(dtype=dtype), vel=speed, effort=200.0).tolist() == [[200.0, 200.0]]


def test_several_types_of_drive_share_a_group():
    motor = drive(effort_limit={"hip": 20.0, "knee": 45.0}, stiffness={"h.*": 5.0, "k.*": 7.0})
    assert torque(motor, target=1.0).tolist() == [[5.0, 7.0]]
    assert torque(motor, target=100.0).tolist() == [[20.0, 45.0]]


# ---- controller and encoder


def test_the_controller_is_pd_with_feed_forward():
    motor = drive(stiffness=10.0, damping=2.0)
    # 10 (0.5 - 0.2) + 2 (1.5 - 4) + 3
    assert torque(motor, 0.5, 0.2, 4.0, target_vel=1.5, effort=3.0).flatten().tolist() == pytest.approx([1.0, 1.0])
    # no target velocity means zero: 10 (0.5 - 0.2) - 2 * 4
    assert torque(motor, 0.5, 0.2, 4.0).flatten().tolist() == pytest.approx([-5.0, -5.0])


def test_without_a_position_target_only_velocity_and_effort_act():
    motor = drive(stiffness=10.0, damping=2.0, encoder_bias=0.3)
    assert torque(motor, None, 0.7, 4.0, effort=3.0).flatten().tolist() == pytest.approx([-5.0, -5.0])


def test_the_encoder_shows_the_position_less_its_bias():
    motor = drive(stiffness=10.0, encoder_bias={"hip": 0.05, "knee": -0.02})
    # kp (q* - q + bias)
    assert torque(motor, 0.5, 0.2).flatten().tolist() == pytest.approx([3.5, 2.8])
    motor.update_encoder_bias(row(0.1, 0.0))
    assert torque(motor, 0.5, 0.2).flatten().tolist() == pytest.approx([4.0, 3.0])


def test_a_bias_can_differ_between_environments():
    motor = drive(num_envs=3)
    motor.update_encoder_bias(torch.tensor([[0.1, 0.2], [0.3, 0.4]]), env_ids=[2, 0])
    assert torque(motor, 0.0, 0.0).flatten().tolist() == pytest.approx([3.0, 4.0, 0.0, 0.0, 1.0, 2.0])


# ---- delay: q* = k/10, q = 3k/100, v = k/5 at control step k; kp 10, kd 2


def torques_along_ramps(motor: PaceDCMotor, steps: int) -> list[float]:
    return [torque(motor, k / 10, 3 * k / 100, k / 5)[0, 0].item() for k in range(steps)]


@pytest.mark.parametrize("lag", [0.0, 2.0, 2.5, 3.75])
def test_a_command_delay_leaves_the_feedback_alone(lag):
    motor = drive(damping=2.0, delay=lag, max_delay=4.0, delay_mode="command")
    expected = [10 * (max(k - lag, 0) / 10 - 3 * k / 100) - 2 * k / 5 for k in range(10)]
    assert torques_along_ramps(motor, 10) == pytest.approx(expected)


@pytest.mark.parametrize("lag", [0.0, 2.0, 2.5, 3.75])
def test_an_effort_delay_delays_the_feedback_too(lag):
    motor = drive(damping=2.0, delay=lag, max_delay=4.0, delay_mode="effort")
    past = [max(k - lag, 0) for k in range(10)]
    expected = [10 * (k / 10 - 3 * k / 100) - 2 * k / 5 for k in past]
    assert torques_along_ramps(motor, 10) == pytest.approx(expected)


def test_hold_rounds_the_delay_up_to_whole_steps():
    motor = drive(delay=1.5, delay_interpolation="hold")
    assert [torque(motor, float(k))[0, 0].item() for k in range(5)] == [0.0, 0.0, 0.0, 10.0, 20.0]


def test_delays_can_differ_between_environments_and_joints():
    motor = drive(num_envs=2)
    motor.update_time_lags(torch.tensor([0.0, 1.5]))
    assert [torque(motor, float(k)).tolist() for k in range(4)][-1] == [[30.0, 30.0], [15.0, 15.0]]
    motor.reset()
    motor.update_time_lags(torch.tensor([[0.0, 1.0], [2.0, 3.0]]))
    assert [torque(motor, float(k)).tolist() for k in range(4)][-1] == [[30.0, 20.0], [10.0, 0.0]]
    assert motor.time_lags.tolist() == [[0.0, 1.0], [2.0, 3.0]]


@pytest.mark.parametrize("env_ids", [[1], torch.tensor([1]), torch.tensor([False, True, False])], ids=repr)
def test_a_partial_reset_forgets_only_those_commands(env_ids):
    motor = drive(num_envs=3, delay=2.0)
    for k in range(6):
        torque(motor, float(k))
    motor.reset(env_ids)
    assert torque(motor, 6.0)[:, 0].tolist() == [40.0, 60.0, 40.0]


def test_feed_forward_that_starts_late_arrives_after_the_delay():
    motor = drive(delay=2.0)
    for _ in range(5):
        torque(motor, 0.0)
    assert [torque(motor, 0.0, effort=7.0)[0, 0].item() for _ in range(4)] == [0.0, 0.0, 7.0, 7.0]


def test_a_position_target_that_was_given_up_does_not_come_back():
    motor = drive(delay=2.0)
    for _ in range(5):
        torque(motor, 9.0)
    torque(motor, None)
    assert torque(motor, 1.0)[0, 0].item() == 10.0


def test_the_torque_is_held_between_control_steps_but_limited_at_each_physics_step():
    motor = drive(control_decimation=3, saturation_effort=100.0, effort_limit=60.0, velocity_limit=10.0)
    given = [torque(motor, float(k), vel=v)[0, 0].item() for k, v in enumerate([0.0, 0, 0, 0, 0, 9.9, 0])]
    assert given == pytest.approx([0.0, 0.0, 0.0, 30.0, 30.0, 1.0, 60.0])


def test_a_disabled_drive_gives_no_torque():
    motor = drive(num_envs=3)
    motor.set_torque_enable(torch.tensor([True, False, True]))
    assert torque(motor, 1.0)[:, 0].tolist() == [10.0, 0.0, 10.0]
    motor.set_torque_enable(None)
    assert torque(motor, 1.0)[:, 0].tolist() == [10.0, 10.0, 10.0]


def test_float32_is_float64_to_rounding():
    fields = {
        "stiffness": 85.0,
        "damping": 0.6,
        "saturation_effort": 140.0,
        "effort_limit": 89.0,
        "velocity_limit": 8.5,
        "encoder_bias": 0.05,
        "delay": 2.5,
    }
    single, double = drive(dtype=torch.float32, **fields), drive(dtype=torch.float64, **fields)
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        target, pos, vel = torch.randn(3, 1, 2, generator=generator, dtype=torch.float64)
        a = torque(single, target.float(), pos.float(), 5 * vel.float())
        b = torque(double, target, pos, 5 * vel)
        assert a.dtype == torch.float32
        assert (a - b).abs().max() < 1e-5 * 89


def test_commands_and_state_are_left_as_they_were():
    motor = drive(delay=0.5)
    target, pos, vel, effort = (torch.full((1, 2), x, dtype=torch.float64) for x in (1.0, 2.0, 3.0, 4.0))
    action = ActuatorActions(target, vel, effort)
    result = motor.compute(action, pos, vel)
    assert action.joint_positions is target and action.joint_efforts is effort
    assert [x[0, 0].item() for x in (target, pos, vel, effort)] == [1.0, 2.0, 3.0, 4.0]
    assert result.joint_positions is None and result.joint_velocities is None


# ---- configuration


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"ankle": 1.0, ".*": 2.0}, "'ankle' matches no joint. Available: hip, knee"),
        ({"hip": 1.0, ".*": 2.0}, r"joint 'hip' is matched twice, by 'hip' and by '\.\*'"),
        ({"hip": 1.0}, "stiffness: no value for knee. Patterns given: hip"),
        ([1.0, 2.0, 3.0], r"got \(3,\) values, expected one per joint \(2: hip, knee\)"),
        ({"(": 1.0}, "not a regular expression"),
    ],
)
def test_values_that_fit_no_joint_are_refused(value, message):
    with pytest.raises(ValueError, match=message):
        drive(stiffness=value)


@pytest.mark.parametrize(
    "value", [3.0, 3, [3.0, 3.0], torch.tensor(3.0), torch.tensor([3.0, 3.0]), {".*": 3.0}, {"hip": 3, "knee": 3}]
)
def test_values_come_as_numbers_patterns_or_lists(value):
    assert resolve_joint_values(value, JOINTS, field="x").tolist() == [3.0, 3.0]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"damping": -1.0}, "damping of hip is -1, expected a finite number >= 0"),
        ({"stiffness": [1.0, math.nan]}, "stiffness of knee is nan"),
        ({"stiffness": math.inf}, "stiffness of hip is inf"),
        ({"encoder_bias": math.inf}, "encoder_bias of hip is inf"),
        ({"saturation_effort": -1.0}, "or inf for no torque-speed curve"),
        ({"velocity_limit": 0.0}, "velocity_limit of hip is 0, expected a number > 0"),
        ({"delay": 11.0}, "expected 0 to max_delay = 10"),
        ({"delay_mode": "torque"}, "Available: 'command', 'effort'"),
        ({"control_decimation": 0}, "control_decimation is 0"),
    ],
)
def test_impossible_values_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        drive(**fields)


def test_a_delay_per_joint_must_name_every_joint():
    with pytest.raises(ValueError, match="expected 1 or 2 columns"):
        drive().update_time_lags(torch.zeros(1, 3))


# ---- as Isaac Lab uses it


def test_isaac_labs_constructor_fills_what_the_configuration_leaves_out():
    cfg = PaceDCMotorCfg(joint_names_expr=".*", stiffness=10.0, friction={"hip": 0.2, "knee": 0.3})
    ones = torch.ones(4, 2)
    motor = PaceDCMotor(
        cfg=cfg,
        joint_names=JOINTS,
        joint_ids=torch.tensor([3, 5]),
        num_envs=4,
        device="cpu",
        stiffness=77 * ones,
        damping=2 * ones,
        armature=3 * ones,
        friction=4 * ones,
        dynamic_friction=0 * ones,
        viscous_friction=6 * ones,
        effort_limit=7 * ones,
        velocity_limit=8 * ones,
    )
    assert motor.stiffness.dtype == torch.float32
    values = {
        "stiffness": 10.0,
        "damping": 2.0,
        "armature": 3.0,
        "viscous_friction": 6.0,
        "effort_limit": 7.0,
        "effort_limit_sim": 7.0,
        "velocity_limit_sim": 8.0,
        "computed_effort": 0.0,
        "applied_effort": 0.0,
    }
    for name, value in values.items():
        assert getattr(motor, name).tolist() == [[value, value]] * 4, name
    # the configuration's friction holds at rest and in motion, whatever the simulator's defaults
    assert motor.friction[0].tolist() == pytest.approx([0.2, 0.3])
    assert motor.dynamic_friction[0].tolist() == pytest.approx([0.2, 0.3])
    assert motor.num_joints == 2 and motor.joint_names == JOINTS
    assert motor.joint_indices.tolist() == [3, 5] and not motor.is_implicit_model


def test_isaac_labs_constructor_takes_positions_too():
    cfg = PaceDCMotorCfg(joint_names_expr=".*")
    motor = PaceDCMotor(cfg, JOINTS, slice(None), 1, "cpu", 1.0, 2.0, 3.0, 4.0, None, 6.0, 7.0, 8.0)
    fields = ("stiffness", "damping", "armature", "friction", "dynamic_friction", "viscous_friction", "effort_limit")
    assert [getattr(motor, name)[0, 0].item() for name in fields] == [1.0, 2.0, 3.0, 4.0, 4.0, 6.0, 7.0]


def test_a_default_of_the_wrong_shape_is_refused():
    with pytest.raises(ValueError, match=r"damping has shape \(3,\), expected a number, \(2,\) or \(1, 2\)"):
        PaceDCMotor(PaceDCMotorCfg(joint_names_expr=".*"), JOINTS, slice(None), 1, damping=torch.ones(3))


@pytest.mark.slow
def test_it_runs_in_a_simulator_that_knows_nothing_of_ours():
    """A pendulum in torch, semi-implicit Euler: it settles where kp (q* - q + bias) = m g l sin q."""
    mass, length, gravity, kp, bias = 2.0, 0.3, 9.81, 40.0, 0.03
    settled = torch.tensor([[math.pi / 6], [-math.pi / 2]])
    target = settled - bias + mass * gravity * length * settled.sin() / kp
    for delay_mode in ("command", "effort"):
        cfg = drive_cfg(stiffness=kp, damping=6.0, encoder_bias=bias, delay=2.5, delay_mode=delay_mode)
        motor = PaceDCMotor(cfg, ["pendulum"], slice(None), 2)
        pos, vel, dt = torch.zeros(2, 1), torch.zeros(2, 1), 0.002
        for _ in range(3000):
            effort = motor.compute(ActuatorActions(target), pos, vel).joint_efforts
            acceleration = (effort - mass * gravity * length * pos.sin()) / (mass * length**2)
            vel = vel + dt * acceleration
            pos = pos + dt * vel
        assert (pos - settled).abs().max() < 1e-5
        assert vel.abs().max() < 1e-4


def test_a_motor_of_ones_own_overrides_one_stage():
    class WeakMotor(PaceDCMotor):
        def drive_effort(self, effort_command, joint_pos, joint_vel):
            return 0.5 * super().drive_effort(effort_command, joint_pos, joint_vel)

    motor = WeakMotor(drive_cfg(effort_limit=8.0), JOINTS, slice(None), 1, dtype=torch.float64)
    assert torque(motor, 1.0).tolist() == [[4.0, 4.0]]
    assert motor.computed_effort.tolist() == [[10.0, 10.0]]


# ---- the drive's own rate


def stepped(motor: PaceDCMotor, *, inertia: float, dt: float, steps: int, target: float) -> list[float]:
    """Positions of one inertia on the drive, by semi-implicit Euler with damping at the end of the step."""
    q, v, seen = torch.zeros(1, 1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64), []
    action = ActuatorActions(torch.full_like(q, target))
    for _ in range(steps):
        motor.compute(action, q, v)
        drag = motor.joint_viscous_friction
        v = v + dt * (motor.held_effort - drag * v) / (inertia + dt * drag)
        q = q + dt * v
        seen.append(q.item())
    return seen


def one_joint(**fields) -> PaceDCMotor:
    return drive(joints=("j",), **fields)


def test_a_late_command_acts_within_the_control_step_and_a_held_one_at_its_beginning():
    motor = one_joint(control_decimation=4, delay=1.375, physics_dt=0.001)
    given = [torque(motor, float(k // 4))[0, 0].item() for k in range(16)]
    assert given == pytest.approx([0, 0, 0, 0, 0, 0, 0, 0, 0, 5, 10, 10, 10, 15, 20, 20])
    held = one_joint(control_decimation=4, delay=1.375, delay_interpolation="hold", physics_dt=0.001)
    given = [torque(held, float(k // 4))[0, 0].item() for k in range(16)]
    assert given == [0.0] * 12 + [10.0] * 4


def test_the_feedback_is_that_of_the_controllers_last_run_when_a_late_command_arrives():
    motor = one_joint(control_decimation=2, delay=0.5, damping=1.0)
    q, v = torch.zeros(1, 1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
    given = []
    for k in range(4):
        q.fill_(0.1 * k)
        v.fill_(float(k))
        action = ActuatorActions(torch.full_like(q, float(k // 2)), None, torch.full_like(q, 5.0 * (k // 2)))
        given.append(motor.compute(action, q, v).joint_efforts.item())
    assert given == pytest.approx([0.0, 0.0, -10 * 0.2 - 2.0, 10 * (1 - 0.2) - 2.0 + 5.0])


@pytest.mark.parametrize("mode", ["command", "effort"])
def test_a_delay_counts_control_steps_whatever_the_drives_own_rate(mode):
    fields = {"delay": 1.5, "delay_mode": mode, "control_decimation": 4, "physics_dt": 0.001}
    fast, slow = one_joint(**fields, drive_dt=0.002), one_joint(**fields)
    assert fast.time_lags.tolist() == slow.time_lags.tolist() == [1.5]
    given = [[torque(m, float(k // 4))[0, 0].item() for k in range(20)] for m in (fast, slow)]
    assert given[0] == pytest.approx(given[1])


def test_a_controller_with_a_rate_of_its_own_reads_the_encoder_at_that_rate():
    motor = one_joint(control_decimation=4, physics_dt=0.001, drive_dt=0.002)
    assert motor.run_dt == pytest.approx(0.002)
    given = [torque(motor, 0.0, pos=0.1 * k)[0, 0].item() for k in range(5)]
    assert given == pytest.approx([0, 0, -2, -2, -4])


@pytest.mark.parametrize(
    ("period", "seen"),
    [(0.003, [0, 0, 0, 3, 3, 3, 6]), (0.0015, [0, 0, 2, 3, 3, 5, 6]), (0.006, [0, 0, 0, 0, 0, 0, 6])],
)
def test_a_controller_whose_period_does_not_divide_the_control_step_runs_on_its_own_clock(period, seen):
    motor = one_joint(control_decimation=4, physics_dt=0.001, drive_dt=period)
    for _ in range(2):
        given = [torque(motor, 0.0, pos=0.1 * k)[0, 0].item() for k in range(7)]
        assert given == pytest.approx([-float(k) for k in seen])
        motor.reset()
    assert motor.run_dt == period


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"drive_dt": 0.0005}, "drive_dt is 0.0005 s and the physics step 0.001 s: .* Make the physics step finer"),
        ({"drive_dt": 0.0}, "expected at least a physics step in drive_dt"),
        ({"drive_dt": 0.002, "physics_dt": None}, "set physics_dt"),
        ({"drive_dt": 0.002, "implicit": True}, "Leave out one of the two"),
        ({"implicit": True, "delay_mode": "effort"}, "it acts at once"),
    ],
)
def test_a_rate_that_does_not_fit_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        one_joint(**{"control_decimation": 4, "physics_dt": 0.001, **fields})


def test_a_continuous_loop_is_mujocos_position_actuator():
    """Stiff beyond what a held torque can hold: kd dt / inertia = 10. With its force limit, and exactly."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.002" gravity="0 0 0" integrator="implicitfast"/><worldbody><body>'
        '<joint name="j" axis="0 0 1" damping="0.3"/><inertial pos="0 0 0" mass="1" diaginertia="0.02 0.02 0.02"/>'
        '</body></worldbody><actuator><position joint="j" kp="2000" kv="100" forcerange="-60 60"/></actuator></mujoco>'
    )
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.2
    motor = one_joint(
        stiffness=2000.0, damping=100.0, effort_limit=60.0, viscous_friction=0.3, implicit=True, physics_dt=0.002
    )
    mine = stepped(motor, inertia=0.02, dt=0.002, steps=300, target=0.2)
    theirs = []
    for _ in mine:
        mujoco.mj_step(model, data)
        theirs.append(data.qpos[0])
    assert mine == pytest.approx(theirs, abs=1e-9)
    assert mine[-1] == pytest.approx(0.2, abs=5e-3)
    held = one_joint(stiffness=2000.0, damping=100.0, effort_limit=60.0, physics_dt=0.002)
    assert max(abs(q - 0.2) for q in stepped(held, inertia=0.02, dt=0.002, steps=300, target=0.2)[-50:]) > 0.01


# ---- resets between two runs of the controller


HELD = {
    "plain": {},
    "delayed": {"delay": 2.5},
    "torque delayed": {"delay": 1.25, "delay_mode": "effort"},
    "with effects": {"delay": 0.5, "effects": ["integral_gain", "proportional_gain", "stribeck_friction"]},
}


@pytest.mark.parametrize("calls", [1, 2, 3])
@pytest.mark.parametrize("rows", [[1], torch.tensor([False, True, False]), slice(1, 2)], ids=["list", "mask", "slice"])
@pytest.mark.parametrize("fields", HELD.values(), ids=HELD)
def test_a_drive_that_is_reset_while_the_others_hold_begins_as_a_new_one(fields, rows, calls):
    """It kept its old torque, that of before the reset, until the next control step."""
    motor, other, new = (drive(3, physics_dt=0.001, control_decimation=4, **fields) for _ in range(3))
    for k in range(4 + calls):
        for each in (motor, other):
            torque(each, 0.3 + 0.1 * (k // 4), 0.1 * k, 1.0)
    motor.reset(rows)
    first, undisturbed = torque(motor, 0.4, -0.2, 0.5), torque(other, 0.4, -0.2, 0.5)
    assert torch.equal(first[1], torque(new, 0.4, -0.2, 0.5)[1])
    assert torch.equal(first[[0, 2]], undisturbed[[0, 2]]) and not torch.equal(first[1], undisturbed[1])
    for k in range(3 - calls):  # it holds it until the others' controllers run
        assert torch.equal(motor.computed_effort[1], new.computed_effort[1])
        assert torch.equal(torque(motor, 0.4, 0.01 * k, 0.5)[[0, 2]], torque(other, 0.4, 0.01 * k, 0.5)[[0, 2]])
    for k in range(8):
        held, kept = torque(motor, 0.4, 0.02 * k, 0.1), torque(other, 0.4, 0.02 * k, 0.1)
        assert torch.equal(held[[0, 2]], kept[[0, 2]])


@pytest.mark.parametrize("mode", ["command", "effort"])
def test_a_drive_that_is_reset_gives_nothing_of_its_old_torque_where_a_command_arrives_within_a_step(mode):
    """A delay of 1.75 control steps: at the second call of a step, half of it is the old torque, half the limit's."""
    motor = drive(2, physics_dt=0.001, control_decimation=2, effort_limit=60.0, delay=1.75, delay_mode=mode)
    for target in (5.0, 5.0, 10.0, 10.0, 10.0):
        torque(motor, target)
    motor.reset(torch.tensor([False, True]))
    assert torque(motor, 2.0)[:, 0].tolist() == [55.0, 20.0]  # 0.5 (50 + 60), not 60, the limit of their mean
    assert torque(motor, 2.0)[:, 0].tolist() == [60.0, 20.0]


# ---- gradients and shapes


@pytest.mark.parametrize(
    "fields",
    [{"delay": 2.0}, {"delay": 2.5}, {"delay": 2.5, "delay_mode": "effort"}, {"delay": 0.5, "control_decimation": 2}],
)
def test_gradients_flow_back_through_a_delay(fields):
    motor = drive(3, physics_dt=0.001, **fields)
    targets = torch.randn(12, 3, 2, dtype=torch.float64, requires_grad=True)

    def run(commands):
        motor.reset()
        return torch.stack([torque(motor, commands[k]) for k in range(12)]).square().sum()

    run(targets).backward()
    step = torch.zeros_like(targets)
    step[2, 1, 0] = 1e-6
    with torch.no_grad():
        expected = (run(targets + step) - run(targets - step)) / 2e-6
    assert float(targets.grad[2, 1, 0]) == pytest.approx(float(expected), rel=1e-5)
    run(targets).backward()  # a reset of all ends the history that gradients flow through


@pytest.mark.parametrize("bad", [(3, 1), (1, 2), (2,), (3, 3), (2, 3), ()])
@pytest.mark.parametrize("what", ["target", "target_vel", "effort", "pos", "vel"])
def test_what_has_not_a_row_per_environment_and_a_column_per_joint_is_refused(what, bad):
    """One column of targets was spread over all joints without a word."""
    values = {"target": 0.0, "pos": 0.0, "vel": 0.0} | {what: torch.zeros(bad, dtype=torch.float64)}
    names = {"target": "positions", "target_vel": "velocities", "effort": "efforts", "pos": "pos", "vel": "vel"}
    said = rf"joint_{names[what]} has shape .*, expected a tensor of shape \(3, 2\): a row per .* hip, knee"
    with pytest.raises(ValueError, match=said):
        torque(drive(3), **values)


def test_other_shapes_are_refused_too():
    motor = drive(3)
    with pytest.raises(ValueError, match=r"joint_pos has type list, expected a tensor of shape"):
        motor.compute(ActuatorActions(), [[0.0, 0.0]], torch.zeros(3, 2))
    with pytest.raises(ValueError, match=r"encoder_bias has shape \(3,\), expected \(2, 2\)"):
        motor.update_encoder_bias(torch.zeros(3), [0, 1])
    with pytest.raises(ValueError, match=r"delay has shape \(4, 1\)\. Expected a number, or 3 rows"):
        motor.update_time_lags(torch.zeros(4))
    with pytest.raises(ValueError, match=r"torque_enable has shape \(2,\), expected \(3,\)"):
        motor.set_torque_enable(torch.ones(2, dtype=torch.bool))
