"""How hard the drives of recordings work: the scale of a drive's curves, and what an effect of heat begins with."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from pace_envs import ManagerBasedRLEnv
from pace_optim.problem.bounds_of_logs import asked_torque
from pace_optim.problem.drive_steps import of_joints
from pace_optim.recording import Recording
from pace_optim.recording.dataset import Dataset, Work

_BIN = 0.25
"""Over so much time the square of a torque is averaged [s]."""
_BEYOND = 2.0
"""How many times the largest torque that was asked a drive may give that states no limit."""


def drive_reach(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> dict[str, float]:
    """The largest torque of each joint's drive [N m]: its limit, else twice what was asked; infinite: not known."""
    limit = np.max([_limit(env, recording) for recording in recordings], axis=0)
    asked = np.max([np.abs(_asked(env, recording)).max(axis=0) for recording in recordings], axis=0)
    largest = np.where(np.isfinite(limit), limit, np.where(asked > 0, _BEYOND * asked, math.inf))
    return dict(zip(env.scene["robot"].joint_names, largest.tolist(), strict=True))


def loop_stiffness(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> dict[str, float]:
    """The stiffness of each joint's position loop [N m/rad], the median of the recordings' where it has one."""
    stated = [each.drive.stiffness for each in recordings]
    own = of_joints(env, "stiffness")
    median = np.median([own if each is None else each for each in stated], axis=0)
    names = env.scene["robot"].joint_names
    return {name: each for name, each in zip(names, median.tolist(), strict=True) if each > 0 and math.isfinite(each)}


def with_work(dataset: Dataset, env: ManagerBasedRLEnv) -> Dataset:
    """The dataset with how hard the drives worked, where its recordings are of one session: they do not overlap.

    Args:
        env: The environment, whose facts hold where a recording states none.
    """
    begins, ends, squares = [], [], []
    for start, recording in zip(dataset.session_start.tolist(), dataset.recordings, strict=True):
        since = recording.time - recording.time[0]
        edges = np.linspace(0.0, since[-1], max(1, round(since[-1] / _BIN)) + 1)
        square = np.nan_to_num(_asked(env, recording)) ** 2
        bins = (np.searchsorted(edges, since, side="right") - 1).clip(max=len(edges) - 2)
        count = np.bincount(bins, minlength=len(edges) - 1).clip(min=1)
        squares.append([np.bincount(bins, column, len(edges) - 1) / count for column in square.T])
        begins.append(start + edges[:-1])
        ends.append(start + edges[1:])
    order = np.argsort([each[0] for each in begins])
    if any(ends[a][-1] > begins[b][0] + _BIN for a, b in itertools.pairwise(order.tolist())):
        return dataset
    begin, end, square = (torch.as_tensor(np.concatenate(each, axis=-1)) for each in (begins, ends, squares))
    return replace(dataset, work=Work(begin=begin, end=end, square=square.T))


def _asked(env: ManagerBasedRLEnv, recording: Recording) -> np.ndarray:
    """What drives were asked for, within the limit in force, (T, n) [N m]."""
    limit = _limit(env, recording)
    return np.clip(asked_torque(env, recording), -limit, limit)


def _limit(env: ManagerBasedRLEnv, recording: Recording) -> np.ndarray:
    """The limit in force, (n,) [N m]; infinite where none is stated."""
    stated = recording.drive.effort_limit
    return np.nan_to_num(of_joints(env, "effort_limit") if stated is None else stated, nan=np.inf, posinf=np.inf)
