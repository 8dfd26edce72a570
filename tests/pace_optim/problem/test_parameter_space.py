"""The parameter vector: layout, normalisation, names, and parameters of a user's own."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from problems import TRUTH, chirp, env_cfg, make_problem, range_error, record

from pace_envs.tasks.pace import Parameter, base_parameters
from pace_optim.estimate.least_squares import least_squares
from pace_optim.problem.parameter_space import ParameterSpace


def parameter(name="gain", *, keys=("a", "b"), lower=None, upper=None, scale="linear", apply=lambda env, values: None):
    lower = (0.5,) * len(keys) if lower is None else lower
    upper = (2.0,) * len(keys) if upper is None else upper
    return Parameter(name=name, unit="1", lower=lower, upper=upper, apply=apply, keys=keys, scale=scale)


def test_the_base_vector_is_armature_viscous_friction_coulomb_friction_bias_of_every_joint_then_one_delay():
    cfg = env_cfg("Pace-AnymalD-v0").sim2real
    space = ParameterSpace.of(cfg)
    joints = list(cfg.joint_order)
    assert space.size == 4 * 12 + 1
    assert list(space.labels) == [
        *(f"{name}/{j}" for name in ("armature", "viscous_friction", "friction", "encoder_bias") for j in joints),
        "delay/all",
    ]
    assert [space[name] for name in space.slices] == [
        slice(0, 12),
        slice(12, 24),
        slice(24, 36),
        slice(36, 48),
        slice(48, 49),
    ]
    assert torch.equal(torch.stack([space.lower, space.upper], dim=1), torch.cat([*cfg.bounds.values()]))


def test_own_parameters_follow_the_base_ones():
    space = ParameterSpace((*base_parameters(env_cfg().sim2real), parameter(keys=("servo",))))
    assert space.labels == (
        "armature/servo",
        "viscous_friction/servo",
        "friction/servo",
        "encoder_bias/servo",
        "delay/all",
        "gain/servo",
    )
    assert space.units["gain"] == "1" and space.units["delay"] == "control steps"


def test_minus_one_zero_and_one_are_lower_middle_and_upper():
    space = ParameterSpace((parameter("lin", lower=(-0.1, 2.0), upper=(0.3, 10.0)), parameter("log", scale="log")))
    ends = torch.tensor([[-1.0], [0.0], [1.0]], dtype=torch.float64).expand(3, 4)
    expected = torch.tensor(
        [[-0.1, 2.0, 0.5, 0.5], [0.1, 6.0, 1.0, 1.0], [0.3, 10.0, 2.0, 2.0]], dtype=torch.float64
    )  # the middle of a logarithmic scale is the geometric mean
    assert torch.allclose(space.to_physical(ends), expected, rtol=1e-14)


bound = st.floats(1e-6, 1e3)


@given(
    low=bound,
    width=st.floats(1e-3, 1e3),
    scale=st.sampled_from(["linear", "log"]),
    x=st.floats(-1.0, 1.0),
)
def test_normalisation_and_its_inverse_agree_inside_the_bounds(low, width, scale, x):
    space = ParameterSpace((parameter(keys=("a",), lower=(low,), upper=(low + width,), scale=scale),))
    vector = torch.tensor([x], dtype=torch.float64)
    value = space.to_physical(vector)
    assert low <= float(value) <= low + width
    assert float(space.to_normalised(value)) == pytest.approx(x, abs=1e-6)


@given(scale=st.sampled_from(["linear", "log"]), x=st.floats(-0.99, 0.99))
def test_the_slope_is_the_derivative(scale, x):
    space = ParameterSpace((parameter(keys=("a",), lower=(0.01,), upper=(3.0,), scale=scale),))
    step = 1e-6
    ahead, behind = (space.to_physical(torch.tensor([x + s], dtype=torch.float64)) for s in (step, -step))
    slope = space.slope(torch.tensor([x], dtype=torch.float64))
    assert float(slope) == pytest.approx(float((ahead - behind) / (2 * step)), rel=1e-6)


def test_vectors_outside_the_box_are_brought_to_the_bounds():
    space = ParameterSpace((parameter(keys=("a",)), parameter("log", keys=("a",), scale="log")))
    for x, expected in ((-1.5, 0.5), (1.0000001, 2.0)):
        assert space.to_physical(torch.full((2,), x, dtype=torch.float64)).tolist() == [expected] * 2


def test_a_parameter_whose_bounds_are_equal_keeps_its_value():
    space = ParameterSpace((parameter(lower=(1.5, 0.5), upper=(1.5, 2.0)),))
    assert space.to_physical(torch.tensor([0.7, -1.0], dtype=torch.float64)).tolist() == [1.5, 0.5]
    assert space.to_normalised(torch.tensor([1.5, 0.5], dtype=torch.float64)).tolist() == [0.0, -1.0]


def test_dicts_and_vectors_are_two_forms_of_the_same():
    space = ParameterSpace(base_parameters(env_cfg("Pace-AnymalD-v0").sim2real))
    vector = torch.linspace(0.01, 0.1, space.size, dtype=torch.float64)
    values = space.to_dict(vector)
    assert next(iter(values["friction"])) == "LF_HAA" and set(values["delay"]) == {"all"}
    assert torch.equal(space.from_dict(values), vector)
    assert space.from_dict({**values, "delay": 3.0})[space["delay"]].tolist() == [3.0]
    assert space.from_dict({**values, "friction": 0.2})[space["friction"]].tolist() == [0.2] * 12


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"gian": 1.0}, "unknown: gian.*Expected: gain"),
        ({}, "missing: gain"),
        ({"gain": {"a": 1.0}}, "gain has values for a, expected a, b"),
        ({"gain": {"a": 1.0, "b": 1.0, "c": 1.0}}, "gain has values for a, b, c"),
    ],
)
def test_values_that_do_not_fit_are_named(values, message):
    with pytest.raises(ValueError, match=message):
        ParameterSpace((parameter(),)).from_dict(values)


def test_declarations_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match="'gain' is declared twice"):
        ParameterSpace((parameter(), parameter()))
    with pytest.raises(KeyError, match=r"no parameter 'gian'\. Available: gain"):
        ParameterSpace((parameter(),))["gian"]
    with pytest.raises(ValueError, match=r"'gain' has 1 lower and 2 upper bounds, expected 2 of each: a, b"):
        parameter(lower=(0.0,))
    with pytest.raises(ValueError, match="bounds of 'gain' must be > 0: its scale is logarithmic"):
        parameter(lower=(0.0, 0.1), scale="log")
    with pytest.raises(ValueError, match=r"'gain' on a are \(3, 2\), expected.*lower <= upper"):
        parameter(lower=(3.0, 0.5))
    with pytest.raises(ValueError, match=r"'gain' on b are \(0.5, inf\), expected finite"):
        parameter(upper=(2.0, math.inf))


@pytest.mark.slow
def test_one_declaration_adds_a_parameter_that_a_fit_recovers():
    def apply(env, values):
        env.scene["robot"].actuators["servo"].saturation_effort[:] = values

    stall_torque = Parameter(
        name="saturation_effort",
        unit="N m",
        lower=(20.0,),
        upper=(200.0,),
        apply=apply,
        keys=("servo",),
        scale="log",
    )
    cfg = env_cfg(extra_parameters=(stall_torque,))
    truth = {**TRUTH, "saturation_effort": 50.0}
    fast = chirp(high=8.0, amplitude=1.2)  # the torque-speed line is touched
    problem = make_problem(record(fast, truth, cfg=cfg), cfg=cfg)
    evaluator = problem.evaluator()
    start = torch.zeros(problem.space.size, dtype=torch.float64)
    before = evaluator.residuals(problem.space.to_physical(start[None])).score
    other = replace(stall_torque, lower=(60.0,), upper=(60.0,))
    unlike = make_problem(record(fast, truth, cfg=cfg), cfg=env_cfg(extra_parameters=(other,)))
    wrong = unlike.evaluator().residuals(unlike.space.from_dict({**truth, "saturation_effort": 60.0})[None])
    assert float(wrong.score) > 1e-8  # it reaches the simulation
    best = least_squares(evaluator, [start])[0]
    assert best.score < 1e-9 * float(before)
    assert range_error(problem, best.x, truth) < 1e-3
    assert float(problem.space.to_physical(best.x)[-1]) == pytest.approx(50.0, rel=1e-3)


def test_what_cannot_be_negative_is_searched_by_magnitude():
    space = ParameterSpace.of(env_cfg().sim2real)
    by_magnitude = space.by_magnitude()
    assert by_magnitude.labels == space.labels
    logarithmic = {
        label.split("/")[0] for label, log in zip(space.labels, by_magnitude.is_logarithmic, strict=True) if log
    }
    assert "encoder_bias" not in logarithmic and {"viscous_friction", "friction"} <= logarithmic
    entry = space["friction"].start
    physical = space.to_physical(space.start)
    physical[entry] = 1e-2 * space.upper[entry]
    x = by_magnitude.to_normalised(physical)
    assert float(x[entry]) == pytest.approx(0.0, abs=1e-9)  # half way from a ten-thousandth of the bound to it
    torch.testing.assert_close(by_magnitude.to_physical(x), physical)


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_holding_some_entries_keeps_the_start_of_the_others(scale):
    own = replace(parameter(scale=scale), start=0.8)
    space = ParameterSpace((own, replace(parameter("each", scale=scale), start=(0.6, 1.9)), parameter("middle")))
    values = space.to_physical(space.start)
    held = space.holding(["gain/b", "each/a"], values.new_tensor([0.8, 1.7, 1.2, 1.9, 1.25, 1.25]))
    expected = values.new_tensor([0.8, 1.7, 1.2, 1.9, 1.25, 1.25])
    torch.testing.assert_close(held.to_physical(held.start), expected)
