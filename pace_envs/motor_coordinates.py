"""Motors that move several joints through a constant matrix: differentials, two motors for pitch and roll, belts.

A motor's angle is that of the joints through its row, and its torque acts on all of them. For a group with the square
matrix R (a row per motor):

    q_m = R q,    v_m = R v,    τ = Rᵀ τ_m        and so M_m = R⁻ᵀ M R⁻¹

In a model file a motor is a fixed tendon, whose length is q_m and whose coefficients are its row. MuJoCo's tendons
carry armature, damping and friction, so these are the motor's too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch

from pace_actuators.base_parameters import BASE_PARAMETERS, CARRIED
from pace_actuators.text import listed

if TYPE_CHECKING:
    from pace_envs.simulation import Simulation

Rows = Mapping[str, Mapping[str, float]]
"""How motors turn with joints, {motor: {joint: ratio}}: q_motor = Σ ratio q_joint."""

CARRIED_FIELDS = tuple(str(BASE_PARAMETERS[name].mujoco) for name in CARRIED)
"""What joints and tendons carry of a drive, by MuJoCo's names."""
SINGLE = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
"""Types of joints that drives move: those of one degree of freedom."""
_SINGULAR = 1e-9
"""Of the largest singular value of a group's matrix: below, its motors do not determine its joints."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DrivenJoints:
    """What drives move, in the order of their names: a joint each, or joints through a constant matrix."""

    names: tuple[str, ...]
    """Of the drives' coordinates: a joint's, or a motor's, which is a fixed tendon of the model."""
    joints: tuple[str, ...]
    """A joint of the model for each: the joint itself, and for the motors of a group its joints one by one."""
    matrix: np.ndarray
    """R, (n, n): how the coordinates follow from these joints."""

    @classmethod
    def of_model(cls, model: mujoco.MjModel, names: Sequence[str]) -> DrivenJoints:
        """Find the joints that drives move.

        Args:
            names: Joints, and motors by the names of their tendons.
        """
        single = [model.joint(j).name for j in single_joints(model)]
        rows = {name: fixed_tendon(model, name) for name in names if name not in single}
        if unknown := [name for name, row in rows.items() if row is None]:
            raise ValueError(
                f"{listed(unknown)}: neither a hinge or slide joint nor a fixed tendon of the model. Joints: "
                f"{listed(single, 30)}."
            )
        return cls.of_rows(names, {name: row for name, row in rows.items() if row is not None}, single)

    @classmethod
    def of_rows(cls, names: Sequence[str], rows: Rows, order: Sequence[str]) -> DrivenJoints:
        """The same of the rows of the motors among the names.

        Args:
            order: The model's joints, in its order.
        """
        joints, every = dict.fromkeys(names, ""), {**{name: {name: 1.0} for name in names}, **rows}
        for group in _groups(every):
            turned = sorted({joint for name in group for joint in every[name]}, key=list(order).index)
            left = [joint for joint in turned if joint not in names]
            motors = [name for name in group if name in rows]
            block = np.array([[every[name].get(joint, 0.0) for joint in turned] for name in group])
            values = np.linalg.svd(block, compute_uv=False)
            if len(group) != len(turned) or values[-1] < _SINGULAR * values[0]:
                raise ValueError(
                    f"The drives of {listed(group)} turn the joints {listed(turned)}: {len(group)} independent "
                    f"drives are expected for {len(turned)} joints. Give each motor a fixed tendon with its own row, "
                    "or tie joints that follow others with <equality><joint/></equality>."
                )
            joints |= {name: name for name in group if name not in rows} | dict(zip(motors, left, strict=True))
        places = [joints[name] for name in names]
        matrix = np.array([[every[name].get(joint, 0.0) for joint in places] for name in names])
        return cls(names=tuple(names), joints=tuple(places), matrix=matrix)

    @property
    def are_coupled(self) -> bool:
        """Whether a motor moves several joints, or one by a ratio."""
        return self.names != self.joints

    @cached_property
    def inverse(self) -> np.ndarray:
        """R⁻¹, (n, n): how the joints follow from the coordinates."""
        return np.linalg.inv(self.matrix)

    def row_of(self, name: str) -> dict[str, float]:
        """How a coordinate turns with joints, {joint: ratio}."""
        row = self.matrix[self.names.index(name)].tolist()
        return {joint: ratio for joint, ratio in zip(self.joints, row, strict=True) if ratio}

    def joints_of(self, name: str) -> tuple[str, ...]:
        """The joints that a drive moves."""
        return tuple(self.row_of(name))

    def clear(self, model: mujoco.MjModel) -> None:
        """Take out of a model what drives leave to it: armature, damping, friction of joints and motors' tendons."""
        for name, joint in zip(self.names, self.joints, strict=True):
            for field in CARRIED_FIELDS:
                if name == joint:
                    getattr(model, f"dof_{field}")[int(model.joint(joint).dofadr[0])] = 0.0
                else:
                    getattr(model, f"tendon_{field}")[model.tendon(name).id] = 0.0

    def to_joints(self, values: np.ndarray) -> np.ndarray:
        """Positions or speeds of the joints, of those of the coordinates, (..., n) each."""
        return values @ self.inverse.T

    def to_motors(self, values: np.ndarray) -> np.ndarray:
        """Positions or speeds of the coordinates, of those of the joints, (..., n) each."""
        return values @ self.matrix.T

    def efforts_of_motors(self, efforts: np.ndarray) -> np.ndarray:
        """Torques at the coordinates that do the work of torques at the joints, (..., n) each [N m]."""
        return efforts @ self.inverse

    def range_within(self, limits: np.ndarray, home: np.ndarray) -> np.ndarray:
        """How far all coordinates may move at once with all joints within their limits, (n, 2).

        Args:
            limits: Of the joints, (n, 2); infinite without limits.
            home: A posture of the joints, (n,): motors that move several have their range around it.
        """
        coupled = np.array([name != joint or (row != 0).sum() > 1 for name, joint, row in self._each()])
        coupled |= (self.matrix[coupled] != 0).any(axis=0)  # a joint's own drive beside a motor
        if not coupled.any():
            return limits
        room = np.abs(limits - home[:, None]).min(axis=1)
        shares = np.abs(self.inverse)
        reach = room / shares.sum(axis=1)  # of each joint, if its coordinates move by as much
        least = np.where(shares.T > 0, reach, np.inf).min(axis=1)
        middle = self.to_motors(home)
        return np.where(coupled[:, None], np.stack([middle - least, middle + least], axis=1), limits)

    def _each(self) -> list[tuple[str, str, np.ndarray]]:
        return list(zip(self.names, self.joints, self.matrix, strict=True))

    def range_of_motors(self, limits: np.ndarray) -> np.ndarray:
        """How far the coordinates reach within limits of the joints, (n, 2) each; infinite where a joint has none."""
        with np.errstate(invalid="ignore"):  # no ratio of no limit
            ends = np.where(self.matrix[:, :, None] == 0, 0.0, self.matrix[:, :, None] * limits[None])
        return np.stack([ends.min(axis=2).sum(axis=1), ends.max(axis=2).sum(axis=1)], axis=1)


def single_joints(model: mujoco.MjModel) -> list[int]:
    """A model's hinges and slides, by index."""
    return [j for j in range(model.njnt) if int(model.jnt_type[j]) in SINGLE]


def joint_ranges(model: mujoco.MjModel, joints: Sequence[str]) -> np.ndarray:
    """Limits of joints, (n, 2) [rad, of slides m]; infinite without limits."""
    every = [model.joint(joint) for joint in joints]
    return np.array([each.range if each.limited[0] else (-np.inf, np.inf) for each in every])


def fixed_tendon(model: mujoco.MjModel, name: str) -> dict[str, float] | None:
    """The joints of a fixed tendon with their coefficients; ``None``: the model has no such tendon."""
    t = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TENDON, name)
    wraps = range(int(model.tendon_adr[t]), int(model.tendon_adr[t] + model.tendon_num[t])) if t >= 0 else ()
    if t < 0 or any(int(model.wrap_type[w]) != mujoco.mjtWrap.mjWRAP_JOINT for w in wraps):
        return None
    row: dict[str, float] = {}
    for w in wraps:
        joint = model.joint(int(model.wrap_objid[w])).name
        row[joint] = row.get(joint, 0.0) + float(model.wrap_prm[w])
    return {joint: ratio for joint, ratio in row.items() if ratio}


def add_motors(spec: mujoco.MjSpec, rows: Rows, source: object) -> None:
    """Give a model the fixed tendons of motors that it lacks; armature and friction of their joints are left to them.

    Args:
        spec: The model; it is changed.
        rows: How the motors turn with joints.
    """
    joints, tendons = [joint.name for joint in spec.joints], [tendon.name for tendon in spec.tendons]
    for motor, row in rows.items():
        if unknown := [joint for joint in row if joint not in joints]:
            raise ValueError(
                f"{source}: the motor {motor} turns with {listed(unknown)}, which the model lacks. Joints: "
                f"{listed(joints, 30)}."
            )
        if motor in joints or motor in tendons:
            continue
        tendon = spec.add_tendon(name=motor)
        for joint, ratio in row.items():
            tendon.wrap_joint(joint, ratio)
            of_joint = spec.joint(joint)  # what the file gives a joint for its drive is the motor's now
            of_joint.armature, of_joint.frictionloss = 0.0, 0.0
            of_joint.damping = np.zeros_like(of_joint.damping)


def _groups(rows: Rows) -> list[list[str]]:
    """Names whose rows share joints, together."""
    groups: list[list[str]] = []
    for name, row in rows.items():
        meet = [g for g in groups if any(set(row) & set(rows[other]) for other in g)]
        groups = [g for g in groups if g not in meet] + [[*(n for g in meet for n in g), name]]
    order = list(rows)
    return [sorted(group, key=order.index) for group in groups]


class MotorCoordinates:
    """Lets a simulation's arrays hold motors' coordinates between MuJoCo's steps, in the columns of their joints.

    Everything outside of MuJoCo then sees a robot whose joints are its motors. Around each call of MuJoCo
    :meth:`to_joints` and :meth:`to_motors` turn the state, the torques, and what drives leave to the model: armature,
    damping and friction, which the motors' tendons carry.
    """

    def __init__(self, sim: Simulation, driven: DrivenJoints, shared: Rows, *, continuous: bool):
        """Look up the columns.

        Args:
            shared: Drives of a joint whose torque acts on joints that follow it too, such as a gripper's other finger,
                {joint: {joint: ratio}}; Σ ratio q is the joint's own position where they follow. Armature and friction
                of such a drive stay on its joint, as model files have them.
            continuous: Whether loops run continuously: the damping of such drives is that of their loops, which acts
                on all their joints.
        """
        model = sim.model
        coupled = {name: joint for name, joint in zip(driven.names, driven.joints, strict=True) if name != joint}
        for name in coupled:
            _refuse_branches(model, name, driven.joints_of(name))
        rows = {joint: driven.row_of(name) for name, joint in coupled.items()} | {n: shared[n] for n in shared}
        moved = [joint for name in coupled for joint in driven.joints_of(name)]
        joints = list(dict.fromkeys([*moved, *(joint for row in shared.values() for joint in row)]))
        matrix = np.array([[rows.get(j, {j: 1.0}).get(k, 0.0) for k in joints] for j in joints])
        self._sim, device = sim, sim.device
        self.places, self.columns = (
            torch.tensor([int(address[model.joint(j).id]) for j in joints], device=device)
            for address in (model.jnt_qposadr, model.jnt_dofadr)
        )
        self.matrix, self.inverse = sim.tensor(matrix), sim.tensor(np.linalg.inv(matrix))
        at = [driven.joints.index(joint) for joint in dict.fromkeys(moved)]
        self._driven = sim.tensor(driven.inverse[np.ix_(at, at)])
        own = {field: sim.tensor(getattr(model, f"dof_{field}")) for field in CARRIED_FIELDS}
        self.carried = {field: _Carried.of(model, coupled, own[field]) for field in CARRIED_FIELDS}
        """What motors' tendons carry in place of the joints in whose columns they stand, by field."""
        share = np.eye(len(joints))
        for joint, row in shared.items():
            if continuous and min(row.values()) >= 0:
                share[:, joints.index(joint)] = [row.get(each, 0.0) for each in joints]
        self._shares = bool((share != np.eye(len(joints))).any())
        self._share, self._gather = sim.tensor(share), sim.tensor(np.linalg.inv(share))
        if self._shares:  # what the file gives the first joint is its drive's
            damping = sim.expand("dof_damping")
            damping[:, self.columns] = damping[:, self.columns] @ self._share.T

    def _turn(self, matrix: torch.Tensor) -> None:
        """Multiply positions and speeds of all groups by a matrix."""
        sim = self._sim
        sim.qpos[:, self.places] = sim.qpos[:, self.places] @ matrix.T
        sim.qvel[:, self.columns] = sim.qvel[:, self.columns] @ matrix.T

    def to_joints(self) -> None:
        """Turn motors' coordinates, torques and what they carry into those of joints: before MuJoCo computes."""
        sim = self._sim
        self._turn(self.inverse)
        sim.qfrc_applied[:, self.columns] = sim.qfrc_applied[:, self.columns] @ self.matrix
        for field, carried in self.carried.items():
            of_joints = sim.expand(f"dof_{field}")
            sim.expand(f"tendon_{field}")[:, carried.tendons] = of_joints[:, carried.columns]
            of_joints[:, carried.columns] = carried.own
        if self._shares:
            damping = sim.expand("dof_damping")
            damping[:, self.columns] = damping[:, self.columns] @ self._share.T

    def to_motors(self) -> None:
        """Turn them back."""
        sim = self._sim
        self._turn(self.matrix)
        if self._shares:
            damping = sim.expand("dof_damping")
            damping[:, self.columns] = damping[:, self.columns] @ self._gather.T
        sim.qfrc_applied[:, self.columns] = sim.qfrc_applied[:, self.columns] @ self.inverse
        for field, carried in self.carried.items():
            of_tendons, of_joints = sim.expand(f"tendon_{field}"), sim.expand(f"dof_{field}")
            of_joints[:, carried.columns] = of_tendons[:, carried.tendons]
            of_tendons[:, carried.tendons] = 0.0

    def of_driven(self, values: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Positions (..., nq) or speeds (..., nv) of driven joints; those that follow do not count.

        Args:
            columns: ``places`` or ``columns``.
        """
        result, count = values.clone(), len(self._driven)
        result[..., columns[:count]] = values[..., columns[:count]] @ self._driven.T
        return result

    def positions_of_motors(self, qpos: torch.Tensor) -> torch.Tensor:
        """Positions as the simulation shows them, (..., nq), of MuJoCo's own."""
        return _turned(qpos, self.places, self.matrix.T)

    def speeds_of_motors(self, qvel: torch.Tensor) -> torch.Tensor:
        """Speeds as the simulation shows them, (..., nv), of MuJoCo's own."""
        return _turned(qvel, self.columns, self.matrix.T)

    def positions_of_joints(self, qpos: torch.Tensor) -> torch.Tensor:
        """MuJoCo's own positions, (..., nq), of those that the simulation shows."""
        return _turned(qpos, self.places, self.inverse.T)

    def speeds_of_joints(self, qvel: torch.Tensor) -> torch.Tensor:
        """MuJoCo's own speeds, (..., nv), of those that the simulation shows; accelerations too."""
        return _turned(qvel, self.columns, self.inverse.T)

    def efforts_of_motors(self, qfrc: torch.Tensor) -> torch.Tensor:
        """Torques in the simulation's columns, (..., nv) [N m], of MuJoCo's own."""
        return _turned(qfrc, self.columns, self.inverse)

    def c_source(self) -> str:
        """C functions ``to_joints`` and ``to_motors``, which do the same to a model and its data."""
        n, there, back = len(self.places), [], []
        tables: dict[str, torch.Tensor] = {"P": self.places, "W": self.columns, "R": self.matrix, "I": self.inverse}
        if self._shares:
            tables |= {"S": self._share, "G": self._gather}
            there.append("turn(m->dof_damping, W, S, 0);")
            back.append("turn(m->dof_damping, W, G, 0);")
        for field, carried in self.carried.items():
            if count := len(carried.own):
                tables |= {f"T_{field}": carried.tendons, f"K_{field}": carried.columns, f"own_{field}": carried.own}
                of_tendon, of_joint = f"m->tendon_{field}[T_{field}[k]]", f"m->dof_{field}[K_{field}[k]]"
                loop = f"for (int k = 0; k < {count}; ++k)"
                there.append(f"{loop} {{ {of_tendon} = {of_joint}; {of_joint} = own_{field}[k]; }}")
                back.append(f"{loop} {{ {of_joint} = {of_tendon}; {of_tendon} = 0.0; }}")
        written = {name: ", ".join(map(repr, table.flatten().tolist())) for name, table in tables.items()}
        kinds = {name: "double" if table.is_floating_point() else "int" for name, table in tables.items()}
        lines = [f"static const {kinds[name]} {name}[] = {{{text}}};" for name, text in written.items()]
        return "\n".join([*lines, _TURN.format(n=n, there="\n  ".join(there), back="\n  ".join(back))])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Carried:
    """Where a field of motors is while MuJoCo computes, and otherwise."""

    tendons: torch.Tensor
    """The motors' tendons."""
    columns: torch.Tensor
    """The columns of the joints in whose place the motors stand."""
    own: torch.Tensor
    """What these joints have beside their motors."""

    @classmethod
    def of(cls, model: mujoco.MjModel, joints: Mapping[str, str], own: torch.Tensor) -> _Carried:
        """Of tendons and the joints in whose columns their motors stand."""
        tendons = [model.tendon(name).id for name in joints]
        columns = torch.tensor([int(model.joint(joint).dofadr[0]) for joint in joints.values()], dtype=torch.long)
        columns = columns.to(own.device)
        return cls(
            tendons=torch.tensor(tendons, dtype=torch.long, device=own.device), columns=columns, own=own[columns]
        )


_TURN = """
static void turn(double* values, const int* place, const double* by, int transposed) {{
  double before[{n}];
  for (int i = 0; i < {n}; ++i) before[i] = values[place[i]];
  for (int i = 0; i < {n}; ++i) {{
    double sum = 0.0;
    for (int j = 0; j < {n}; ++j) sum += (transposed ? by[j * {n} + i] : by[i * {n} + j]) * before[j];
    values[place[i]] = sum;
  }}
}}
static void to_joints(mjModel* m, mjData* d) {{
  turn(d->qpos, P, I, 0); turn(d->qvel, W, I, 0); turn(d->qfrc_applied, W, R, 1);
  {there}
}}
static void to_motors(mjModel* m, mjData* d) {{
  {back}
  turn(d->qpos, P, R, 0); turn(d->qvel, W, R, 0); turn(d->qfrc_applied, W, I, 1); turn(d->qfrc_bias, W, I, 1);
}}
"""


def _turned(values: torch.Tensor, columns: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    result = values.clone()
    result[..., columns] = values[..., columns] @ by.to(values.dtype)
    return result


def _refuse_branches(model: mujoco.MjModel, motor: str, joints: Sequence[str]) -> None:
    """Refuse a motor between branches: MuJoCo's inertia has no entry for two joints of which none moves the other."""
    dofs = sorted(int(model.joint(joint).dofadr[0]) for joint in joints)
    above, dof = set(), dofs[-1]
    while dof >= 0:
        above.add(dof)
        dof = int(model.dof_parentid[dof])
    if set(dofs) - above:
        raise ValueError(
            f"The motor {motor} moves {listed(joints)}, which lie on different branches of the model: MuJoCo has no "
            "inertia between them, so nothing carries the motor's armature. Tie them with <equality><joint/>"
            "</equality>, or model each branch with a separate drive."
        )
