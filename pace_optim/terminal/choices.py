"""What may stand behind the options of a command line; nothing is imported here, so that a command begins at once."""

OPTIMIZERS = ("hybrid", "least_squares", "cmaes")
"""How a fit looks for the parameters."""
DELAY_MODES = ("command", "effort")
"""What a drive's delay delays."""
RESIDUALS = ("position", "effort")
"""What a fit follows."""
UNKNOWN_FACTS = {
    "stiffness": "proportional_gain",
    "damping": "derivative_gain",
    "effort_limit": "torque_limit",
    "saturation_effort": "torque_speed_limit",
    "velocity_limit": "torque_speed_limit",
}
"""Fact (field of a drive's configuration) -> the effect whose parameter finds it: gains as factors of what is stated,
limits themselves."""
MEASURED_FACTS = {**UNKNOWN_FACTS, "torque": "torque_gain", "load": "payload"}
"""Fact that a user can have measured -> the effect that would contradict it."""
