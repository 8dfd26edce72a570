"""Configuration of the identified drive."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch

from pace_actuators.base_parameters import CARRIED
from pace_actuators.config import Config
from pace_actuators.effects import EffectCfg
from pace_actuators.joint_values import JointValue, match_names, resolve_joint_values

if TYPE_CHECKING:
    from pace_actuators.identified import IdentifiedAt
    from pace_actuators.pace_dc_motor import PaceDCMotor

DelayMode = Literal["command", "effort"]

_LARGEST_DELAY = 10.0
"""That of a configuration that says none [control steps]."""


@dataclass(kw_only=True)
class PaceDCMotorCfg(Config):
    """One type of drive and the joints that it moves.

    Values are numbers (for every joint of the group), dicts of regular expression to value, or one value
    per joint. A pattern that matches no joint, and a joint matched twice, are errors.
    """

    elsewhere: ClassVar = {
        "min_delay": "write delay, the delay that acts, and max_delay, the largest that can be set later.",
        "effort_limit_sim": "the drive limits its own torque. Write effort_limit.",
        "velocity_limit_sim": "the torque-speed line limits the speed. Write velocity_limit.",
    }

    class_type: type[PaceDCMotor] | None = None
    """The actuator class to build; ``None`` means :class:`PaceDCMotor`. Set it to your own subclass."""

    joint_names_expr: str | Sequence[str]
    """Regular expressions of the joints in this group."""

    stiffness: JointValue | None = None
    """Position gain kp [N m/rad]; ``None`` takes what the constructor is given."""

    damping: JointValue | None = None
    """Velocity gain kd [N m s/rad]; ``None`` takes what the constructor is given."""

    saturation_effort: JointValue | None = None
    """Stall torque of the torque-speed curve [N m]; ``None``, or inf of a joint: torque does not depend on speed."""

    effort_limit: JointValue | None = None
    """Continuous torque limit [N m]; ``None`` takes what the constructor is given (default: no limit)."""

    velocity_limit: JointValue | None = None
    """No-load speed of the torque-speed curve [rad/s]; ``None`` takes what the constructor is given."""

    armature: JointValue | None = None
    """Rotor inertia seen at the joint [kg m^2]. Applied by the simulator, not by the actuator."""

    friction: JointValue | None = None
    """Coulomb friction [N m]. Applied by the simulator, not by the actuator."""

    static_friction: JointValue | None = None
    """Another name of ``friction``, which takes it over."""

    dynamic_friction: JointValue | None = None
    """Coulomb friction of a sliding joint [N m], where it is below that at rest: the effect ``dynamic_friction``, which
    takes it over."""

    viscous_friction: JointValue | None = None
    """Viscous friction [N m s/rad]. Applied by the simulator, not by the actuator."""

    encoder_bias: JointValue = 0.0
    """Encoder bias [rad]: the encoder shows q_enc = q - bias."""

    delay: float | None = None
    """Delay of every environment at the start [control steps], from 0 to ``max_delay``. ``None``: as in PACE, a
    ``max_delay`` that is set; without one, 0."""

    delay_s: float | None = None
    """Delay [s] in place of ``delay``: the drive converts it to its own control steps, and raises ``max_delay``."""

    max_delay: float | None = None
    """Largest delay that can be set later [control steps]; ``None``: 10. As in PACE, a drive with a ``max_delay`` and
    neither ``delay`` nor ``delay_s`` acts with a delay of ``max_delay``. To set the largest only, give ``delay=0.0``
    too."""

    delay_mode: DelayMode = "command"
    """What is delayed: ``"command"`` (targets and feed-forward) or ``"effort"`` (the controller's torque)."""

    delay_interpolation: Literal["linear", "hold"] = "linear"
    """Between samples: ``"linear"``, or ``"hold"`` for whole steps only."""

    control_decimation: int = 1
    """Calls of ``compute`` (physics steps) per control step; commands are held in between, and so is the controller's
    torque unless ``drive_dt`` or ``implicit`` says otherwise."""

    drive_dt: float | None = None
    """Time between two runs of the drive's own controller [s], at least a physics step: commands come once per control
    step and are held. Where it does not divide the control step, the controller runs on a separate clock. ``None``
    runs it once per control step."""

    implicit: bool = False
    """Whether the controller runs continuously, as that of a position actuator in a model file: at every physics step,
    and its damping (and the stiffness behind it) acts on the motion within the step. Other loops hold their torque."""

    centred_commands: bool = False
    """Whether a delay of commands is the drive's alone. Simulators that update speeds before positions (semi-implicit
    Euler: MuJoCo's, PhysX') let what is held over a step act half a step early; PACE's identified delay makes up for
    it, and is longer than the drive's by half a physics step. ``True`` takes that half step out of the commands, so
    that it does not go into the delay; feedback stays as it is."""

    second_order: bool = False
    """Whether the values were identified with steps of second order, so that they hold no error of a step. Simulators
    that update speeds before positions show positions half a physics step early; the drive then takes that back, and
    lets commands act half a step later."""

    effects: Sequence[EffectCfg | str] = ()
    """Physical effects beyond this base model, by name (``"stribeck_friction"``) or with their values."""

    physics_dt: float | None = None
    """Time between two calls of ``compute`` [s]; effects need it, an environment gives its own."""

    identified: IdentifiedAt | None = None
    """Time steps of the identification that the values come from: the drive warns where its own are too different."""

    def __post_init__(self) -> None:
        """Take over the friction at rest and while sliding."""
        if self.static_friction is not None:
            if self.friction is not None and self.friction != self.static_friction:
                raise ValueError(
                    f"friction is {self.friction} and static_friction {self.static_friction}: both are the friction at "
                    "rest. Give one of them."
                )
            self.friction, self.static_friction = self.static_friction, None
        if self.dynamic_friction is not None:
            ratio = _friction_ratio(self.friction, self.dynamic_friction)
            self.dynamic_friction = None
            if ratio != 1.0:
                self.effects = (*self.effects, EffectCfg(effect="dynamic_friction", values={"ratio": ratio}))

    @property
    def largest_delay(self) -> float:
        """Largest delay that can be set later [control steps]."""
        return _LARGEST_DELAY if self.max_delay is None else self.max_delay

    def on_joints(self, joint_names: Sequence[str], chosen: Sequence[str]) -> PaceDCMotorCfg | None:
        """The same for some of the joints of its group, without effects; ``None`` if it moves none of them.

        Args:
            joint_names: All joints of the robot, in order.
        """
        found = {i for indices in match_names(self.joint_names_expr, joint_names) for i in indices}
        group = [name for i, name in enumerate(joint_names) if i in found]
        kept = [i for i, name in enumerate(group) if name in chosen]
        if not kept:
            return None
        per_joint: dict[str, Any] = {
            f.name: resolve_joint_values(value, group, field=f.name)[kept]
            for f in fields(self)
            if "JointValue" in str(f.type) and (value := getattr(self, f.name)) is not None
        }
        return replace(self, joint_names_expr=[re.escape(group[i]) for i in kept], effects=(), **per_joint)

    @classmethod
    def from_result(
        cls, path: str | Path, joint_names_expr: str | Sequence[str] | None = None, **overrides: Any
    ) -> PaceDCMotorCfg:
        """The drive that a fit identified.

        Sets armature, viscous and Coulomb friction, encoder bias, delay (in seconds), delay mode and every effect; and
        the gains and limits that were in force in all recordings, where the result says them.

        Args:
            path: ``result.json``, or the run's folder.
            joint_names_expr: Which of its joints; ``None`` means all.
            overrides: Further fields, such as ``stiffness`` of the policy's controller; they win.

        Raises:
            ValueError: If the file is missing or unusable, names no such joint, or holds an unknown effect.
        """
        from pace_actuators.identified import IdentifiedDrives

        drives = IdentifiedDrives.load(path)
        return cls(**drives.cfg_fields(joint_names_expr) | overrides)


def _friction_ratio(static: JointValue | None, dynamic: JointValue) -> JointValue:
    """The sliding friction's part of that at rest, per joint as the two are."""
    if static is None:
        raise ValueError(
            f"dynamic_friction is {dynamic}, and there is no friction at rest. Give friction (static_friction) too."
        )
    keys: list[Any] = [None]
    for value in (static, dynamic):
        if isinstance(value, Mapping):
            keys = list(value)
        elif not _is_number(value):
            keys = list(range(len(value)))  # type: ignore[arg-type]
    found: dict[Any, float] = {}
    for key in keys:
        try:
            rest, sliding = _at(static, key), _at(dynamic, key)
        except (KeyError, IndexError, TypeError):
            raise ValueError(
                f"friction is {static} and dynamic_friction {dynamic}: expected numbers, or values of the same joints."
            ) from None
        if not 0 <= sliding <= rest:
            raise ValueError(f"dynamic_friction is {sliding:g} N m, expected 0 to the friction at rest, {rest:g} N m.")
        found[key] = sliding / rest if rest else 1.0
    if len(set(found.values())) == 1:
        return next(iter(found.values()))
    return dict(found) if isinstance(next(iter(found)), str) else list(found.values())


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) or getattr(value, "ndim", 1) == 0


def _at(value: Any, key: Any) -> float:
    """A joint's value of a number, a list or a dict."""
    return float(value if _is_number(value) else value[key])


def calls_per_run(cfg: PaceDCMotorCfg, physics_dt: float | None) -> int | None:
    """Calls of a drive (physics steps) from one run of its controller to the next.

    Args:
        physics_dt: Time between two of its calls [s].

    Returns:
        The calls; ``None`` where runs do not fall on the same calls of every control step: the drive then keeps its
        own clock.
    """
    if cfg.implicit:
        return 1
    if cfg.drive_dt is None:
        return cfg.control_decimation
    if physics_dt is None:
        raise ValueError(
            f"The drive states its rate (drive_dt = {cfg.drive_dt:g} s), and the time between two calls is not "
            "known: set physics_dt [s] in the actuator's configuration."
        )
    if not cfg.drive_dt > physics_dt * (1 - 1e-6):
        raise ValueError(
            f"drive_dt is {cfg.drive_dt:g} s and the physics step {physics_dt:g} s: expected at least a physics step "
            f"in drive_dt. Make the physics step finer (--physics_dt {cfg.drive_dt:g} where a command has it, else "
            "sim.dt), or change drive_dt."
        )
    calls = round(cfg.drive_dt / physics_dt)
    fits = abs(calls * physics_dt - cfg.drive_dt) < 1e-9 and cfg.control_decimation % calls == 0
    return calls if fits else None


_NOT_NEGATIVE = (lambda x: (x >= 0) & x.isfinite(), "a finite number >= 0")
_DOMAINS: dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], str]] = {
    "stiffness": _NOT_NEGATIVE,
    "damping": _NOT_NEGATIVE,
    **dict.fromkeys(CARRIED, _NOT_NEGATIVE),
    "saturation_effort": (lambda x: x >= 0, "a number >= 0, or inf for no torque-speed curve"),
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
        """Check the choices that are no numbers."""
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
        """A field's values; the default where the configuration says ``None``."""
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
        """Values spread over environments and joints."""
        tensor = torch.as_tensor(value, dtype=self._dtype, device=self._device)
        try:
            return tensor.expand(self._shape).clone()
        except RuntimeError:
            raise ValueError(
                f"{field} has shape {tuple(tensor.shape)}, expected a number, ({self._shape[1]},) or {self._shape}."
            ) from None
