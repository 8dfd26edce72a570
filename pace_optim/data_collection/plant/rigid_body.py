"""Inertia and gravity of the links, from MuJoCo; one row per recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import batch

from pace_optim.recording import Load

from .robot import PlantRobot

_SMALLEST = 1e-9
_BENCH_DEFAULTS = {"load_mass": 1.0, "load_length": 0.2, "arm_mass": 0.0}


@dataclass(kw_only=True, eq=False)
class ModelChange:
    """How the links differ from the model."""

    mass_factor: np.ndarray
    """Factor of each joint's link mass and inertia, before added masses, (R, n)."""
    com_angle: np.ndarray
    """Rotation of each joint's link masses about the joint's axis, (R, n) [rad]."""
    mount_stiffness: np.ndarray | None = None
    """Stiffness of the base against rotation, (R, 1) [N m/rad]; None for a rigid mount."""
    mount_damping: np.ndarray | None = None
    """[N m s/rad], (R, 1)."""
    mount_inertia: np.ndarray | None = None
    """Inertia of what the base is mounted on, about each axis, (R, 1) [kg m^2]."""


class RigidBody:
    """M(q) and the torques of gravity and motion, of coordinates [joints; rotations of the mount].

    Equations of motion: M(q) a + bias(q, v) = torques. A single hinge has a constant M and
    bias = A sin q + B cos q, and needs no simulator while it runs; so has one whose mount turns about the same axis.
    """

    def __init__(self, robot: PlantRobot, loads: Sequence[Load], change: ModelChange):
        """Compile the model and write each row's masses."""
        self.num_rows, self.num_joints = len(loads), robot.num_joints
        spec = robot.spec()
        single = len(spec.joints) == 1
        mounted = change.mount_stiffness is not None
        mount_names = [] if single or not mounted else _add_mount(spec)
        model = spec.compile()
        order = [model.joint(name) for name in (*robot.joint_names, *mount_names)]
        self._qpos = np.array([int(joint.qposadr[0]) for joint in order])
        self._dof = np.array([int(joint.dofadr[0]) for joint in order])
        model.dof_armature[:] = 0.0
        model.dof_damping[:] = 0.0
        model.dof_frictionloss[:] = 0.0
        self._model = model
        self._batch = batch.Batch(model, self.num_rows, nthread=1)
        self._write_masses(loads, change, robot.joint_names)
        self._q, self._v = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._M, self._bias = self._batch.bind("M"), self._batch.bind("qfrc_bias")
        self._passive = self._batch.bind("qfrc_passive")
        self._rest = np.array(self._q)
        entries = [
            (row, int(model.M_colind[model.M_rowadr[row] + k]), int(model.M_rowadr[row] + k))
            for row in range(model.nv)
            for k in range(int(model.M_rownnz[row]))
        ]
        place = {int(dof): i for i, dof in enumerate(self._dof)}
        entries = [(place[i], place[j], e) for i, j, e in entries if i in place and j in place]
        self._rows, self._cols, self._entry = (np.array(column) for column in zip(*entries, strict=True))
        self.size = len(order) + (1 if single and mounted else 0)
        self.mount_size = self.size - self.num_joints
        self._mount_inertia = change.mount_inertia
        self.constant = single
        if single:
            self._sample_single_hinge(mounted)
        self.blocks = self._independent_blocks()

    def mass(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """M, (R, N, N) [kg m^2], and bias, (R, N) [N m], at coordinates q and speeds v, (R, N)."""
        if self.constant:
            angle = q.sum(axis=1, keepdims=True) if self.mount_size else q
            gravity = self._sine * np.sin(angle) + self._cosine * np.cos(angle)
            return self._constant_M, (np.repeat(gravity, 2, axis=1) if self.mount_size else gravity)
        self._q[:] = self._rest
        self._q[:, self._qpos] = q
        self._v[:, self._dof] = v
        self._batch.forward()
        return self._dense(), (self._bias - self._passive)[:, self._dof]

    def _dense(self) -> np.ndarray:
        M = np.zeros((self.num_rows, len(self._dof), len(self._dof)))
        M[:, self._rows, self._cols] = M[:, self._cols, self._rows] = self._M[:, self._entry]
        if self.mount_size and not self.constant and self._mount_inertia is not None:
            where = np.arange(self.num_joints, self.size)
            M[:, where, where] += self._mount_inertia
        return M

    def _sample_single_hinge(self, mounted: bool) -> None:
        samples = []
        for angle in (0.0, np.pi / 2):
            self._q[:, self._qpos] = angle
            self._v[:] = 0.0
            self._batch.forward()
            samples.append((self._bias - self._passive)[:, self._dof].copy())
        self._cosine, self._sine = samples
        inertia = self._dense()
        if mounted:
            own = np.zeros((self.num_rows, 1)) if self._mount_inertia is None else self._mount_inertia
            inertia = np.tile(inertia, (1, 2, 2))
            inertia[:, 1, 1] += own[:, 0]
        self._constant_M = inertia

    def _independent_blocks(self) -> np.ndarray:
        """Coordinates of each kinematic tree, (trees, size of one); one block if trees differ in size."""
        label = np.arange(self.size)
        if self.constant:
            label[:] = 0
        else:
            for i, j in zip(self._rows, self._cols, strict=True):
                label[label == label[i]] = label[j]
        groups = [np.flatnonzero(label == each) for each in np.unique(label)]
        groups.sort(key=lambda group: group[0])
        if len({len(group) for group in groups}) > 1:
            return np.arange(self.size)[None]
        return np.stack(groups)

    def _write_masses(self, loads: Sequence[Load], change: ModelChange, joint_names: Sequence[str]) -> None:
        model, bat = self._model, self._batch
        mass, inertia = bat.expand("body_mass"), bat.expand("body_inertia")
        ipos, pos, iquat = bat.expand("body_ipos"), bat.expand("body_pos"), bat.expand("body_iquat")
        quat = bat.expand("body_quat")
        names = [model.body(i).name for i in range(model.nbody)]
        for row, load in enumerate(loads):
            bench = {key: value for key in _BENCH_DEFAULTS if (value := getattr(load, key)) is not None}
            if bench:
                _write_bench_load(names, {**_BENCH_DEFAULTS, **bench}, row, mass, inertia, ipos, pos)
            unturned = {
                body: _in_parent(pos[row, body], quat[row, body], ipos[row, body]) for body in range(model.nbody)
            }
            for j, joint in enumerate(joint_names):
                body = int(model.joint(joint).bodyid[0])
                for link in _welded(model, body):
                    mass[row, link] *= change.mass_factor[row, j]
                    inertia[row, link] *= change.mass_factor[row, j]
                angle = change.com_angle[row, j]
                if angle:
                    _rotate_masses(model, body, joint, angle, row, ipos, iquat, pos, quat)
            for name, kg in load.added_mass.items():
                if name not in names:
                    raise ValueError(
                        f"added_mass names {name!r}, which is no body. Available: {', '.join(names[1:]) or 'none'}."
                    )
                body = names.index(name)
                # without a place it is at the centre of mass of the model file, however the body's mass was turned
                place = load.added_mass_at.get(name, _from_parent(pos[row, body], quat[row, body], unturned[body]))
                if kg > 0 and not np.allclose(place, ipos[row, body], rtol=0, atol=1e-9):
                    _bolt_on(body, kg, np.array(place), row, mass, inertia, ipos, iquat)
                else:
                    mass[row, body] += kg
        bat.set_const()


def _in_parent(pos, quat, place) -> np.ndarray:  # type: ignore[no-untyped-def]
    """A place in a body's frame in that of its parent, (3,) [m]."""
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, np.asarray(place), np.asarray(quat))
    return np.asarray(pos) + turned


def _from_parent(pos, quat, place) -> np.ndarray:  # type: ignore[no-untyped-def]
    """A place in the frame of a body's parent in that of the body, (3,) [m]."""
    back, turned = np.zeros(4), np.zeros(3)
    mujoco.mju_negQuat(back, np.asarray(quat))
    mujoco.mju_rotVecQuat(turned, np.asarray(place) - np.asarray(pos), back)
    return turned


def _welded(model: mujoco.MjModel, body: int) -> list[int]:
    """A joint's body and what is welded to it."""
    return [i for i in range(model.nbody) if model.body_weldid[i] == body]


def _write_bench_load(names, load, row, mass, inertia, ipos, pos) -> None:  # type: ignore[no-untyped-def]
    """The bench's point mass on a uniform rod: m at l, rod m_a with m_a l^2 / 12 about its middle."""
    if not {"arm", "load"} <= set(names):
        raise ValueError(
            f"The load has load_mass, load_length or arm_mass, and the robot no bodies 'arm' and 'load' (it has "
            f"{', '.join(names[1:])}). Use added_mass."
        )
    arm, point = names.index("arm"), names.index("load")
    length = load["load_length"]
    across = load["arm_mass"] * length**2 / 12
    mass[row, arm] = max(load["arm_mass"], _SMALLEST)
    inertia[row, arm] = (max(across, _SMALLEST), max(across, _SMALLEST), _SMALLEST)
    ipos[row, arm] = (0.0, 0.0, -length / 2)
    mass[row, point] = max(load["load_mass"], _SMALLEST)
    pos[row, point] = (0.0, 0.0, -length)


def _bolt_on(body, kg, place, row, mass, inertia, ipos, iquat) -> None:  # type: ignore[no-untyped-def]
    """Add a point mass away from a body's centre: Steiner's rule about the new centre."""
    own, com, turn = mass[row, body], ipos[row, body].copy(), np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.asarray(iquat[row, body]))
    axes = turn.reshape(3, 3)
    centre = (own * com + kg * place) / (own + kg)
    tensor = axes @ np.diag(inertia[row, body]) @ axes.T
    for part, at in ((own, com - centre), (kg, place - centre)):
        tensor = tensor + part * (at @ at * np.eye(3) - np.outer(at, at))
    moments, axes = np.linalg.eigh(tensor)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    mass[row, body], ipos[row, body], inertia[row, body], iquat[row, body] = own + kg, centre, moments, quat


def _rotate_masses(model, body, joint, angle, row, ipos, iquat, pos, quat) -> None:  # type: ignore[no-untyped-def]
    """Turn the masses of a joint's body, and what is welded to it, about the joint's axis."""
    axis, anchor = np.array(model.joint(joint).axis), np.array(model.joint(joint).pos)
    turn, moved, spun = np.zeros(4), np.zeros(3), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, axis, angle)

    def rotate(where: np.ndarray, orientation: np.ndarray) -> None:
        mujoco.mju_rotVecQuat(moved, np.asarray(where) - anchor, turn)
        where[:] = anchor + moved
        mujoco.mju_mulQuat(spun, turn, np.asarray(orientation))
        orientation[:] = spun

    rotate(ipos[row, body], iquat[row, body])
    for child in _welded(model, body):
        if model.body_parentid[child] == body:
            rotate(pos[row, child], quat[row, child])


def _add_mount(spec: mujoco.MjSpec) -> list[str]:
    """Let the base turn about three axes through its origin; returns the joints' names."""
    base = spec.worldbody.first_body()
    names = []
    for axis, name in zip(np.eye(3), ("mount_x", "mount_y", "mount_z"), strict=True):
        base.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
        names.append(name)
    return names
