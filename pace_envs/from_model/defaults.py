"""What a model file cannot say, by name: each value that is assumed in its place."""

CONTROL_DT = 0.0025
"""Time between two commands [s]: 400 Hz, PACE's rate."""

SHORTEST_CONTROL_DT = 0.0005
"""Of a log with faster commands [s]: no bus of a robot's joints is faster than 2 kHz by much."""

LONGEST_DELAY = 0.05
"""Upper bound of the delay [s]."""

LARGEST_BIAS = 0.1
"""Bound of the encoder bias of a hinge [rad]."""

LARGEST_SLIDE_BIAS = 0.01
"""Bound of the encoder bias of a slide [m]."""

ERROR_AT_LIMIT = 1.0
"""Where the file has no gains: kp asks for the effort limit at this error [rad] (a slide: a tenth of it [m])."""

NATURAL_FREQUENCY = 4.0
"""Where the file has no gains: the joint's own inertia swings on kp with at least this frequency [Hz]."""

DAMPING_RATIO = 0.7
"""Where the file has no gains: damping of the joint's own inertia on that stiffness."""

USUAL_SPEED = 10.0
"""Highest speed [rad/s] (a slide: a tenth of it [m/s]) that scales viscous friction; the file's where it is lower."""

SMALLEST_SHARE = 1 / 30
"""Where the file has no effort limit: a drive is at least this part of the robot's strongest one."""

LARGEST_AMPLITUDE = 0.5
"""Largest amplitude of the excitation [rad] (a slide: a tenth of it [m])."""

TOP_FREQUENCY = 10.0
"""The excitation's amplitude is safe up to this frequency [Hz]."""

_PHYSICS_STEPS, _FINEST_STEP = 4, 0.0005
"""Physics steps in a control step, and the least time of one [s]."""


def physics_steps(control_dt: float) -> int:
    """Physics steps in a control step [s] of a fit: what is left of their error is below an encoder's noise."""
    return max(1, min(_PHYSICS_STEPS, round(control_dt / _FINEST_STEP)))
