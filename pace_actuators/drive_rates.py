"""How often a drive's controller runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pace_actuators.pace_dc_motor_cfg import PaceDCMotorCfg


def calls_per_run(cfg: PaceDCMotorCfg, physics_dt: float | None) -> int:
    """Calls of a drive (physics steps) from one run of its controller to the next.

    Args:
        cfg: The drive.
        physics_dt: Time between two of its calls [s].

    Raises:
        ValueError: If its own rate does not fit the physics step or the control step.
    """
    if cfg.implicit:
        return 1
    if cfg.drive_dt is None:
        return cfg.control_decimation
    if physics_dt is None:
        raise ValueError(
            f"The drive has a rate of its own (drive_dt = {cfg.drive_dt:g} s), and the time between two calls is not "
            "known: set physics_dt [s] in the actuator's configuration."
        )
    calls = round(cfg.drive_dt / physics_dt) if cfg.drive_dt > 0 else 0
    if calls < 1 or abs(calls * physics_dt - cfg.drive_dt) > 1e-9:
        raise ValueError(
            f"drive_dt is {cfg.drive_dt:g} s and the physics step {physics_dt:g} s: expected a whole number of physics "
            f"steps in drive_dt. Make the physics step finer (--physics_dt {cfg.drive_dt:g} where a command has it, "
            "else sim.dt), or change drive_dt."
        )
    if cfg.control_decimation % calls:
        raise ValueError(
            f"drive_dt is {cfg.drive_dt:g} s and the control step {cfg.control_decimation * physics_dt:g} s: expected "
            "a whole number of runs of the controller in a control step. Change drive_dt, or control_decimation."
        )
    return calls
