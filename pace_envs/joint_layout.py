"""Where a robot's joints are in MuJoCo's arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import mujoco
import torch


@dataclass(frozen=True, kw_only=True, eq=False)
class JointLayout:
    """The joints that can have drives, in the robot's order."""

    joint_names: tuple[str, ...]
    """Their names."""
    qpos_columns: torch.Tensor
    """Column of each joint in ``qpos``, (num_joints,)."""
    dof_columns: torch.Tensor
    """Column of each joint in ``qvel`` and all that belongs to degrees of freedom, (num_joints,)."""
    root: tuple[int, int] | None
    """First columns of a floating base in ``qpos`` and ``qvel``; ``None`` for a fixed one."""
    passive_names: tuple[str, ...] = ()
    """Hinge and slide joints of the model that are not among them: they move as their loads and loops do."""
    passive_columns: torch.Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.long))
    """Column of each passive joint in ``qpos``."""

    @classmethod
    def of_model(
        cls,
        model: mujoco.MjModel,
        joint_order: Sequence[str] | None,
        path: str | Path,
        device: torch.device | str = "cpu",
    ) -> JointLayout:
        """Find the joints in a model.

        Args:
            model: The model.
            joint_order: Their order; ``None`` means the model's.
            path: The model's file, for messages.
            device: Device of the columns.

        Raises:
            ValueError: If the model has no joints to drive, or the order names unknown ones.
        """
        root, single = None, {}
        for j in range(model.njnt):
            name, kind = model.joint(j).name, mujoco.mjtJoint(int(model.jnt_type[j]))
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                root = (int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j]))
            elif kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
                single[name] = j
            elif joint_order is None or name in joint_order:
                raise ValueError(f"The joint {name!r} is a ball joint. Only hinge and slide joints have drives.")
        if not single:
            raise ValueError(f"The model {path} has no joints to drive.")
        order = joint_order or tuple(single)
        unknown = [name for name in order if name not in single]
        if unknown or len(set(order)) != len(order):
            wrong = f"names unknown joints: {', '.join(unknown)}" if unknown else "names a joint twice"
            raise ValueError(f"joint_order {wrong}. Joints of the model {path}: {', '.join(single)}.")
        ids = [single[name] for name in order]
        passive = {name: j for name, j in single.items() if name not in order}
        return cls(
            joint_names=tuple(order),
            qpos_columns=torch.tensor([int(model.jnt_qposadr[j]) for j in ids], device=device),
            dof_columns=torch.tensor([int(model.jnt_dofadr[j]) for j in ids], device=device),
            root=root,
            passive_names=tuple(passive),
            passive_columns=torch.tensor(
                [int(model.jnt_qposadr[j]) for j in passive.values()], dtype=torch.long, device=device
            ),
        )

    @cached_property
    def side_by_side(self) -> bool:
        """Whether the joints lie side by side in the model, in order: their tensors are then views of its arrays."""
        return _are_a_span(self.qpos_columns) and _are_a_span(self.dof_columns)

    @cached_property
    def qpos_view(self) -> slice:
        """Columns in ``qpos``, where the joints lie side by side."""
        return _span(self.qpos_columns)

    @cached_property
    def dof_view(self) -> slice:
        """Columns in ``qvel``, where the joints lie side by side."""
        return _span(self.dof_columns)


def _span(columns: torch.Tensor) -> slice:
    first = int(columns[0])
    return slice(first, first + len(columns))


def _are_a_span(columns: torch.Tensor) -> bool:
    view = _span(columns)
    return torch.equal(columns.cpu(), torch.arange(view.start, view.stop))
