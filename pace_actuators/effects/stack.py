"""The effects of a drive, run stage by stage."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from pace_actuators.effects.drive_state import DriveState
from pace_actuators.effects.effect import Effect
from pace_actuators.effects.effect_cfg import EffectCfg
from pace_actuators.joint_values import resolve_joint_values

_STAGES = (
    "advance",
    "command",
    "measurement",
    "sensed_velocity",
    "controller",
    "effort_command",
    "drive",
    "friction",
    "transmission",
    "armature",
)


class EffectStack:
    """Holds a drive's effects and the state that they share."""

    def __init__(
        self,
        cfgs: Sequence[EffectCfg],
        joint_names: Sequence[str],
        num_envs: int,
        *,
        dt: float,
        control_dt: float,
        delay_mode: str,
        device: torch.device,
        dtype: torch.dtype,
    ):
        """Build the effects.

        Args:
            cfgs: Which, on which joints.
            joint_names: The drive's joints.
            num_envs: Number of environments.
            dt: Time between two calls of the drive [s].
            control_dt: Time between two control steps [s].
            delay_mode: What the drive's own delay delays.
            device: Device of all tensors.
            dtype: Type of all tensors.

        Raises:
            ValueError: If joints or values do not fit.
        """
        self._is_trapezoidal = False
        self.state = DriveState.zeros(num_envs, len(joint_names), device, dtype)
        self._joint_names = list(joint_names)
        self._num_envs = num_envs
        self.dt = dt
        self.effects: list[Effect] = []
        self.cfgs: list[EffectCfg] = []
        self._view: dict[Effect, DriveState] = {}
        for cfg in cfgs:
            rows = slice(None) if cfg.env_rows is None else cfg.env_rows
            effect = cfg.effect_class(
                num_envs,
                len(joint_names),
                dt=dt,
                control_dt=control_dt,
                delay_mode=delay_mode,
                rows=rows,
                device=device,
                dtype=dtype,
            )
            self.effects.append(effect)
            self.cfgs.append(cfg)
            self._view[effect] = self.state.of_rows(rows, with_load=effect.reads_load)
            self._configure(effect, cfg)
        self._at = {
            stage: [
                (getattr(effect, stage), self._view[effect])
                for effect in sorted(self.effects, key=_side if stage == "transmission" else lambda _: 0)
                if effect.overrides(stage)
            ]
            for stage in _STAGES
        }
        self.changes_passive = bool(self._at["friction"] or self._at["transmission"])
        """Whether friction or viscous friction change from step to step."""
        self.changes_armature = any(effect.changes_armature for effect in self.effects)
        """Whether the armature changes from step to step."""
        self.lags = [effect for effect in self.effects if effect.overrides("observation_lag")]
        self.needs_load = any(effect.reads_load for effect in self.effects)
        """Whether the torque of gravity and load must be given."""

    @property
    def is_trapezoidal(self) -> bool:
        """Whether the simulator moves positions with the mean of the old and the new speed."""
        return self._is_trapezoidal

    @is_trapezoidal.setter
    def is_trapezoidal(self, value: bool) -> None:
        self._is_trapezoidal = value
        for effect in self.effects:
            effect.is_trapezoidal = value

    def has(self, stage: str) -> bool:
        """Whether an effect acts at a stage."""
        return bool(self._at[stage])

    def run(self, stage: str) -> None:
        """Let all effects of a stage act."""
        for act, view in self._at[stage]:
            act(view)

    def find(self, name: str) -> Effect:
        """The effect of that name.

        Raises:
            ValueError: If the drive does not have it.
        """
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise ValueError(
            f"The drive has no effect {name!r}. It has: {', '.join(e.name for e in self.effects) or 'none'}."
        )

    def reset(self, env_ids: Any = None) -> None:
        """Forget the history of all or some environments."""
        if env_ids is None:
            for effect in self.effects:
                effect.reset_state(slice(None))
            return
        chosen = torch.zeros(self._num_envs, dtype=torch.bool, device=self.state.time.device)
        chosen[env_ids] = True
        for effect in self.effects:
            own = chosen[effect.rows]
            if bool(own.any()):
                effect.reset_state(own)

    def observation_lag(self, time: torch.Tensor) -> torch.Tensor | None:
        """How late the samples of a recording are [s], (num_envs, num_joints); ``None`` if no effect says so.

        Args:
            time: Of the samples since their recording began [s], (num_envs, num_joints).
        """
        if not self.lags:
            return None
        total = torch.zeros_like(self.state.time)
        for effect in self.lags:
            lag = effect.observation_lag(time[effect.rows])
            if lag is not None:
                total[effect.rows] += lag
        return total

    def _configure(self, effect: Effect, cfg: EffectCfg) -> None:
        names = cfg.joints(self._joint_names)
        joints = torch.tensor([self._joint_names.index(name) for name in names], device=self.state.time.device)
        known = {parameter.name for parameter in effect.parameters}
        for name, value in cfg.values.items():
            if name not in known:
                raise ValueError(
                    f"The effect {effect.name!r} has no parameter {name!r}. Available: {', '.join(sorted(known))}."
                )
            values = resolve_joint_values(value, names, field=f"{effect.name}.{name}")
            effect.set_parameter(name, values, joints=joints)
        effect.prepare()


def _side(effect: Effect) -> int:
    """From motor to link: friction, what parts the two, torques on the link."""
    if effect.parts_motor_and_link:
        return 1
    return 0 if effect.stage == "friction" else 2
