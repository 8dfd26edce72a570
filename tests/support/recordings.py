"""Small recordings for tests, and how to put them into files and onto the grid."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from pace_optim.recording import Recording, conform_recording

JOINTS = ("hip", "knee", "ankle")
CONTROL_DT = 0.0025


def position(time, joints=3):
    """A smooth motion, different for every joint."""
    return np.stack([0.5 * np.sin(2 * np.pi * (1.0 + j) * time + j) for j in range(joints)], axis=1)


def recording(time=None, **changes) -> Recording:
    time = CONTROL_DT * np.arange(400) if time is None else time
    base = Recording(
        name="leg",
        joint_names=JOINTS,
        time=time,
        dof_pos=position(time),
        des_dof_pos=position(time + 0.01),
    )
    return replace(base, **changes)


def fields_of(**changes) -> dict:
    time = CONTROL_DT * np.arange(100)
    fine = {
        "time": time,
        "dof_pos": position(time),
        "des_dof_pos": position(time),
        "joint_names": list(JOINTS),
    }
    return {key: value for key, value in {**fine, **changes}.items() if value is not None}


def written(tmp_path, **changes) -> Path:
    """A .pt file with the given fields changed (None: left out)."""
    path = tmp_path / "leg.pt"
    tensors = {k: torch.from_numpy(v) if isinstance(v, np.ndarray) else v for k, v in fields_of(**changes).items()}
    torch.save(tensors, path)
    return path


def says(*words):
    """A pattern that finds all the words, in any order, in a message without line breaks."""
    return r"(?s)\A(?!.*\n)" + "".join(f"(?=.*{re.escape(word)})" for word in words)


def conform(rec, joint_order=JOINTS, control_dt=CONTROL_DT, **kwargs):
    return conform_recording(rec, joint_order=joint_order, control_dt=control_dt, **kwargs)
