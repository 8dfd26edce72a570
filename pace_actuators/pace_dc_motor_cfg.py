"""Configuration of the identified drive."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pace_actuators.effects import EffectCfg
from pace_actuators.joint_values import JointValue, match_names, resolve_joint_values

if TYPE_CHECKING:
    from pace_actuators.identified import IdentifiedAt
    from pace_actuators.pace_dc_motor import PaceDCMotor

DelayMode = Literal["command", "effort"]


@dataclass(kw_only=True)
class PaceDCMotorCfg:
    """One type of drive and the joints that it moves.

    Values are numbers (for every joint of the group), dicts of regular expression to value, or one value
    per joint. A pattern that matches no joint, and a joint matched twice, are errors.
    """

    class_type: type[PaceDCMotor] | None = None
    """The actuator class to build; ``None`` means :class:`PaceDCMotor`. Set it to your own subclass."""

    joint_names_expr: str | Sequence[str]
    """Regular expressions of the joints in this group."""

    stiffness: JointValue | None = None
    """Position gain kp [N m/rad]; ``None`` takes what the constructor is given."""

    damping: JointValue | None = None
    """Velocity gain kd [N m s/rad]; ``None`` takes what the constructor is given."""

    saturation_effort: JointValue | None = None
    """Stall torque of the torque-speed curve [N m]; ``None`` means torque does not depend on speed."""

    effort_limit: JointValue | None = None
    """Continuous torque limit [N m]; ``None`` takes what the constructor is given (default: no limit)."""

    velocity_limit: JointValue | None = None
    """No-load speed of the torque-speed curve [rad/s]; ``None`` takes what the constructor is given."""

    armature: JointValue | None = None
    """Rotor inertia seen at the joint [kg m^2]. Applied by the simulator, not by the actuator."""

    friction: JointValue | None = None
    """Coulomb friction [N m]. Applied by the simulator, not by the actuator."""

    viscous_friction: JointValue | None = None
    """Viscous friction [N m s/rad]. Applied by the simulator, not by the actuator."""

    encoder_bias: JointValue = 0.0
    """Encoder bias [rad]: the encoder shows q_enc = q - bias."""

    delay: float = 0.0
    """Delay of every environment at the start [control steps], from 0 to ``max_delay``."""

    delay_s: float | None = None
    """Delay [s] in place of ``delay``: the drive converts it to its own control steps, and raises ``max_delay``."""

    max_delay: float = 10.0
    """Largest delay that can be set later [control steps]."""

    delay_mode: DelayMode = "command"
    """What is delayed: ``"command"`` (targets and feed-forward) or ``"effort"`` (the controller's torque)."""

    delay_interpolation: Literal["linear", "hold"] = "linear"
    """Between samples: ``"linear"``, or ``"hold"`` for whole steps only."""

    control_decimation: int = 1
    """Calls of ``compute`` (physics steps) per control step; commands are held in between, and so is the controller's
    torque unless ``drive_dt`` or ``implicit`` says otherwise."""

    drive_dt: float | None = None
    """Time between two runs of the drive's own controller [s], at least a physics step: commands come once per control
    step and are held. Where it does not divide the control step, the controller runs on a clock of its own. ``None``
    runs it once per control step."""

    implicit: bool = False
    """Whether the controller runs continuously, as that of a position actuator in a model file: at every physics step,
    and its damping (and the stiffness behind it) acts on the motion within the step. Other loops hold their torque."""

    centred_commands: bool = False
    """Whether a delay of commands is the drive's alone. Simulators that update speeds before positions (semi-implicit
    Euler: MuJoCo's, PhysX') let what is held over a step act half a step early; PACE's identified delay makes up for
    it, and is longer than the drive's by half a physics step. ``True`` takes that half step out of the commands, so
    that it does not go into the delay; feedback stays as it is."""

    effects: Sequence[EffectCfg | str] = ()
    """Physical effects beyond this base model, by name (``"stribeck_friction"``) or with their values."""

    physics_dt: float | None = None
    """Time between two calls of ``compute`` [s]; effects need it, an environment gives its own."""

    identified: IdentifiedAt | None = None
    """Time steps of the identification that the values come from: the drive warns where its own are too different."""

    def on_joints(self, joint_names: Sequence[str], chosen: Sequence[str]) -> PaceDCMotorCfg | None:
        """The same for some of the joints of its group, without effects; ``None`` if it moves none of them.

        Args:
            joint_names: All joints of the robot, in order.
            chosen: Those wanted.
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
