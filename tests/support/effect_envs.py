"""Drives with effects, alone and in environments, stepped by hand."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from problems import BENCH, DT, TRUTH, env_cfg

from pace_actuators import ActuatorActions, PaceDCMotor, PaceDCMotorCfg
from pace_actuators.effects import Effect, EffectCfg, EffectParameter, available_effects, get_effect
from pace_envs import ManagerBasedRLEnv
from pace_optim.problem.parameter_space import ParameterSpace

torch.set_num_threads(1)

EFFECTS = tuple(name for name in available_effects() if get_effect(name).__module__.startswith("pace_actuators."))
"""Those that come with the package."""

Values = Mapping[str, Any]
"""Value by ``effect.parameter``, a number or one per environment."""


def null_values(name: str) -> dict[str, float]:
    """Where an effect vanishes."""
    kind = get_effect(name)
    return {f"{name}.{p.name}": p.start if p.null is None else p.null for p in kind.parameters}


class Bench:
    """Some environments with effects and parameters, at the initial state."""

    def __init__(
        self,
        effects: Sequence[str | EffectCfg] = (),
        values: Values | None = None,
        *,
        base: Mapping[str, Any] = TRUTH,
        task: str = BENCH,
        num_envs: int = 1,
        calls: int = 1,
        integrator: str = "implicitfast",
        drive: Mapping[str, float] | None = None,
        delay_mode: str = "command",
        load: Mapping[str, float] | None = None,
    ):
        """Build it.

        Args:
            effects: The effects.
            values: Those that are not at their null.
            base: The base parameters.
            task: The environment.
            num_envs: Number of environments.
            calls: How often the drives are called in a control step; as many physics steps are made.
            integrator: How they are integrated.
            drive: Fields of the drives.
            delay_mode: What the drives' delay delays.
            load: The bench's load.
        """
        cfg = env_cfg(task)
        cfg.set_effects(effects)
        cfg.scene.num_envs = num_envs
        cfg.sim.dt /= calls
        cfg.sim.integrator = integrator
        cfg.decimation *= calls
        for each in cfg.scene.robot.actuators.values():
            each.control_decimation *= calls
            each.delay_mode = delay_mode
        self.env = ManagerBasedRLEnv(cfg)
        self.env.reset()
        self.robot = self.env.scene["robot"]
        for actuator in self.robot.actuators.values():
            for key, value in (drive or {}).items():
                getattr(actuator, key)[:] = value
        if load is not None:
            cfg.sim2real.apply_load(self.env, None, load)
        self.space = ParameterSpace.of(cfg.sim2real)
        nulls = {key: value for name in self.robot.effects for key, value in null_values(name).items()}
        self.write({**base, **nulls}, values or {})

    def write(self, values: Values, more: Values) -> None:
        """Write all parameters."""
        for parameter in self.space.parameters:
            value = more.get(parameter.name, values[parameter.name])
            tensor = torch.as_tensor(value, dtype=torch.float64)
            tensor = tensor.reshape(-1, 1) if tensor.ndim == 1 else tensor
            parameter.apply(self.env, tensor.expand(self.env.num_envs, len(parameter.keys)).clone())

    @property
    def effects(self):
        """The stack of the only drive."""
        return next(iter(self.robot.actuators.values())).effects

    def start(self, position: torch.Tensor | float, velocity: torch.Tensor | float = 0.0) -> None:
        """Put the joints somewhere."""
        n = (self.env.num_envs, self.robot.num_joints)
        self.robot.write_joint_state_to_sim(
            torch.as_tensor(position, dtype=torch.float64).expand(n).clone(),
            torch.as_tensor(velocity, dtype=torch.float64).expand(n).clone(),
        )
        self.env.sim.forward()

    def disable(self) -> None:
        """Let the drives give no torque."""
        for actuator in self.robot.actuators.values():
            actuator.set_torque_enable(torch.zeros(self.env.num_envs, dtype=torch.bool))

    def follow(self, targets: np.ndarray, *, sensed: bool = False, start: bool = True) -> torch.Tensor:
        """True (or sensed) positions at every control step, (T, num_envs, n)."""
        targets = torch.as_tensor(targets, dtype=torch.float64)
        if start:
            self.start(targets[0])
        result = []
        for target in targets:
            position = self.robot.sensed_joint_pos() if sensed else self.robot.data.joint_pos
            result.append(position.clone())
            self.env.simulate(target.expand(self.env.num_envs, self.robot.num_joints))
        self.env.close()
        return torch.stack(result)


def rms(a: torch.Tensor, b: torch.Tensor | float = 0.0) -> float:
    """Root mean square of a difference."""
    return float((a - b).square().mean().sqrt())


def long_chirp(duration: float, low: float = 0.3, high: float = 8.0, amplitude: float = 0.6) -> np.ndarray:
    """Targets of one joint, (T, 1) [rad]."""
    t = np.arange(round(duration / DT)) * DT
    return amplitude * np.sin(2 * math.pi * (low * t + (high - low) / (2 * duration) * t**2))[:, None]


class Branching(Effect):
    """An effect of a user's that asks for a tensor's values."""

    name = "branching"
    stage = "transmission"
    parameters = (EffectParameter(name="effort", unit="N m", lower=-1.0, upper=1.0, null=0.0, start=0.1),)

    def transmission(self, s):
        if bool((s.joint_pos > 0).any()):
            s.effort += self.effort


class Drive:
    """One drive with effects, called by hand: Kp 100, Kd 1, no delay, no limits."""

    def __init__(self, effects, values=None, *, num_envs=1, joints=("j",), dtype=torch.float64, **changes):
        cfg = {
            "joint_names_expr": ".*",
            "stiffness": 100.0,
            "damping": 1.0,
            "armature": 0.1,
            "friction": 0.5,
            "viscous_friction": 2.0,
            "delay": 0.0,
            "max_delay": 8.0,
            "effects": effects,
            "physics_dt": DT,
        }
        names = list(joints)
        self.motor = PaceDCMotor(PaceDCMotorCfg(**{**cfg, **changes}), names, slice(None), num_envs, dtype=dtype)
        self.zeros = torch.zeros(num_envs, len(names), dtype=dtype)
        for key, value in (values or {}).items():
            effect, _, parameter = key.partition(".")
            self.motor.effects.find(effect).set_parameter(parameter, value)
        self.motor.update_effects()

    def __call__(self, target=0.0, q=0.0, v=0.0):
        """The torque at the joint."""
        full = self.zeros
        action = ActuatorActions(full + target, None, None)
        return self.motor.compute(action, full + q, full + v).joint_efforts

    def one(self, *args, **kwargs):
        return float(self(*args, **kwargs)[0, 0])
