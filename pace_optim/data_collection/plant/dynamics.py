"""One integration step of all recordings, with exact Coulomb friction: impulses within their bounds, or no motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .hidden import HiddenEffect
from .rigid_body import RigidBody
from .state import Drives, State

_SWEEPS = 40
_TOLERANCE = 1e-9  # of a sweep's largest change of speed [rad/s]


class Dynamics:
    """Drives, transmission and links between two control instants.

    Drift-kick-drift, of second order for smooth torques:

        q_m = q + h/2 v
        (M + J + h/2 D) (v' - v) = h (τ - D v - bias(q_m)) + λ,     λ in ± h F: exact Coulomb friction
        q'  = q_m + h/2 v'

    with armature J and viscous friction D. Torques that depend on speed take it at mid-step, extrapolated as
    1.5 v - 0.5 v_before. If the transmission is compliant, J, D and friction are the motor's, with a separate
    position and speed. A compliant mount adds its coordinates to M.
    """

    def __init__(self, drives: Drives, body: RigidBody, effects: Sequence[HiddenEffect], position: np.ndarray):
        """Start at rest.

        Args:
            position: Where the encoder's side of each joint is, (R, n) [rad].
        """
        self.drives, self.body = drives, body
        self.n, self.size = body.num_joints, body.size
        overrides = _overriders(effects)
        self._drive = sorted(overrides["drive"], key=lambda effect: effect.drive_rank)
        self._friction, self._motor, self._joint = (overrides[k] for k in ("friction", "motor_torque", "joint_torque"))
        rows = len(position)
        compliance = drives.compliance
        given = np.zeros(self.n, dtype=bool) if compliance is None else compliance.joints
        self.given = given
        self._any_given = bool(given.any())
        self._pad = pad = np.zeros((rows, self.size - self.n))
        self._J = np.concatenate([np.where(given, 0.0, drives.armature), pad], axis=1)
        mount_c = pad if drives.model.mount_damping is None else pad + drives.model.mount_damping
        self._D = np.concatenate([np.where(given, 0.0, drives.viscous_friction), mount_c], axis=1)
        self._mount_k = drives.model.mount_stiffness
        self._slope = drives.saturation_effort / drives.velocity_limit
        self._inverse: np.ndarray | None = None
        self._inverse_h = 0.0
        self.q = np.concatenate([position, pad], axis=1)
        self.v = np.zeros_like(self.q)
        self.motor_pos = position.copy()
        self._settle(position)
        self.motor_vel = np.zeros((rows, self.n))
        self._v_before, self._w_before = self.v.copy(), self.motor_vel.copy()
        self._impulse = np.zeros_like(self.q)
        self._motor_impulse = np.zeros((rows, self.n))
        self.state = State(
            h=0.0,
            time=drives.session_start.copy(),
            clock=0.0,
            joint_pos=self.joint_pos,
            joint_vel=self.joint_vel,
            motor_pos=self.motor_pos,
            motor_vel=self.motor_vel,
            torque=np.zeros((rows, self.n)),
            bias=np.zeros((rows, self.n)),
        )

    @property
    def joint_pos(self) -> np.ndarray:
        """Link positions, (R, n) [rad]."""
        return self.q[:, : self.n]

    @property
    def joint_vel(self) -> np.ndarray:
        """Link speeds, (R, n) [rad/s]."""
        return self.v[:, : self.n]

    def encoder_side(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and speed of what the encoder sits on, each (R, n)."""
        compliance = self.drives.compliance
        if compliance is None:
            return self.joint_pos, self.joint_vel
        on_link = compliance.encoder_on_link | ~self.given
        return (
            np.where(on_link, self.joint_pos, self.motor_pos),
            np.where(on_link, self.joint_vel, self.motor_vel),
        )

    def step(self, command: np.ndarray, h: float) -> None:
        """Advance by h seconds under a torque asked for, (R, n) [N m]."""
        n, drives, state, body = self.n, self.drives, self.state, self.body
        q_mid = self.q + 0.5 * h * self.v
        v_mid = 1.5 * self.v - 0.5 * self._v_before
        M, bias = body.mass(q_mid, v_mid)
        state.h = h
        state.joint_pos, state.joint_vel, state.bias = q_mid[:, :n], v_mid[:, :n], bias[:, :n]
        state.motor_pos, state.motor_vel = state.joint_pos, state.joint_vel
        if self._any_given:
            motor_mid = self.motor_pos + 0.5 * h * self.motor_vel
            state.motor_pos = np.where(self.given, motor_mid, state.joint_pos)
            state.motor_vel = np.where(self.given, 1.5 * self.motor_vel - 0.5 * self._w_before, state.joint_vel)

        state.torque = self._motor_output(command, state)
        forward, backward = drives.friction, drives.friction
        for effect in self._friction:
            forward, backward = effect.friction(forward, backward, state)
        on_motor = state.torque
        for effect in self._motor:
            on_motor = on_motor + effect.motor_torque(state)
        on_link: np.ndarray | float = 0.0
        for effect in self._joint:
            on_link = on_link + effect.joint_torque(state)

        into_link = on_motor
        if self._any_given:
            into_link = np.where(self.given, self._step_motor(on_motor, forward, backward, motor_mid, h), on_motor)
        force = -bias - self._D * self.v
        force[:, :n] += into_link + on_link
        if self._mount_k is not None:
            force[:, n:] -= self._mount_k * q_mid[:, n:]
        inverse = self._inverse_of(M, h)
        v_free = self.v + _apply(inverse, h * force, body.blocks)
        lower, upper = -h * forward, h * backward
        if self._any_given:
            lower, upper = np.where(self.given, 0.0, lower), np.where(self.given, 0.0, upper)
        if self.size > n:
            lower, upper = (np.concatenate([bound, self._pad], axis=1) for bound in (lower, upper))
        self._v_before = self.v
        self.v, self._impulse = friction_impulse(v_free, inverse, lower, upper, body.blocks, self._impulse)
        self.q = q_mid + 0.5 * h * self.v
        state.time = state.time + h
        state.clock += h

    def _motor_output(self, command: np.ndarray, state: State) -> np.ndarray:
        """What a drive makes of a torque asked for: its limit, its stages, then what the supply's voltage leaves.

        The request stays within ± τ_c; the outcome between τ_s (-1 - v / v_0) and τ_s (1 - v / v_0) at the motor's
        speed v, except that a motor turned faster than it could run brakes with τ_c at most.
        """
        drives, most = self.drives, self.drives.effort_limit
        torque = np.maximum(np.minimum(command, most), -most)
        for effect in self._drive:
            torque = effect.drive(torque, state)
        drop = self._slope * state.motor_vel
        ceiling = np.maximum(drives.saturation_effort - drop, -most)
        floor = np.minimum(-drives.saturation_effort - drop, most)
        return np.maximum(np.minimum(torque, ceiling), floor)

    def _step_motor(
        self, torque: np.ndarray, forward: np.ndarray, backward: np.ndarray, motor_mid: np.ndarray, h: float
    ) -> np.ndarray:
        """Advance the motors that a spring joins to their links; returns the springs' torque [N m]."""
        drives = self.drives
        assert drives.compliance is not None
        twist = motor_mid - self.state.joint_pos
        rate = self.state.motor_vel - self.state.joint_vel
        spring = drives.compliance.torque(twist, rate)
        inverse = 1 / (drives.armature + 0.5 * h * drives.viscous_friction)
        w = self.motor_vel + inverse * h * (torque - spring - drives.viscous_friction * self.motor_vel)
        impulse = np.minimum(np.maximum(-w / inverse, -h * forward), h * backward)
        self._w_before = self.motor_vel
        self.motor_vel = w + inverse * impulse
        self.motor_pos = motor_mid + 0.5 * h * self.motor_vel
        return spring

    def _inverse_of(self, M: np.ndarray, h: float) -> np.ndarray:
        """(M + J + h/2 D)⁻¹ of each tree, (R, K, B, B)."""
        if self.body.constant and self._inverse is not None and self._inverse_h == h:
            return self._inverse
        total = M.copy()
        where = np.arange(self.size)
        total[:, where, where] += self._J + 0.5 * h * self._D
        blocks = self.body.blocks
        self._inverse = np.linalg.inv(total[:, blocks[:, :, None], blocks[:, None, :]])
        self._inverse_h = h
        return self._inverse

    def _settle(self, position: np.ndarray) -> None:
        """Put springs to where they carry gravity at rest, the encoder's side where it is asked to be."""
        compliance = self.drives.compliance
        if compliance is None and self._mount_k is None:
            return
        for _ in range(30):
            _, bias = self.body.mass(self.q, np.zeros_like(self.v))
            if compliance is not None:
                load = bias[:, : self.n]
                twist = load / compliance.stiffness + 0.5 * compliance.gap * np.sign(load)
                link = np.where(compliance.encoder_on_link | ~self.given, position, position - twist)
                self.q[:, : self.n] = link
                self.motor_pos = np.where(self.given, link + twist, position)
            if self._mount_k is not None:
                self.q[:, self.n :] = -bias[:, self.n :] / self._mount_k


def friction_impulse(
    v: np.ndarray, A: np.ndarray, lower: np.ndarray, upper: np.ndarray, blocks: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Speeds after friction, and its impulses.

    Per joint the set-valued law: impulse λ in [lower, upper], v > 0 only at the lower, v < 0 only at the upper bound,
    where v = v_free + A λ. One joint has the closed form λ = clip(-v / A); several that are coupled are swept over
    (projected Gauss-Seidel), all kinematic trees at once.

    Args:
        v: Speeds without friction, (R, N) [rad/s].
        A: Inverse of the inertia, (R, K, B, B) for K trees of B coordinates [1/(kg m^2)].
        lower: Smallest impulse, (R, N) [N m s]; 0 for a coordinate without friction.
        upper: Largest impulse, (R, N) [N m s].
        blocks: Coordinates of each tree, (K, B).
        start: Impulses to start from, (R, N) [N m s].

    Returns:
        Speeds and impulses, each (R, N).
    """
    if blocks.size == 1:
        impulse = np.minimum(np.maximum(-v / A[:, 0, 0], lower), upper)
        return v + A[:, 0, 0] * impulse, impulse
    w = v[:, blocks]
    low, high = lower[:, blocks], upper[:, blocks]
    impulse = np.minimum(np.maximum(start[:, blocks], low), high)
    w = w + np.matmul(A, impulse[..., None])[..., 0]
    size = blocks.shape[1]
    diagonal = A[..., np.arange(size), np.arange(size)]
    for _ in range(_SWEEPS):
        largest = 0.0
        for j in range(size):
            new = np.minimum(np.maximum(impulse[..., j] - w[..., j] / diagonal[..., j], low[..., j]), high[..., j])
            change = new - impulse[..., j]
            impulse[..., j] = new
            w += A[..., j] * change[..., None]
            largest = max(largest, float(np.abs(change * diagonal[..., j]).max()))
        if largest < _TOLERANCE:
            break
    result, impulses = np.empty_like(v), np.empty_like(v)
    result[:, blocks], impulses[:, blocks] = w, impulse
    return result, impulses


def _apply(A: np.ndarray, force: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """A force, block by block, (R, N)."""
    if blocks.size == 1:
        return A[:, 0, 0] * force
    result = np.empty_like(force)
    result[:, blocks] = np.matmul(A, force[:, blocks][..., None])[..., 0]
    return result


def _overriders(effects: Sequence[HiddenEffect]) -> dict[str, list[HiddenEffect]]:
    """Effects by the stage that they override."""
    stages = (
        "command",
        "measure",
        "speed_feedback",
        "controller",
        "drive",
        "friction",
        "motor_torque",
        "joint_torque",
    )
    return {
        stage: [each for each in effects if getattr(type(each), stage) is not getattr(HiddenEffect, stage)]
        for stage in stages
    }
