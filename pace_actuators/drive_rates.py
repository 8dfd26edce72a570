"""How often a drive's controller runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pace_actuators.pace_dc_motor_cfg import PaceDCMotorCfg


def calls_per_run(cfg: PaceDCMotorCfg, physics_dt: float | None) -> int | None:
    """Calls of a drive (physics steps) from one run of its controller to the next.

    Args:
        cfg: The drive.
        physics_dt: Time between two of its calls [s].

    Returns:
        The calls; ``None`` where runs do not fall on the same calls of every control step: the drive then keeps a clock
        of its own.

    Raises:
        ValueError: If its own rate is higher than that of the physics, or that of the physics is not known.
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
    if not cfg.drive_dt > physics_dt * (1 - 1e-6):
        raise ValueError(
            f"drive_dt is {cfg.drive_dt:g} s and the physics step {physics_dt:g} s: expected at least a physics step "
            f"in drive_dt. Make the physics step finer (--physics_dt {cfg.drive_dt:g} where a command has it, else "
            "sim.dt), or change drive_dt."
        )
    calls = round(cfg.drive_dt / physics_dt)
    fits = abs(calls * physics_dt - cfg.drive_dt) < 1e-9 and cfg.control_decimation % calls == 0
    return calls if fits else None
