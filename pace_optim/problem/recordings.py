"""The recordings that a command line names, on a robot's joints and control grid."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pace_optim.problem.drive_steps import of_joints
from pace_optim.recording import Recording, conform_recording
from pace_optim.recording.gaps import split_at_gaps
from pace_optim.robot_logs import ColumnMap, Robot, load_recordings, paired_files, read_map, with_rate

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv


def tell_on_stderr(text: str) -> None:
    """Tell a user something beside a command's results."""
    print(text, file=sys.stderr)


def tell_nobody(text: str) -> None:
    """Told before, by the fit whose recordings are read again."""


def read_all(
    paths: Sequence[str | Path],
    env: ManagerBasedEnv,
    control_dt: float,
    *,
    columns: str | Path | None = None,
    rate: float | None = None,
    strict: bool = False,
    tell: Callable[[str], None] = tell_on_stderr,
) -> list[Recording]:
    """Read recordings and logs, and put each on the robot's joints and control grid.

    Args:
        paths: Files and folders, each as :func:`pace_optim.robot_logs.load_recordings` takes it; two files that are the
            halves of one log (states, commands) are joined.
        env: The robot.
        control_dt: Control step [s].
        columns: Column map of the logs among them; ``None``: guessed.
        rate: Rows per second of logs that have no column of time [Hz].
        strict: Whether one that cannot be used refuses all, instead of being set aside.
        tell: Is told what was understood of logs, and what was set aside.

    Raises:
        ValueError: If none can be used, or one cannot and ``strict``.
    """
    chosen = with_rate(None if columns is None else read_map(Path(columns)), rate)
    names = paired_files([str(path) for path in paths])
    result: list[Recording] = []
    faults: list[str] = []
    for name in names:
        try:
            result += _conformed(name, env, control_dt, chosen, tell)
        except ValueError as error:
            if strict or len(names) == 1 or not Path(name).exists():
                raise
            faults.append(" ".join(str(error).split()))
    if faults and not result:
        more = f" (The other {len(faults) - 1} files cannot be used either.)" if len(faults) > 1 else ""
        raise ValueError(faults[0] + more)
    for fault in faults:
        tell(f"warning: set aside (--strict would refuse all): {fault}")
    return result


def known_robot(env: ManagerBasedEnv) -> Robot:
    """What a log is read for: joints, their limits, and the gains and torque limits that are stated."""
    robot = env.scene["robot"]
    sim2real = getattr(env.cfg, "sim2real", None)
    assumed = np.isin(robot.joint_names, list(getattr(sim2real, "assumed_gains", ())))
    return Robot(
        joint_names=tuple(robot.joint_names),
        limits=robot.data.joint_pos_limits.numpy().copy(),
        joint_types=robot.joint_types,
        stiffness=np.where(assumed, np.nan, of_joints(env, "stiffness")),  # type: ignore[arg-type]
        effort_limit=of_joints(env, "effort_limit"),  # type: ignore[arg-type]
    )


def _conformed(
    name: str, env: ManagerBasedEnv, control_dt: float, columns: ColumnMap | None, tell: Callable[[str], None]
) -> list[Recording]:
    robot, known = env.scene["robot"], known_robot(env)
    sim2real = env.cfg.sim2real  # type: ignore[attr-defined]
    return [
        conform_recording(
            recording,
            joint_order=known.joint_names,
            control_dt=control_dt,
            joint_pos_limits=known.limits,
            joint_types=robot.joint_types,
            load_bodies=robot.body_names,
            accepts_load=sim2real.apply_load is not None,
        )
        for whole in load_recordings(name, known, columns, tell)
        for recording in split_at_gaps(whole)
    ]
