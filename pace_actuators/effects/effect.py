"""What a physical effect is: its parameters, where it acts on the drive's path, and its state."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch

from pace_actuators.delay_buffer import DelayBuffer
from pace_actuators.joint_units import JOINT_TYPES, JointType
from pace_actuators.part import Part

if TYPE_CHECKING:
    from pace_actuators.effects.drive_state import DriveState

_WIDER = 4.0

Heat = Callable[[torch.Tensor, slice], torch.Tensor]
"""By time constants T [s], (rows, num_joints), of environments ``rows``: h of T dh/dt + h = τ² when a recording begins,
τ the torque that was asked in its session before [N² m²]."""
Conditions = Callable[[str, int, slice], "tuple[torch.Tensor, torch.Tensor] | None"]
"""By the name of what is logged (``temperature``, ``voltage``), a number of places, and environments ``rows``: when the
first place was and how long it is to the next [s], (rows, 1, 2), and the values at the places, (rows, num_joints,
places); ``None`` if it is not logged."""
Stage = Literal["command", "measurement", "controller", "drive", "friction", "transmission", "model", "recording"]


@dataclass(frozen=True, kw_only=True)
class EffectParameter:
    """One number of an effect, per joint."""

    name: str
    """Its name; results call it ``<effect>.<name>``."""

    unit: str
    """Its unit, ``"1"`` if it has none."""

    lower: float
    """Lower bound of its identification."""

    upper: float
    """Upper bound of its identification."""

    null: float | None
    """Where the effect vanishes exactly (``inf`` for one that is off when infinitely stiff or large); ``None``: it
    shapes the effect and has no such value."""

    start: float
    """Where a search for it starts."""

    scale: Literal["linear", "log"] = "linear"
    """How the search's coordinate runs from the lower to the upper bound."""

    meaning: str = ""
    """What it is, in a few words."""

    possible: tuple[float, float] = (-math.inf, math.inf)
    """Between what physics allows it: a bound that a search runs into is widened within."""

    plausible: tuple[float, float] = (-math.inf, math.inf)
    """Between what a drive can have it: with a value beyond, a diagnosis does not name the effect."""

    is_position: bool = False
    """Whether it is a position of the joint, which is sought in all of the joint's range."""

    follows_drive: bool = False
    """Whether it is a torque whose bounds are the largest that the joint's drive gives, where that is known."""

    follows_loop: bool = False
    """Whether its bounds, start and probes are those of a loop of ``PROBED_STIFFNESS``, and grow with the stiffness of
    the joint's loop: what yields in a transmission has the size of its drive."""

    def is_plausible(self, value: Any) -> Any:
        """Whether a drive can have it, element by element of a tensor."""
        least, most = self.plausible
        return (value >= least) & (value <= most)

    def on_loop(self, stiffness: float) -> EffectParameter:
        """The parameter on a joint with a position loop of a stiffness kp [N m/rad].

        Bounds and start of one that ``follows_loop`` are multiplied by kp / ``PROBED_STIFFNESS``.
        """
        if not self.follows_loop:
            return self
        size = stiffness / PROBED_STIFFNESS
        return replace(self, lower=size * self.lower, upper=size * self.upper, start=size * self.start)

    def reaching(self, low: float, high: float, effort: float = math.inf) -> tuple[float, float]:
        """Its bounds: of a position of the joint as far as its range too, of a torque as far as the drive goes.

        Args:
            low: Lower end of the joint's range [rad].
            high: Upper end of it [rad].
            effort: The largest torque of its drive [N m]; infinite where it is not known.
        """
        if self.follows_drive and math.isfinite(effort):
            return -effort, effort
        return (min(self.lower, low), max(self.upper, high)) if self.is_position else (self.lower, self.upper)

    def widest(self, friction: float = 0.0) -> tuple[float, float]:
        """Its bounds four times as far from the null, or on a logarithmic scale from each other; the null stays one.

        Torques, and torques per angle or speed, have them at least four times as far as the joint's own friction is
        sought: drives differ in size.

        Args:
            friction: Upper bound of the joint's Coulomb friction [N m].
        """
        low, high = self.lower, self.upper
        if self.null is not None and self.scale == "log":
            low, high = low / _WIDER, high * _WIDER
        elif self.null is not None and math.isfinite(self.null):
            low, high = (self.null + _WIDER * (bound - self.null) for bound in (low, high))
            if self.unit.startswith("N m"):
                reach = _WIDER * friction
                low = min(low, self.null - reach) if low < self.null else low
                high = max(high, self.null + reach) if high > self.null else high
        least, most = self.possible
        return max(low, least), min(high, most)


class Effect(Part):
    """A physical effect on a group of joints, batched over environments.

    A subclass declares its parameters and overrides the methods of the stages where it acts; each changes the
    :class:`DriveState` in place. ``self.<parameter>`` is a tensor (rows, num_joints), as are the state's fields.

    Example::

        @register_effect
        class CableDrag(Effect):
            name = "cable_drag"
            stage = "transmission"
            parameters = (EffectParameter(name="effort", unit="N m", lower=-2, upper=2, null=0.0, start=0.1),)

            def transmission(self, s):
                s.effort -= self.effort * torch.tanh(s.joint_pos)

    Attributes:
        rows: Which environments it acts on; the others never see it.
        dt: Time between two calls of the drive (the physics step) [s].
        control_dt: Time between two runs of the controller [s], the control step unless the drive has its own.
        is_trapezoidal: Whether the simulator moves positions with the mean of the old and the new speed.
        meets_soft_friction: Whether an effect of its drive makes Coulomb friction soft (``s.friction_time``).
        new_rows: Which rows have no history yet, (rows, 1) bool; on the CPU ``None`` if all have.
        buffers: Its delays, by name; a reset of rows resets them too.
    """

    name: ClassVar[str]
    """Its public name."""
    stage: ClassVar[Stage]
    """Where on the drive's path it acts."""
    parameters: ClassVar[tuple[EffectParameter, ...]]
    """Its numbers."""
    joint_types: ClassVar[tuple[JointType, ...]] = JOINT_TYPES
    """Joints on which it means something: ``"hinge"``, ``"slide"`` or both. It is not tried on others."""
    equation: ClassVar[str] = ""
    """Its equation, as text."""
    part: ClassVar[str] = ""
    """The part of the robot to check where it is found."""
    looks: ClassVar[str] = ""
    """What a person would see in the data."""
    remark: ClassVar[str] = ""
    """What a diagnosis that finds it says beside its name."""
    source: ClassVar[str] = ""
    """Where the equation comes from."""
    memory: ClassVar[Collection[str]] = ()
    """What it keeps from step to step: names of attributes (rows, num_joints), which begin with zero, or in a dict with
    the value that they begin with. A step assigns new tensors to them."""
    probes: ClassVar[tuple[Mapping[str, float], ...]] = ()
    """Small values at which a screening looks at it; parameters left out are at their start."""
    structural: ClassVar[str] = ""
    """Parameter whose every probed value starts a separate fit: no descent leads from one value to another."""
    comb: ClassVar[tuple[str, str, str] | None] = None
    """A frequency over the position [1/rev], and the amplitudes of its sine and cosine: the frequency is scanned over
    the range of motion, where the error has a valley for each of its periods."""
    two_sided: ClassVar[bool] = True
    """Whether it can also act with the opposite sign of its probes."""
    shared: ClassVar[bool] = False
    """Whether it is one for the whole robot by its nature."""
    is_stiff: ClassVar[bool] = False
    """Whether it has fast internal dynamics, so that the simulation must be implicit."""
    parts_motor_and_link: ClassVar[bool] = False
    """Whether motor and link move apart: friction then acts on the motor, other torques on the link."""
    reads_load: ClassVar[bool] = False
    """Whether it reads ``s.load_effort``: without it that is not computed."""
    reads_link: ClassVar[bool] = False
    """Whether it reads the link's inertia and what else of it the state has: without it they are not computed."""
    changes_armature: ClassVar[bool] = False
    """Whether it changes ``s.armature`` from step to step."""
    smooths_friction: ClassVar[bool] = False
    """Whether it only smooths Coulomb friction at standstill, as simulators do: a little of it alone is nothing
    missing."""
    free_form: ClassVar[bool] = False
    """Whether it is a curve of any form: it says what is missing and not why, and no diagnosis looks for it."""
    twins: ClassVar[tuple[str, ...]] = ()
    """Effects that act alike by construction with one load, one gain and no absolute reference."""
    needs_loads: ClassVar[bool] = False
    """Whether it only shows where loads differ: there it is tried whatever a screening says."""
    acts_while_off: ClassVar[bool] = False
    """Whether it acts only while the drive is switched off: it is tried only where a recording has that."""
    condition: ClassVar[str] = ""
    """The drive's condition that it follows, ``temperature`` or ``voltage``. It is tried only if that was logged and
    changes."""
    absorbed_by: ClassVar[str] = ""
    """Base parameter that may take it up wholly, so that recordings of positions do not show it."""
    scales: ClassVar[str] = ""
    """The stated fact that it multiplies, such as "torque": its size is then printed as a factor of that."""
    separates: ClassVar[str] = ""
    """Which further recording separates it from similar effects."""

    def __init__(
        self,
        num_envs: int,
        num_joints: int,
        *,
        dt: float,
        control_dt: float,
        delay_mode: str = "command",
        rows: slice = slice(None),
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
    ):
        """Start at the null values.

        Args:
            num_envs: Number of environments of the drive.
            num_joints: Number of joints of the drive.
            dt: Time between two calls [s].
            control_dt: Time between two runs of the controller [s].
            delay_mode: What the drive's own delay delays.
            rows: Which environments it acts on.
            dtype: Type of all tensors.
        """
        self.rows = rows
        self.shape = (len(range(*rows.indices(num_envs))), num_joints)
        self.dt, self.control_dt, self.delay_mode = dt, control_dt, delay_mode
        self.is_trapezoidal, self.meets_soft_friction = False, False
        self._options: dict[str, Any] = {"device": torch.device(device), "dtype": dtype}
        self._on_device = torch.device(device).type == "cuda"
        self.new_rows: torch.Tensor | None = ~self._no_rows()
        self.buffers: dict[str, DelayBuffer] = {}
        for parameter in self.parameters:
            value = parameter.start if parameter.null is None else parameter.null
            setattr(self, parameter.name, self.full(value))
        for name in self.memory:
            setattr(self, name, self.full(self.memory[name] if isinstance(self.memory, Mapping) else 0.0))
        self.prepare()

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> torch.Tensor:
            """Parameters are attributes, (rows, num_joints) each: a class need not declare them again."""

    # ---- what a subclass overrides -------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Compute what follows from the parameters; called after each change of them."""

    def reset_state(self, rows: torch.Tensor | slice) -> None:
        """Forget the history of some of its rows, (rows,) bool or a slice: :meth:`take_new_rows` then returns them."""
        if self.new_rows is None:
            self.new_rows = self._no_rows()
        self.new_rows[rows] = True
        for buffer in self.buffers.values():
            buffer.reset(rows)

    def remember(self, heat: Heat) -> None:
        """When a recording begins: take over what the drive did in its session before. Training begins without."""

    def notice(self, conditions: Conditions) -> None:
        """When a recording begins: take over what was logged of the drive's conditions."""

    def advance(self, s: DriveState) -> None:
        """Once per physics step, before all else: bring the own state to the present joint state."""

    def hold(self, s: DriveState) -> None:
        """Where encoders are held, after ``advance``: change ``s.held_pos`` and ``s.held_vel`` to the joint's."""

    def command(self, s: DriveState) -> None:
        """Once per run of the controller, before the command's delay: change ``s.joint_pos_target``."""

    def measurement(self, s: DriveState) -> None:
        """Whenever the encoder is read: change ``s.encoder_pos`` (before the bias)."""

    def sensed_velocity(self, s: DriveState) -> None:
        """Once per run of the controller: change ``s.encoder_vel``, the speed that the controller sees."""

    def controller(self, s: DriveState) -> None:
        """Once per run of the controller: change ``s.stiffness`` and ``s.damping``."""

    def controller_effort(self, s: DriveState) -> None:
        """Once per run of the controller, after the PD law and before delays: change ``s.effort``."""

    def effort_command(self, s: DriveState) -> None:
        """Once per physics step, after the controller and its delay: change ``s.effort``."""

    def feedback(self, s: DriveState) -> None:
        """Once per physics step, before the limits: let ``s.effort`` follow the motion since the controller ran.

        ``s.speed_slope`` is how fast it falls with the speed within the step. Not called where the controller runs
        continuously, or its torque is delayed.
        """

    def current_limit(self, s: DriveState) -> None:
        """Once per physics step, where the drive limits what is asked of it: change ``s.effort``."""

    def current_loop(self, s: DriveState) -> None:
        """Once per physics step, after that limit: how the current follows; change ``s.effort``."""

    def drive(self, s: DriveState) -> None:
        """Once per physics step, after the current loop: what torque comes of it; change ``s.effort``."""

    def torque_speed(self, s: DriveState) -> None:
        """Once per physics step, before the torque-speed line: what the supply leaves; change ``s.effort``."""

    def friction(self, s: DriveState) -> None:
        """Once per physics step: change ``s.friction`` (level of Coulomb friction) and ``s.viscous_friction``."""

    def transmission(self, s: DriveState) -> None:
        """Once per physics step, last: change ``s.effort``, or what the simulator is to apply itself."""

    def armature(self, s: DriveState) -> None:
        """After each change of parameters: change ``s.armature``, the rotor inertia that the simulator carries."""

    def constraint(self, s: DriveState) -> None:
        """After each change of parameters: change ``s.friction_time``, how soft the simulator's Coulomb friction is."""

    def write_model(self, model: Any, joint: int) -> None:
        """After each change of parameters: change the rigid body that a joint moves (see ``LinkModel``)."""

    def observation_lag(self, time: torch.Tensor) -> torch.Tensor | None:
        """How much later than its time stamp a sample of the recording was taken [s], (rows, num_joints)."""
        return None

    # ---- what a subclass uses ------------------------------------------------------------------------------------

    def take_new_rows(self) -> torch.Tensor | None:
        """Which rows have no history yet, (rows, 1) bool, or ``None``: all at first, and those of a reset.

        It says so once; the effect lets their history begin, most often by :meth:`begin`.
        """
        if self.new_rows is None or not self._on_device:
            new, self.new_rows = self.new_rows, None
            return new
        new = self.new_rows.clone()  # a CUDA graph repeats it, with new rows or without
        self.new_rows.fill_(False)
        return new

    def begin(self, **values: torch.Tensor | float) -> None:
        """Let the history of rows that have none begin with these values, by the names of its memory."""
        new = self.take_new_rows()
        if new is not None:
            for name, value in values.items():
                setattr(self, name, torch.where(new, value, getattr(self, name)))

    def full(self, value: float) -> torch.Tensor:
        """A tensor of its shape (rows, num_joints)."""
        return torch.full(self.shape, value, **self._options)

    def zeros(self) -> torch.Tensor:
        """Zeros of its shape (rows, num_joints)."""
        return self.full(0.0)

    def _no_rows(self) -> torch.Tensor:
        return torch.zeros(self.shape[0], 1, dtype=torch.bool, device=self._options["device"])

    # ---- what the drive calls ------------------------------------------------------------------------------------

    def kept(self) -> Collection[str]:
        """What it keeps from call to call."""
        return (*self.memory, "new_rows")

    def set_parameter(self, name: str, values: torch.Tensor | float, joints: torch.Tensor | None = None) -> None:
        """Set a parameter on all joints or some, by index; call :meth:`prepare` after the last one.

        Raises:
            ValueError: If there is no such parameter.
        """
        if name not in {parameter.name for parameter in self.parameters}:
            known = ", ".join(parameter.name for parameter in self.parameters)
            raise ValueError(f"The effect {self.name!r} has no parameter {name!r}. Available: {known}.")
        tensor = getattr(self, name)
        values = torch.as_tensor(values, **self._options)
        if joints is None:
            tensor[:] = values
        else:
            tensor.index_copy_(1, joints, values.expand(len(tensor), len(joints)))

    @classmethod
    def overrides(cls, method: str) -> bool:
        """Whether the class overrides the method of a stage."""
        return getattr(cls, method) is not getattr(Effect, method)

    @classmethod
    def check(cls) -> None:
        """Check the declaration.

        Raises:
            ValueError: If something is missing or contradictory.
        """
        for attribute in ("name", "stage", "parameters"):
            if not getattr(cls, attribute, None):
                raise ValueError(f"The effect {cls.__name__} has no {attribute}. Declare it in the class.")
        for p in cls.parameters:
            place = f"The parameter {p.name!r} of the effect {cls.name!r}"
            if not p.name.isidentifier() or hasattr(Effect, p.name):
                raise ValueError(f"{place} needs another name: a new Python identifier.")
            if not (math.isfinite(p.lower) and math.isfinite(p.upper) and p.lower < p.upper):
                raise ValueError(f"{place} has the bounds ({p.lower}, {p.upper}), expected finite, lower < upper.")
            if p.scale == "log" and p.lower <= 0:
                raise ValueError(f"{place} has a logarithmic scale and the lower bound {p.lower}, expected > 0.")
            if not p.lower <= p.start <= p.upper:
                raise ValueError(f"{place} starts at {p.start}, expected a value inside ({p.lower}, {p.upper}).")
        if all(p.null is None for p in cls.parameters):
            raise ValueError(f"The effect {cls.name!r} has no parameter with a null value: it cannot be switched off.")
        for probe in cls.probes:
            unknown = sorted(set(probe) - {p.name for p in cls.parameters})
            if unknown:
                raise ValueError(f"A probe of the effect {cls.name!r} names {unknown[0]!r}, which is no parameter.")


def comb_grid(effect: type[Effect], span: float) -> torch.Tensor:
    """Frequencies of an effect with a comb, (points,) [1/rev]: from one period in the span of motion [rad], every half.

    What has less than a period there is a spring or an offset to the recording.
    """
    if effect.comb is None:
        raise ValueError(f"The effect {effect.name!r} has no frequency to scan.")
    own = next(p for p in effect.parameters if p.name == effect.comb[0])
    step = math.pi / max(span, 1e-3)
    return torch.arange(min(max(own.lower, 2 * step), own.upper - step), own.upper, step, dtype=torch.float64)


PROBED_STIFFNESS = 85.0
"""Stiffness of the position loops that bounds, starts and probes are meant for which follow the loop [N m/rad]."""

PROBED_EFFORT = 5.0
"""Torque of the drives that probes in N m are meant for [N m]; on smaller drives they are taken smaller."""


def probe_points(effect: type[Effect]) -> list[dict[str, float]]:
    """The complete parameter values at which a screening looks at an effect."""
    start = {parameter.name: parameter.start for parameter in effect.parameters}
    return [{**start, **probe} for probe in effect.probes or ({},)]


def off(value: torch.Tensor) -> torch.Tensor:
    """Where a parameter whose null is infinite is at it."""
    return torch.isinf(value)
