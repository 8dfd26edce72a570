"""The base parameters of a drive, in the order of every vector: names, units, least values, and what carries them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class BaseParameter:
    """One parameter that every drive has, beside those of its effects."""

    name: str
    """Its name in configurations and results."""

    unit: str
    """Of a hinge; :func:`~pace_actuators.joint_units.units_for` gives that of a slide."""

    shared: bool = False
    """Whether the whole robot has one value."""

    least: float | None = 0.0
    """Smallest value that exists; ``None``: any."""

    mujoco: str | None = None
    """Attribute of MuJoCo's joint that carries it (``dof_<attribute>`` in a model); ``None``: the drive carries it."""


BASE_PARAMETERS: dict[str, BaseParameter] = {
    parameter.name: parameter
    for parameter in (
        BaseParameter(name="armature", unit="kg m^2", mujoco="armature"),
        BaseParameter(name="viscous_friction", unit="N m s/rad", mujoco="damping"),
        BaseParameter(name="friction", unit="N m", mujoco="frictionloss"),
        BaseParameter(name="encoder_bias", unit="rad", least=None),
        BaseParameter(name="delay", unit="control steps", shared=True),
    )
}
"""All of them by name. Vectors and PACE's tensors have this order: append, never insert. One without ``mujoco`` needs a
writer in ``pace_envs.articulation``."""

PER_JOINT = tuple(name for name, parameter in BASE_PARAMETERS.items() if not parameter.shared)
"""Those that every joint has."""

CARRIED = tuple(name for name, parameter in BASE_PARAMETERS.items() if parameter.mujoco is not None)
"""Those that the simulator's joint carries: inertia and friction."""
