"""How well a policy walks, or reaches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict

from pace_actuators import resolve_joint_values
from pace_envs.mdp import motor_power
from pace_envs.robot_state import of_floating_base
from pace_envs.rsl_rl_wrapper import RslRlVecEnvWrapper
from pace_envs.tasks.reach import ReachEnvCfg
from pace_envs.tasks.reach.reach_env_cfg import COMMAND, distance
from pace_envs.tasks.velocity import VelocityEnvCfg

_SETTLED = 2.0
"""A hand has had time to arrive this long after a command [s]."""
_NEAR = 0.02
"""What counts as arrived [m]."""

Policy = Callable[[TensorDict], torch.Tensor]


@dataclass(kw_only=True)
class Evaluation:
    """What a policy did, over all environments and all steps."""

    velocity_error: float
    """Mean distance of the planar velocity to the command, step by step [m/s]."""

    yaw_rate_error: float
    """Mean distance of the yaw rate to the command [rad/s]."""

    falls_per_episode: float
    """Falls per environment and 20 s."""

    cost_of_transport: float
    """Electrical energy over weight and way, ∫P_el dt / (m g ∫|v_xy| dt)."""

    power: float
    """Mean electrical power [W]."""

    speed: float
    """Mean planar speed [m/s]."""

    def __str__(self) -> str:
        """One line per figure."""
        return (
            f"velocity error    {self.velocity_error:.3f} m/s\n"
            f"yaw rate error    {self.yaw_rate_error:.3f} rad/s\n"
            f"falls per 20 s    {100 * self.falls_per_episode:.1f} %\n"
            f"cost of transport {self.cost_of_transport:.2f} ({self.power:.0f} W at {self.speed:.2f} m/s)"
        )


@torch.inference_mode()
def evaluate(
    env: RslRlVecEnvWrapper, policy: Policy, steps: int | None = None, on_step: Callable[[], None] | None = None
) -> Evaluation:
    """Let a policy walk in all environments.

    Args:
        env: The environment, of a velocity task.
        steps: Environment steps; by default one episode.
        on_step: Called after every step, to draw it.
    """
    base = env.unwrapped
    if not isinstance(base.cfg, VelocityEnvCfg):
        raise ValueError("This environment is no velocity task: its configuration is no VelocityEnvCfg.")
    robot = base.scene["robot"]
    copper_loss = base.sim.tensor(resolve_joint_values(base.cfg.copper_loss, robot.joint_names, field="copper_loss"))
    steps = steps or int(base.max_episode_length)
    sums = torch.zeros(4, dtype=torch.float64, device=base.device)
    falls = torch.zeros((), dtype=torch.long, device=base.device)
    obs, _ = env.reset()
    for _ in range(steps):
        # the state before the step: after it, robots that fell stand again
        command, data = base.command_manager.get_command("base_velocity"), robot.data
        velocity, yaw_rate = data.root_lin_vel_b[:, :2], of_floating_base(data.root_ang_vel_b)[:, 2]
        power = motor_power(data.applied_torque, data.joint_vel, copper_loss)
        sums += torch.stack(
            [
                (velocity - command[:, :2]).norm(dim=1).mean(),
                (yaw_rate - command[:, 2]).abs().mean(),
                power.mean(),
                velocity.norm(dim=1).mean(),
            ]
        )
        obs, *_ = env.step(policy(obs))
        falls += base.termination_manager.terminated.sum()
        if on_step is not None:
            on_step()
    error, yaw_error, mean_power, speed = (sums / steps).tolist()
    weight = float(base.sim.model.body_mass.sum()) * abs(base.cfg.sim.gravity[2])
    return Evaluation(
        velocity_error=error,
        yaw_rate_error=yaw_error,
        falls_per_episode=int(falls) / base.num_envs / (steps * base.step_dt / 20.0),
        cost_of_transport=mean_power / (weight * max(speed, 1e-9)),
        power=mean_power,
        speed=speed,
    )


@dataclass(kw_only=True)
class ReachEvaluation:
    """Where a policy brought a hand, over all environments and all steps."""

    distance: float
    """Mean distance to the commanded place, two seconds after the command and later [m]."""

    arrived: float
    """Part of that time within 2 cm."""

    def __str__(self) -> str:
        """One line per figure."""
        return f"distance          {1e3 * self.distance:.1f} mm\nwithin 20 mm      {100 * self.arrived:.1f} %"


@torch.inference_mode()
def evaluate_reach(
    env: RslRlVecEnvWrapper, policy: Policy, steps: int | None = None, on_step: Callable[[], None] | None = None
) -> ReachEvaluation:
    """Let a policy reach in all environments; the arguments are those of :func:`evaluate`."""
    base = env.unwrapped
    if not isinstance(base.cfg, ReachEnvCfg):
        raise ValueError("This environment is no reaching task: its configuration is no ReachEnvCfg.")
    command = base.command_manager.get_term(COMMAND)
    steps = steps or int(base.max_episode_length)
    far = near = count = 0.0
    held = torch.zeros(base.num_envs, device=base.device)
    obs, _ = env.reset()
    for _ in range(steps):
        before = command.command.clone()
        obs, *_ = env.step(policy(obs))
        held = torch.where((command.command == before).all(dim=1), held + base.step_dt, torch.zeros_like(held))
        settled = held >= _SETTLED
        away = distance(base, COMMAND, base.cfg.site)[settled]
        far, near, count = far + float(away.sum()), near + float((away < _NEAR).sum()), count + float(settled.sum())
        if on_step is not None:
            on_step()
    if not count:
        raise ValueError(f"No command was held for {_SETTLED:g} s. Play for longer (--seconds).")
    return ReachEvaluation(distance=far / count, arrived=near / count)
