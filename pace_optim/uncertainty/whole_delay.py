"""A delay of whole control steps, beside drives that take commands over only when their loops run."""

from __future__ import annotations

from pace_optim.problem.problem import Problem

_NEAR = 0.05
"""So near to a whole number of control steps a delay is one."""
_SURE = 3.0
"""Standard deviations."""


def whole_delay(problem: Problem, delay: float, std: float | None) -> list[str]:
    """What other delays would look the same, in a sentence; nothing where the recordings tell.

    Commands that come on their own clock, at instants at which the loop runs too, are taken over late by a whole number
    of its steps, whatever their delay.

    Args:
        problem: What was fitted.
        delay: As found [control steps].
        std: Its standard deviation [control steps].
    """
    drives = problem.env_cfg.scene.robot.actuators.values()
    held = all(not drive.implicit and drive.drive_dt in (None, problem.control_dt) for drive in drives)
    own_clock = any(problem.dataset.recordings[r].des_time is not None for r in problem.dataset.trained())
    near = max(_NEAR, _SURE * (std or 0.0))
    if not (held and own_clock and problem.delay_mode == "command" and round(delay) >= 1):
        return []
    if abs(delay - round(delay)) > near or near > 0.5:
        return []
    step = 1e3 * problem.control_dt
    return [
        f"The delay is a whole number of control steps. A drive that takes commands over only when its loop "
        f"runs, every {step:g} ms, acts so late for every delay above {(round(delay) - 1) * step:g} and up to "
        f"{round(delay) * step:g} ms of commands that are sent in time with it."
    ]
