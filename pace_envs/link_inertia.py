"""The inertial parameters of a link: its mass, its centre of mass and its inertia, always those of a real body.

A rigid body's ten inertial parameters are its pseudo-inertia, with Σ its second moments about the link's origin:

    J = [[Σ, m c], [m cᵀ, m]],    Σ = ½ tr(I) 1 - I

A body of positive densities has them if and only if J is positive definite (Wensing, Kim and Slotine, IEEE RA-L 3,
2018). Its log-Cholesky parameters reach all of these and nothing else (Rucker and Wensing, "Smooth parameterization of
rigid-body inertia", IEEE RA-L 7, 2022), J = U Uᵀ with U upper triangular. Here U is written about the centre of mass c
and along the principal axes A that the model file states, with k its radii of gyration σ_i = √(Σ_ii / m) there:

    Σ_c = m A L Lᵀ Aᵀ,    L = [[k₁, k₁⁰ s₁₂, k₁⁰ s₁₃], [0, k₂, k₂⁰ s₂₃], [0, 0, k₃]],    I_c = tr(Σ_c) 1 - Σ_c

Mass m > 0, centre c, radii k > 0 and shears s are free: m = e^{2α}, k_i = k_i⁰ e^{d_i} and c are the paper's α, d and
t up to the units. In the file s = 0. J is linear in the torque, and bodies that are fixed to each other add theirs.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch

from pace_actuators.drive_result import LinkInertia
from pace_envs.motor_coordinates import DrivenJoints
from pace_envs.quaternions import multiply
from pace_envs.simulation import Simulation

PARTS: dict[str, tuple[str, ...]] = {
    "mass": ("link_mass",),
    "com": ("link_com_x", "link_com_y", "link_com_z"),
    "inertia": (
        "link_radius_1",
        "link_radius_2",
        "link_radius_3",
        "link_shear_12",
        "link_shear_13",
        "link_shear_23",
    ),
    "load": ("link_load_mass", "link_load_x", "link_load_y", "link_load_z"),
}
"""What can be wrong with a link, and the parameters of each, in the order of every vector."""
OF_BODY = ("mass", "com", "inertia")
"""Those of the link itself: its ten inertial parameters. The load is a point mass beside it, such as a tool."""
NAMES = tuple(name for names in PARTS.values() for name in names)
"""All fourteen."""
TEN = tuple(name for part in OF_BODY for name in PARTS[part])
"""Those of the link itself."""
UNITS = dict(zip(NAMES, ("kg", *["m"] * 6, *["1"] * 3, "kg", *["m"] * 3), strict=True))
"""Unit by name."""
POSITIVE = (PARTS["mass"][0], *PARTS["inertia"][:3])
"""Those above 0: their prior is one of their logarithm."""
MASS_FACTOR, RADIUS_FACTOR, SHEAR, LEAST_REACH = 2.0, 1.5, 0.3, 0.03
"""The prior's standard deviation: mass and radii by these factors, shears by this. That of the centre of mass is the
link's largest radius of gyration in the file, at least this [m]: a tool on a small flange moves it far."""
LOAD_START, LOAD_REACH = 0.25, 4.0
"""Where a load is sought first, in parts of the link's mass at its centre, and how far, in bounds of that centre."""
PRIOR = 0.25
"""The same as part of half a bound range: bounds are four standard deviations from the file's value."""
_THINNEST = 0.01
"""Smallest radius of gyration of a reference, in parts of the largest: a rod of the file has none across."""
FIELDS = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
"""MuJoCo's fields of a body's inertial parameters."""


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A link as the model file has it: where its parameters begin, and the axes of its radii."""

    link: str
    """The body's name."""
    joint: str
    """The driven joint that moves it."""
    values: tuple[float, ...]
    """Of :data:`NAMES`."""
    axes: tuple[tuple[float, ...], ...]
    """Principal axes as columns, in the body's frame."""
    names: tuple[str, ...] = TEN
    """Those of its parameters that are free."""

    @classmethod
    def of(cls, model: mujoco.MjModel, link: str, joint: str = "", names: Sequence[str] = TEN) -> Reference:
        """A body of a compiled model."""
        b = model.body(link).id
        mass, moments = float(model.body_mass[b]), model.body_inertia[b]
        radii = np.sqrt(np.clip(0.5 * moments.sum() - moments, 0.0, None) / mass) if mass > 0 else np.zeros(3)
        if not radii.max() > 0:
            raise ValueError(
                f"The link {link} has a mass of {mass:g} kg and moments of inertia of {moments.max():g} kg m² in the "
                "model, expected more than 0. State its inertial parameters in the model file, or leave it out."
            )
        radii = np.maximum(radii, _THINNEST * radii.max())
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_iquat[b])
        com = model.body_ipos[b].tolist()
        values = (mass, *com, *radii.tolist(), 0.0, 0.0, 0.0, 0.0, *com)
        return cls(link=link, joint=joint, values=values, axes=_rows(turn.reshape(3, 3)), names=tuple(names))

    def bounds(self, name: str) -> tuple[float, float]:
        """Between which values one of its parameters is sought: four standard deviations of a prior."""
        value, far = self.values[NAMES.index(name)], 1 / PRIOR
        if name == PARTS["load"][0]:
            return 0.0, self.values[0] * MASS_FACTOR**far
        if name in PARTS["load"]:
            reach = LOAD_REACH * far * max(LEAST_REACH, *self.values[4:7])
            return value - reach, value + reach
        if name in POSITIVE:
            factor = (MASS_FACTOR if name == POSITIVE[0] else RADIUS_FACTOR) ** far
            return value / factor, value * factor
        reach = far * (max(LEAST_REACH, *self.values[4:7]) if name in PARTS["com"] else SHEAR)
        return value - reach, value + reach

    def start(self, name: str) -> float:
        """Where the search of one of its parameters begins: in the file's value, and with some load."""
        return LOAD_START * self.values[0] if name == PARTS["load"][0] else self.values[NAMES.index(name)]

    def pseudo_inertia(self, values: torch.Tensor) -> torch.Tensor:
        """J of parameters (…, 14), (…, 4, 4)."""
        mass, com, radii, shear, load, place = values.split((1, 3, 3, 3, 1, 3), dim=-1)
        first, second = (torch.as_tensor(self.values[4 + i], dtype=values.dtype, device=values.device) for i in (0, 1))
        root = torch.diag_embed(radii)
        root[..., 0, 1], root[..., 0, 2], root[..., 1, 2] = (
            first * shear[..., 0],
            first * shear[..., 1],
            second * shear[..., 2],
        )
        root = torch.as_tensor(self.axes, dtype=values.dtype, device=values.device) @ root
        upper = torch.cat([root, com[..., None]], dim=-1)
        lower = torch.cat([torch.zeros_like(com), torch.ones_like(mass)], dim=-1)
        root = torch.cat([upper, lower[..., None, :]], dim=-2)
        return mass[..., None] * (root @ root.transpose(-1, -2)) + _point(load[..., 0], place)

    def inertia(self, parameters: Mapping[str, float]) -> LinkInertia:
        """The link with some of its parameters, by name; the others are the file's."""
        own = [parameters.get(name, value) for name, value in zip(NAMES, self.values, strict=True)]
        j = self.pseudo_inertia(torch.tensor(own, dtype=torch.float64))
        mass, com = float(j[3, 3]), j[:3, 3] / j[3, 3]
        moments = j[:3, :3] - mass * com[:, None] * com
        tensor = torch.eye(3, dtype=j.dtype) * moments.trace() - moments
        pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        return LinkInertia(
            mass=mass,
            com=com.tolist(),
            inertia=[float(tensor[pair]) for pair in pairs],
        )


def write_links(spec: mujoco.MjSpec, model: mujoco.MjModel, links: Mapping[str, LinkInertia], source: object) -> None:
    """Give bodies of a model that is to be compiled other inertial parameters.

    Args:
        model: The model as it is compiled before that.
    """
    if links:
        state_inertias(spec, model)
    names = [body.name for body in spec.bodies[1:]]
    for name, link in links.items():
        if name not in names:
            raise ValueError(f"{source} has no link {name}, whose inertial parameters were identified: it has {names}.")
        body = spec.body(name)
        xx, yy, zz, xy, xz, yz = link.inertia
        moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        turn = np.zeros(4)
        mujoco.mju_mat2Quat(turn, (axes * [np.linalg.det(axes), 1.0, 1.0]).ravel())
        state_inertia(body, link.mass, link.com, moments, turn)


def state_inertia(body: mujoco.MjsBody, mass: float, com: Any, moments: Any, quat: Any) -> None:
    """Write a body's mass, centre of mass, principal moments and their axes, instead of the present ones."""
    body.explicitinertial = True
    body.mass, body.ipos = mass, com
    body.inertia, body.iquat, body.fullinertia = moments, quat, np.full(6, np.nan)


def state_inertias(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """State the compiled inertias where a file has MuJoCo take those of geoms, or scale all to a total mass.

    Such a file ignores what is written into a body.
    """
    compiler = spec.compiler
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MuJoCo 4.0: settotalmass will be removed
        total = getattr(compiler, "settotalmass", 0.0)
        if compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE and not total > 0:
            return
        if total > 0:
            compiler.settotalmass = -1.0
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    for body in spec.bodies[1:]:
        own = model.body(body.id)
        state_inertia(body, float(own.mass[0]), own.ipos, own.inertia, own.iquat)


class LinkInertias:
    """The inertial parameters of a robot's links in each simulation: the one place that writes them.

    A link's pseudo-inertia is that of the file or of :meth:`write_parameter`, scaled and turned by effects on the
    joint that moves it, plus its known loads. A link that none of these changes keeps the file's numbers.
    """

    def __init__(self, sim: Simulation, joint_names: Sequence[str]):
        """Nothing is written yet.

        Args:
            joint_names: The joints, in the order of the articulation; for a motor that moves several, one of these.
        """
        self.sim = sim
        self._loads: dict[int, torch.Tensor] = {}
        self._factors: dict[int, torch.Tensor] = {}
        self._turns: dict[tuple[int, int], _Turn] = {}
        self._parameters: dict[int, tuple[Reference, torch.Tensor]] = {}
        self._before: dict[str, torch.Tensor] = {}
        self._joints = [sim.model.joint(name) for name in joint_names]

    def add_load(
        self, bodies: Sequence[int], mass: float, place: Sequence[float] | None, rows: slice | torch.Tensor
    ) -> None:
        """Add a point mass to bodies; effects and parameters do not change it.

        Args:
            mass: [kg].
            place: Where, in the body's frame, (3,) [m]; ``None``: at its centre of mass.
        """
        for body in bodies:
            live = {field: self.sim.expand(field) for field in FIELDS}
            at = live["body_ipos"][rows, body].double()
            if place is not None:
                at = torch.as_tensor(place, dtype=torch.float64, device=at.device).expand_as(at)
            load = _point(torch.full_like(at[:, 0], mass), at)
            self._load_of(body)[rows] += load
            for source in (live, self._before) if self._before else (live,):
                fields = {field: source[field][rows, body].double() for field in FIELDS}
                after = {"body_mass": fields["body_mass"] + mass}
                if place is not None:
                    after = fields_of(pseudo_inertia_of(fields) + load)
                for field, value in after.items():
                    source[field][rows, body] = value.to(self.sim.dtype)

    def write_parameter(self, reference: Reference, name: str, values: torch.Tensor) -> None:
        """Write one of a link's parameters.

        Args:
            name: One of :data:`NAMES`.
            values: In its unit, (num_envs,).
        """
        self._remember()
        body = self.sim.model.body(reference.link).id
        if body not in self._parameters:
            every = self._zeros(len(NAMES))
            self._parameters[body] = reference, every + every.new_tensor(reference.values)
        self._parameters[body][1][:, NAMES.index(name)] = values.double()
        self._write(slice(None), body)

    def of(self, rows: slice, joint: int) -> Link:
        """The link that a joint moves, in some simulations: for effects on the model."""
        self._remember()
        return Link(inertias=self, rows=rows, joint=joint)

    def pseudo_inertias(self) -> dict[tuple[int, int], torch.Tensor]:
        """Of the bodies that joints move, {(body, joint): (num_envs, 4, 4)}, by index."""
        pairs = [(body, joint) for joint in range(len(self._joints)) for body in self.bodies_of(joint)]
        live = {field: self.sim.expand(field).double() for field in FIELDS}
        return {at: pseudo_inertia_of({field: live[field][:, at[0]] for field in FIELDS}) for at in pairs}

    def bodies_of(self, joint: int) -> list[int]:
        """The joint's body and all that are fixed to it."""
        model, body = self.sim.model, int(self._joints[joint].bodyid[0])
        return [b for b in range(model.nbody) if int(model.body_weldid[b]) == body]

    def scale(self, rows: slice, body: int, factor: torch.Tensor) -> None:
        """Multiply a body's own pseudo-inertia by (rows,)."""
        self._factor_of(body)[rows] = factor.double()
        self._write(rows, body)

    def turn(self, rows: slice, body: int, joint: int, angle: torch.Tensor) -> None:
        """Turn a body's mass about the axis of a joint that moves it by (rows,) [rad]."""
        axis, anchor = self._axis_in(body, joint)
        turn = self._turns.setdefault((body, joint), _Turn(axis, anchor, self._zeros()))
        turn.anchor[rows], turn.angle[rows] = anchor[rows], angle.double()
        self._write(rows, body)

    def _load_of(self, body: int) -> torch.Tensor:
        """Pseudo-inertia of a body's known loads, (num_envs, 4, 4)."""
        return self._loads.setdefault(body, self._zeros(4, 4))

    def _factor_of(self, body: int) -> torch.Tensor:
        """What multiplies a body's own pseudo-inertia, (num_envs,)."""
        return self._factors.setdefault(body, self._zeros() + 1)

    def _zeros(self, *shape: int) -> torch.Tensor:
        return torch.zeros(self.sim.num_envs, *shape, dtype=torch.float64, device=self.sim.device)

    def _remember(self) -> None:
        """Keep the bodies as they are before the first change."""
        self._before = self._before or {field: self.sim.expand(field).clone() for field in FIELDS}

    def _write(self, rows: slice, body: int) -> None:
        """Put a body's pseudo-inertia together, and write it."""
        before = {field: value[rows, body].double() for field, value in self._before.items()}
        factor, load = self._factor_of(body)[rows], self._load_of(body)[rows]
        own, same = pseudo_inertia_of(before) - load, factor == 1
        if body in self._parameters:
            reference, values = self._parameters[body]
            values = values[rows]
            own = reference.pseudo_inertia(values)
            same &= (values == values.new_tensor(reference.values)).all(dim=1)
        own = own * factor[:, None, None]
        for (turned, _), turn in self._turns.items():
            if turned == body:
                angle = turn.angle[rows]
                move = _turning(turn.axis, turn.anchor[rows], angle)
                own, same = move @ own @ move.transpose(-1, -2), same & (angle == 0)
        after = fields_of(own + load)
        for field in FIELDS:
            unchanged = same.view(-1, *[1] * (before[field].ndim - 1))
            value = torch.where(unchanged, before[field], after[field])
            self.sim.expand(field)[rows, body] = value.to(self.sim.dtype)

    def _axis_in(self, body: int, joint: int) -> tuple[torch.Tensor, torch.Tensor]:
        """A joint's axis (3,) and anchors (num_envs, 3) in the frame of a body that is fixed to the one it moves."""
        model, moved = self.sim.model, int(self._joints[joint].bodyid[0])
        own = np.stack([self._joints[joint].axis, self._joints[joint].pos])
        axis, anchor = torch.tensor(own, dtype=torch.float64, device=self.sim.device)
        anchor = anchor.repeat(self.sim.num_envs, 1)
        chain = [body]
        while chain[-1] != moved:
            chain.append(int(model.body_parentid[chain[-1]]))
        for b in reversed(chain[:-1]):
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, model.body_quat[b])
            back = axis.new_tensor(turn.reshape(3, 3).T)
            place = self.sim.expand("body_pos")[:, b].double()  # a load may sit elsewhere in each simulation
            axis, anchor = back @ axis, (anchor - place) @ back.T
        return axis, anchor


@dataclass(frozen=True, eq=False)
class _Turn:
    """How far a body's mass is turned about a joint's axis."""

    axis: torch.Tensor
    """In the body's frame, (3,)."""
    anchor: torch.Tensor
    """There, (num_envs, 3) [m]."""
    angle: torch.Tensor
    """(num_envs,) [rad]."""


@dataclass(frozen=True, kw_only=True)
class Link:
    """One joint's link in some simulations (the ``LinkModel`` of ``pace_actuators.effects.model``)."""

    inertias: LinkInertias
    rows: slice
    joint: int

    def scale_mass(self, factor: torch.Tensor) -> None:
        """Multiply mass and inertia of the link, and of all that is fixed to it, by (rows,)."""
        for body in self.inertias.bodies_of(self.joint):
            self.inertias.scale(self.rows, body, factor)

    def rotate_mass(self, angle: torch.Tensor) -> None:
        """Turn the mass of the link, and of all that is fixed to it, about the joint's axis by (rows,) [rad]."""
        for body in self.inertias.bodies_of(self.joint):
            self.inertias.turn(self.rows, body, self.joint, angle)


def _point(mass: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """J of point masses (…,) at places (…, 3), (…, 4, 4)."""
    at = torch.cat([place, torch.ones_like(place[..., :1])], dim=-1)
    return mass[..., None, None] * at[..., :, None] * at[..., None, :]


def pseudo_inertia_of(fields: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """J of MuJoCo's fields of a body, (n, 4, 4)."""
    mass, com, moments, axes = (*(fields[name] for name in FIELDS[:3]), _matrix(fields["body_iquat"]))
    second = 0.5 * moments.sum(dim=1, keepdim=True) - moments
    about_com = (axes * second[:, None, :]) @ axes.transpose(1, 2)
    result = _point(mass, com)
    result[:, :3, :3] += about_com
    return result


def fields_of(j: torch.Tensor) -> dict[str, torch.Tensor]:
    """MuJoCo's fields of a body with a pseudo-inertia (n, 4, 4)."""
    mass = j[:, 3, 3]
    com = j[:, :3, 3] / mass.clamp(min=1e-300)[:, None]
    second = j[:, :3, :3] - mass[:, None, None] * com[:, :, None] * com[:, None, :]
    values, axes = torch.linalg.eigh(second)
    axes = axes * torch.sign(torch.linalg.det(axes))[:, None, None]
    values = values.clamp(min=0.0)  # of a rod: rounding
    moments = values.sum(dim=1, keepdim=True) - values
    return dict(zip(FIELDS, (mass, com, moments, _quaternion(axes)), strict=True))


def _turning(axis: torch.Tensor, anchor: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """The rotations by angles (n,) about an axis (3,) through anchors (n, 3), (n, 4, 4)."""
    half = 0.5 * angle
    turn = _matrix(torch.cat([half.cos()[:, None], half.sin()[:, None] * axis], dim=1))
    result = torch.eye(4, dtype=turn.dtype, device=turn.device).repeat(len(angle), 1, 1)
    result[:, :3, :3], result[:, :3, 3] = turn, anchor - (turn @ anchor[..., None])[..., 0]
    return result


def _matrix(q: torch.Tensor) -> torch.Tensor:
    """Rotation matrices of unit quaternions (n, 4), (n, 3, 3)."""
    zero = torch.zeros_like(q[:, :1])
    conjugate = torch.cat([q[:, :1], -q[:, 1:]], dim=1)
    columns = []
    for i in range(3):
        unit = torch.eye(3, dtype=q.dtype, device=q.device)[i].expand(len(q), 3)
        columns.append(multiply(multiply(q, torch.cat([zero, unit], dim=1)), conjugate)[:, 1:])
    return torch.stack(columns, dim=2)


def _quaternion(matrix: torch.Tensor) -> torch.Tensor:
    """Unit quaternions of rotation matrices (n, 3, 3), (n, 4): of the four forms, the one that divides by most."""
    m = matrix
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    a, b, c = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    d, e, f = m[:, 1, 0] + m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] + m[:, 1, 2]
    forms = torch.stack(
        [
            torch.stack([1 + xx + yy + zz, a, b, c], dim=1),
            torch.stack([a, 1 + xx - yy - zz, d, e], dim=1),
            torch.stack([b, d, 1 - xx + yy - zz, f], dim=1),
            torch.stack([c, e, f, 1 - xx - yy + zz], dim=1),
        ],
        dim=1,
    )
    best = torch.diagonal(forms, dim1=1, dim2=2).argmax(dim=1)
    chosen = forms[torch.arange(len(m), device=m.device), best]
    return chosen / chosen.norm(dim=1, keepdim=True)


def _rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in matrix.tolist())


def moved_by(model: mujoco.MjModel, link: str, joints: Sequence[str]) -> str | None:
    """The driven joint that moves a link: the nearest above it; ``None``: it does not move."""
    b, driven = model.body(link).id, DrivenJoints.of_model(model, joints)
    while b > 0:
        own = range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b])
        for j in reversed(own):
            if (joint := model.joint(j).name) in driven.joints:
                return driven.names[driven.joints.index(joint)]
        b = int(model.body_parentid[b])
    return None
