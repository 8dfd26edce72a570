"""The "real" ANYmal of transfer.py: drives by the plant of the hidden-effect benchmark, physics at 0.5 ms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from pace_actuators import PaceDCMotor
from pace_envs.identified import set_step
from pace_envs.registration import set_physics_dt
from pace_envs.tasks.velocity import VelocityEnvCfg
from pace_optim.data_collection.plant import PlantRobot, Truth, effect_named
from pace_optim.data_collection.plant.hidden import HiddenEffect
from pace_optim.data_collection.plant.truth import per_joint

PHYSICS_DT = 5e-4
"""Of the "real" robot [s]."""
_HISTORY = 16  # control steps: more than any delay here


class RealDrive(PaceDCMotor):
    """A drive whose torque is the plant's: nothing of :class:`PaceDCMotor`'s law runs.

    Encoder, delay of the targets, controller, effects on the drive and torque-speed curve are computed here or by
    the plant's effects; MuJoCo has armature, viscous and Coulomb friction. :func:`make_real` sets ``truth``.
    """

    truth: Truth

    def __init__(self, *args: Any, **kwargs: Any):
        """Draw up the plant's constants for every environment."""
        super().__init__(*args, **kwargs)
        if self.truth.delay_mode != "command":
            raise ValueError("The plant here delays commands; the truth delays efforts.")
        shape = (self._num_envs, self.num_joints)
        self._gains = [getattr(self, name).numpy() for name in ("stiffness", "damping")]
        self._limits = [getattr(self, name).numpy() for name in ("saturation_effort", "velocity_limit", "effort_limit")]
        self._bias = self.encoder_bias.numpy()
        step = self.cfg.control_decimation * PHYSICS_DT
        self._delay = np.full(shape, self.truth.base.delay / step)
        self._effects = [self._effect(name) for name in self.truth.effects]
        self._targets = np.zeros((_HISTORY, *shape))
        self._fresh = np.ones(self._num_envs, dtype=bool)
        self._feedback = self._asked = np.zeros(shape)

    @property
    def changes_passive(self) -> bool:
        """Never: friction is constant."""
        return False

    def compute(self, control_action: Any, joint_pos: torch.Tensor, joint_vel: torch.Tensor) -> Any:
        """Torques [N m] of the plant's drives."""
        speed = joint_vel.numpy()
        if self._calls_until_control == 0:
            self._calls_until_control = self.cfg.control_decimation
            self._control(control_action.joint_positions.numpy(), joint_pos.numpy(), speed)
        part = self.cfg.control_decimation - self._calls_until_control
        older, newer, weight = self._arrived(part)
        before, after = (self._gains[0] * target + self._feedback for target in (older, newer))
        self._asked = weight * before + (1 - weight) * after
        self._calls_until_control -= 1
        torque = weight * self._given(before, speed) + (1 - weight) * self._given(after, speed)
        self.computed_effort = torch.from_numpy(self._asked)
        self.applied_effort = self._held_effort = torch.from_numpy(torque)
        return replace(control_action, joint_positions=None, joint_velocities=None, joint_efforts=self.applied_effort)

    def _given(self, asked: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """What the motor gives of a torque that is asked [N m]."""
        stall, no_load, largest = self._limits
        torque = np.clip(asked, -largest, largest)
        for effect in sorted(self._effects, key=lambda each: each.drive_rank):
            torque = effect.drive(torque, None)  # type: ignore[arg-type]
        drop = stall / no_load * speed
        return np.clip(torque, np.minimum(-stall - drop, largest), np.maximum(stall - drop, -largest))

    def _control(self, target: np.ndarray, position: np.ndarray, speed: np.ndarray) -> None:
        self._targets[:-1] = self._targets[1:]
        self._targets[-1] = target
        self._targets[:, self._fresh] = target[self._fresh]
        self._fresh[:] = False
        stiffness, damping = self._gains
        reading = position - self._bias
        self._feedback = -stiffness * reading - damping * speed

    def _arrived(self, part: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The late target before and after it switches within a physics step [rad], and the part of the step before."""
        parts = self.cfg.control_decimation
        left = self._delay - part / parts
        back = np.maximum(np.ceil(left), 0).astype(int)
        older = np.take_along_axis(self._targets, (_HISTORY - 1 - back)[None], axis=0)[0]
        newer = np.take_along_axis(self._targets, np.minimum(_HISTORY - back, _HISTORY - 1)[None], axis=0)[0]
        weight = np.minimum(parts * (1 + left - back), 1.0)
        return older, newer, weight

    def reset(self, env_ids: Sequence[int] | torch.Tensor | slice | None = None) -> None:
        """Forget the targets of all or some environments."""
        super().reset(env_ids)
        if hasattr(self, "_fresh"):
            self._fresh[slice(None) if env_ids is None else env_ids] = True

    def _effect(self, name: str) -> HiddenEffect:
        kind = effect_named(name)
        if {stage for stage in vars(kind) if stage in _STAGES} != {"drive"}:
            raise ValueError(f"{name} does not act on the drive's torque alone: this robot cannot have it.")
        given = self.truth.effects[name]
        rows = {key: per_joint(value, self.joint_names, kind.draws[key].null, key) for key, value in given.items()}
        return kind({key: np.tile(row, (self._num_envs, 1)) for key, row in rows.items()})


_STAGES = {"prepare", "command", "measure", "speed_feedback", "controller", "drive", "friction"} | {
    "motor_torque",
    "joint_torque",
}


def make_real(cfg: VelocityEnvCfg, robot: PlantRobot, truth: Truth) -> None:
    """Turn a walking task into the "real" one: the policy's gains stay, everything else of the drives is the truth's.

    Args:
        cfg: The task; it is changed.
        robot: The robot that was recorded.
        truth: What it is really like.
    """
    names = robot.joint_names

    def of_joints(field: str) -> dict[str, float]:
        return dict(zip(names, per_joint(getattr(truth.base, field), names, 0.0, field).tolist(), strict=True))

    drive_class = type("RealDriveOfTruth", (RealDrive,), {"truth": truth})
    values = {field: of_joints(field) for field in ("armature", "viscous_friction", "friction", "encoder_bias")}
    cfg.scene.robot.actuators = {
        group: replace(drive, class_type=drive_class, delay=0.0, delay_s=None, identified=None, effects=(), **values)
        for group, drive in cfg.scene.robot.actuators.items()
    }
    set_step(cfg, robot.control_dt)
    set_physics_dt(cfg, PHYSICS_DT)
    cfg.sim.integrator = "implicitfast"  # Runge-Kutta takes four times as long, and contacts gain nothing
