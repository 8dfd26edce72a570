"""A plant of its own for drive_laws.py: one pendulum, integrated at 0.05 ms, and the laws that its drive can have.

It shares no equation with the library's simulation: semi-implicit Euler, Coulomb friction that stops a joint exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

CONTROL_DT, PLANT_DT, NOISE = 0.0025, 5e-5, 1e-4
GRAVITY = 9.81
SETTLING = 0.5
"""Time at rest before a recording begins [s]."""


@dataclass
class State:
    """What a law sees: position [rad], speed [rad/s], session time [s], torques [N m], heat [N² m²]."""

    q: float = 0.0
    v: float = 0.0
    t: float = 0.0
    gravity: float = 0.0
    heat: float = 0.0
    motor: float = 0.0
    memory: dict[str, float] = field(default_factory=dict)


def _same(value: float, s: State) -> float:
    return value


def _nothing(s: State) -> float:
    return 0.0


@dataclass(frozen=True, kw_only=True)
class Law:
    """What a drive or its joint does otherwise; what is left out does nothing."""

    target: Callable[[float, State], float] = _same
    """The target inside the drive, by the command; once per control step."""
    asked: Callable[[float, State], float] = _same
    """The torque that is asked of the motor, by that of the controller."""
    torque: Callable[[float, State], float] = _same
    """The motor's torque, by what is asked."""
    joint: Callable[[State], float] = _nothing
    """A torque on the joint [N m]."""
    friction: Callable[[float, State], float] = _same
    """The level of Coulomb friction."""
    drag: Callable[[float, State], float] = _same
    """Viscous friction."""
    inertia: Callable[[float, State], float] = _same
    """All of the joint's inertia."""
    heat_s: float = math.inf
    """Time constant of the heat, which follows the square of the motor's torque [s]."""
    temperature: Callable[[float], float] | None = None
    """What the log shows of the motor's temperature [°C], by the session time [s]."""
    voltage: Callable[[float], float] | None = None
    """What the log shows of the supply's voltage [V]."""
    speed_loop: tuple[float, float] | None = None
    """A PI loop of the speed in place of kd: gain [N m s/rad] and integral [N m/rad]; kp asks for a speed then."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One recording: its command [rad], the drive in force, and the load."""

    name: str
    command: np.ndarray
    stiffness: float
    damping: float
    load_mass: float = 1.0
    load_length: float = 0.2


Base = Mapping[str, float]


def drawn_base(rng: np.random.Generator) -> Base:
    """What every drive has; the delay in control steps."""
    return {
        "armature": rng.uniform(0.02, 0.1),
        "viscous_friction": rng.uniform(0.3, 1.5),
        "friction": rng.uniform(0.2, 1.0),
        "encoder_bias": rng.uniform(-0.03, 0.03),
        "delay": rng.uniform(0.5, 4.0),
    }


def plans(rng: np.random.Generator, duration: float, amplitude: float = 1.0) -> list[Plan]:
    """A battery: the last one validates."""
    t = np.arange(0, duration, CONTROL_DT)
    chirp = 0.3 * np.sin(2 * np.pi * (0.1 * t + 4.9 * t**2 / (2 * duration)))
    levels = np.r_[0.0, rng.uniform(-0.8, 0.8, int(duration / 0.8) + 1)]
    frequencies = np.array([0.2, 0.5, 0.9, 1.7, 2.9, 4.3])
    waves = np.sin(2 * np.pi * frequencies * t[:, None] + rng.uniform(0, 2 * np.pi, 6)) / np.sqrt(frequencies)
    multisine = waves.sum(axis=1)
    commands = {
        "chirp": (chirp, 85.0),
        "stiff": (chirp, 130.0),
        "triangle": (1.8 / np.pi * np.arcsin(np.sin(2 * np.pi * t / 4)), 85.0),
        "steps": (levels[(t / 0.8).astype(int)], 85.0),
        "staircase": (0.9 * np.sin(2 * np.pi * (t / 0.5).astype(int) / (duration / 0.5)), 85.0),
        "multisine": (0.8 * multisine / np.abs(multisine).max(), 85.0),
    }
    return [
        Plan(name=name, command=amplitude * command, stiffness=kp, damping=0.6)
        for name, (command, kp) in commands.items()
    ]


def with_loads(own: list[Plan], masses: tuple[float, ...]) -> list[Plan]:
    """The same with loads in turn."""
    return [replace(plan, load_mass=masses[i % len(masses)]) for i, plan in enumerate(own)]


def simulate(plan: Plan, base: Base, law: Law, begin: float, heat: float = 0.0) -> tuple[np.ndarray, float]:
    """Encoder positions [rad] of a recording that begins at a session time [s] with a heat, and the heat at its end."""
    s, dt = State(q=float(plan.command[0]), heat=heat), PLANT_DT
    steps = round(CONTROL_DT / dt)
    weight = plan.load_mass * plan.load_length * GRAVITY
    own = plan.load_mass * plan.load_length**2 + base["armature"]
    warms, cools = (0.0, 0.0) if math.isinf(law.heat_s) else (dt / law.heat_s, dt / law.heat_s)
    seen, command = np.empty(len(plan.command)), plan.command.tolist()
    kp, kd, bias, delay = plan.stiffness, plan.damping, base["encoder_bias"], base["delay"]
    integral, last = 0.0, -1
    for k in range(-round(SETTLING / CONTROL_DT), len(command)):
        encoder, speed = s.q - bias, s.v
        if k >= 0:
            seen[k] = encoder
        for part in range(steps):
            s.t = begin + k * CONTROL_DT + part * dt
            s.gravity = -weight * math.sin(s.q)
            arrived = max(math.floor(k + (part + 0.5) / steps - delay), 0)  # the bus holds a target until the next
            if arrived != last:
                target, last = law.target(command[arrived], s), arrived
            if law.speed_loop is None:
                tau = kp * (target - encoder) - kd * speed
            else:
                gain, rate = law.speed_loop
                missing = kp * (target - encoder) - speed
                if part == 0:
                    integral = min(max(integral + rate * missing * CONTROL_DT, -30.0), 30.0)
                tau = gain * missing + integral
            tau = min(max(law.asked(tau, s), -89.0), 89.0)
            s.heat += warms * tau * tau - cools * s.heat
            tau = s.motor = law.torque(tau, s)
            tau += s.gravity + law.joint(s) - law.drag(base["viscous_friction"], s) * s.v
            stop = dt * law.friction(base["friction"], s) / (inertia := law.inertia(own, s))
            free = s.v + dt * tau / inertia
            s.v = 0.0 if abs(free) <= stop else free - math.copysign(stop, free)
            s.q += dt * s.v
    return seen, s.heat
