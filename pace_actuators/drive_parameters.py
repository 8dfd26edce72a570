"""Reading and checking the parameters of a drive's configuration."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from pace_actuators.base_parameters import CARRIED
from pace_actuators.joint_values import JointValue, resolve_joint_values
from pace_actuators.pace_dc_motor_cfg import PaceDCMotorCfg

_NOT_NEGATIVE = (lambda x: (x >= 0) & x.isfinite(), "a finite number >= 0")
_DOMAINS: dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], str]] = {
    "stiffness": _NOT_NEGATIVE,
    "damping": _NOT_NEGATIVE,
    **dict.fromkeys(CARRIED, _NOT_NEGATIVE),
    "saturation_effort": (
        lambda x: (x >= 0) & x.isfinite(),
        "a finite number >= 0, or None for no torque-speed curve",
    ),
    "effort_limit": (lambda x: x >= 0, "a number >= 0, or inf"),
    "velocity_limit": (lambda x: x > 0, "a number > 0, or inf"),
    "encoder_bias": (torch.isfinite, "a finite number"),
}
"""Which values a field of the configuration may have, and how to say so."""


class DriveParameters:
    """Makes tensors (num_envs, num_joints) of a configuration's values."""

    def __init__(
        self,
        cfg: PaceDCMotorCfg,
        joint_names: Sequence[str],
        num_envs: int,
        device: torch.device,
        dtype: torch.dtype,
    ):
        """Check the choices that are no numbers.

        Raises:
            ValueError: If one of them is unknown.
        """
        self._cfg = cfg
        self._joint_names = list(joint_names)
        self._shape = (num_envs, len(self._joint_names))
        self._device, self._dtype = device, dtype
        if cfg.delay_mode not in ("command", "effort"):
            raise ValueError(f"Unknown delay_mode {cfg.delay_mode!r}. Available: 'command', 'effort'.")
        if not (isinstance(cfg.control_decimation, int) and cfg.control_decimation >= 1):
            raise ValueError(f"control_decimation is {cfg.control_decimation!r}, expected an integer >= 1.")
        if cfg.implicit and cfg.drive_dt is not None:
            raise ValueError(
                f"The drive's controller is implicit, it runs continuously, and drive_dt is {cfg.drive_dt:g} s. "
                "Leave out one of the two."
            )
        if cfg.implicit and cfg.delay_mode == "effort":
            raise ValueError(
                "The drive's controller is implicit, it acts at once, and delay_mode 'effort' would delay its torque. "
                "Set implicit to False, with a drive_dt, or delay_mode to 'command'."
            )

    def read(self, field: str, default: torch.Tensor | float) -> torch.Tensor:
        """A field's values; the default where the configuration says ``None``.

        Raises:
            ValueError: If a value lies outside the field's domain, or their number is wrong.
        """
        value: JointValue | None = getattr(self._cfg, field)
        if value is None:
            result = self.tensor(default, field)
        else:
            result = self.tensor(resolve_joint_values(value, self._joint_names, field=field), field)
        valid, expected = _DOMAINS[field]
        bad = ~valid(result)
        if bool(bad.any()):
            joint = self._joint_names[int(bad.any(dim=0).nonzero()[0])]
            raise ValueError(f"{field} of {joint} is {result[bad][0].item():g}, expected {expected}.")
        return result

    def tensor(self, value: torch.Tensor | float, field: str) -> torch.Tensor:
        """Values spread over environments and joints.

        Raises:
            ValueError: If their number is wrong.
        """
        tensor = torch.as_tensor(value, dtype=self._dtype, device=self._device)
        try:
            return tensor.expand(self._shape).clone()
        except RuntimeError:
            raise ValueError(
                f"{field} has shape {tuple(tensor.shape)}, expected a number, ({self._shape[1]},) or {self._shape}."
            ) from None
