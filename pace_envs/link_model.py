"""Changing the rigid body that a joint moves, per simulation: for effects on the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from pace_envs.simulation import Simulation

_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat")


class LinkModel:
    """The links of a robot as they were when this was made; changes are relative to that."""

    def __init__(self, sim: Simulation, joint_names: Sequence[str], added_mass: torch.Tensor):
        """Remember the links.

        Args:
            sim: The simulation; loads have been written to it already.
            joint_names: The joints, in the order of the articulation.
            added_mass: What was added to bodies as a known load, (num_envs, nbody) [kg]: it is not scaled.
        """
        self.added_mass = added_mass.clone()
        self.sim = sim
        self._original = {field: sim.expand(field).clone() for field in _FIELDS}
        model = sim.model
        self._joints = [model.joint(name) for name in joint_names]
        self._bodies = [int(joint.bodyid[0]) for joint in self._joints]
        self._welded = [[b for b in range(model.nbody) if int(model.body_weldid[b]) == body] for body in self._bodies]

    def of(self, rows: slice, joint: int) -> Link:
        """The link that a joint moves, in some simulations."""
        return Link(model=self, rows=rows, joint=joint)

    def axis(self, joint: int) -> np.ndarray:
        """The joint's axis in its body's frame, (3,)."""
        return np.asarray(self._joints[joint].axis)

    def anchor(self, joint: int) -> np.ndarray:
        """The joint's position in its body's frame, (3,) [m]."""
        return np.asarray(self._joints[joint].pos)

    def body(self, joint: int) -> int:
        """The joint's body."""
        return self._bodies[joint]

    def bodies(self, joint: int) -> list[int]:
        """The joint's body and all that are fixed to it."""
        return self._welded[joint]

    def fixed_children(self, joint: int) -> list[int]:
        """Bodies fixed to the joint's body directly."""
        body = self._bodies[joint]
        return [b for b in self._welded[joint] if b != body and int(self.sim.model.body_parentid[b]) == body]

    def original(self, field: str, rows: slice, body: int) -> torch.Tensor:
        """A body's field as it was, (rows, …)."""
        return self._original[field][rows, body]


@dataclass(frozen=True, kw_only=True)
class Link:
    """One joint's link in some simulations (the ``LinkModel`` of ``pace_actuators.effects.model``)."""

    model: LinkModel
    rows: slice
    joint: int

    def scale_mass(self, factor: torch.Tensor) -> None:
        """Multiply mass and inertia of the link, and of all that is fixed to it, by (rows,)."""
        for body in self.model.bodies(self.joint):
            whole = self.model.original("body_mass", self.rows, body)
            added = self.model.added_mass[self.rows, body]
            scaled = torch.where(factor == 1, whole, (whole - added) * factor + added)
            self._write("body_mass", body, scaled)
            self._write("body_inertia", body, self.model.original("body_inertia", self.rows, body) * factor[:, None])

    def rotate_mass(self, angle: torch.Tensor) -> None:
        """Turn the mass of the link, and of all that is fixed to it, about the joint's axis by (rows,) [rad]."""
        axis = self.model.sim.tensor(self.model.axis(self.joint))
        anchor = self.model.sim.tensor(self.model.anchor(self.joint))
        turn = _quaternion(axis, angle)
        own = (self.model.body(self.joint), "body_ipos", "body_iquat")
        for body, place, pose in [own, *((b, "body_pos", "body_quat") for b in self.model.fixed_children(self.joint))]:
            position = self.model.original(place, self.rows, body)
            turned = anchor + _rotate(turn, position - anchor)
            unchanged = (angle == 0)[:, None]
            self._write(place, body, torch.where(unchanged, position, turned))
            orientation = self.model.original(pose, self.rows, body)
            self._write(pose, body, torch.where(unchanged, orientation, _multiply(turn, orientation)))

    def _write(self, field: str, body: int, value: torch.Tensor) -> None:
        self.model.sim.expand(field)[self.rows, body] = value


def _quaternion(axis: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    half = 0.5 * angle
    return torch.cat([torch.cos(half)[:, None], torch.sin(half)[:, None] * axis], dim=1)


def _multiply(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    aw, av, bw, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    w = aw * bw - (av * bv).sum(dim=1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av, bv.expand_as(av))], dim=1)


def _rotate(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    w, u = q[:, :1], q[:, 1:]
    t = 2 * torch.linalg.cross(u, v.expand_as(u))
    return v + w * t + torch.linalg.cross(u, t)
