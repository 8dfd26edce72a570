"""On a GPU, where there is one, drives give the torques that they give on the CPU."""

import pytest
import torch

from pace_actuators import ActuatorActions, PaceDCMotor, PaceDCMotorCfg
from pace_actuators.effects import EffectCfg, available_effects, get_effect

if not torch.cuda.is_available():
    pytest.skip("torch finds no CUDA device here; all other tests run drives on the CPU", allow_module_level=True)

JOINTS, NUM_ENVS, DT, CALLS = ["hip", "thigh", "knee"], 5, 0.0025, 300
TOLERANCE = {torch.float32: 1e-3, torch.float64: 1e-10}
"""Relative to the largest torque."""


class Bench:
    """Drives called along one random motion on a device."""

    def __init__(self, names, device, dtype):
        self.device, self.dtype = torch.device(device), dtype
        effects = [
            EffectCfg(effect=name, values={p.name: p.start for p in get_effect(name).parameters}) for name in names
        ]
        cfg = PaceDCMotorCfg(
            joint_names_expr=".*",
            stiffness=85.0,
            damping=0.6,
            armature=0.1,
            friction=0.5,
            viscous_friction=2.0,
            encoder_bias=0.02,
            delay=2.4,
            max_delay=8.0,
            saturation_effort=120.0,
            effort_limit=80.0,
            velocity_limit=7.5,
            effects=effects,
            physics_dt=DT,
        )
        self.motor = PaceDCMotor(cfg, JOINTS, slice(None), NUM_ENVS, device=device, dtype=dtype)

    def run(self):
        """What the drives leave to the simulator and the encoders show, (CALLS, 3, NUM_ENVS, joints), on the CPU."""
        random = torch.Generator().manual_seed(0)

        def smooth(scale):
            steps = torch.randn(CALLS, NUM_ENVS, len(JOINTS), generator=random, dtype=torch.float64)
            return (scale * steps.cumsum(0) / CALLS**0.5).to(self.device, self.dtype)

        target, q, v, load = smooth(0.5), smooth(0.5), smooth(3.0), smooth(10.0)
        inertia = torch.full_like(q[0], 0.4)
        result = []
        for k in range(CALLS):
            if k == CALLS // 2:
                some = torch.tensor([0, 3], device=self.device)
                self.motor.reset(some)
                self.motor.update_time_lags(torch.tensor([1.0, 3.3], device=self.device, dtype=self.dtype), some)
            self.motor.set_load_effort(load[k])
            self.motor.set_link(inertia, 5.0 * inertia, 0.1 * inertia)
            shown = self.motor.observe(q[k], v[k])
            torque = self.motor.compute(ActuatorActions(target[k], None, None), q[k], v[k]).joint_efforts
            assert torque.device.type == shown.device.type == self.device.type
            result.append(torch.stack([torque, shown.clone(), self.motor.joint_friction.expand_as(torque)]).cpu())
        return torch.stack(result)


def _holds(names, dtype):
    expected, got = (Bench(names, device, dtype).run() for device in ("cpu", "cuda"))
    assert bool(got.isfinite().all())
    largest = expected.abs().amax(dim=(0, 2, 3)).clamp(min=1.0)[:, None, None]
    assert float(((got - expected) / largest).abs().max()) < TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", [None, *available_effects()])
def test_an_effect_gives_on_a_gpu_what_it_gives_on_the_cpu(name, dtype):
    _holds([] if name is None else [name], dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_so_do_several_together(dtype):
    together = ["stribeck_friction", "drive_bandwidth", "measurement_delay", "encoder_eccentricity", "joint_elasticity"]
    _holds(together, dtype)
