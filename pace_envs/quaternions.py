"""Rotations as unit quaternions w x y z, batched over the first dimension."""

import torch


def rotate_inverse(quat: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """A vector of the world in the rotated frame, R(q)ᵀ v = v - 2 w (u × v) + 2 u × (u × v) with q = (w, u).

    Args:
        quat: (n, 4).
        vector: (n, 3).

    Returns:
        (n, 3).
    """
    w, u = quat[:, :1], quat[:, 1:]
    t = 2.0 * torch.linalg.cross(u, vector)
    return vector - w * t + torch.linalg.cross(u, t)


def down(quat: torch.Tensor) -> torch.Tensor:
    """The direction of gravity in the rotated frame, R(q)ᵀ (0, 0, -1), (n, 3); (0, 0, -1) when upright."""
    w, x, y, z = quat.unbind(1)
    return torch.stack([2.0 * (w * y - x * z), -2.0 * (w * x + y * z), 2.0 * (x * x + y * y) - 1.0], dim=1)


def multiply(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Product a b, (n, 4)."""
    aw, av, bw, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    w = aw * bw - (av * bv).sum(dim=1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av, bv)], dim=1)


def from_euler(angles: torch.Tensor) -> torch.Tensor:
    """Quaternion of roll, pitch, yaw about fixed x, y, z [rad], (n, 3) to (n, 4)."""
    (cr, cp, cy), (sr, sp, sy) = (angles / 2).cos().T, (angles / 2).sin().T
    return torch.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        dim=1,
    )


def from_rotation_vector(vector: torch.Tensor) -> torch.Tensor:
    """Quaternion of a rotation about an axis by the vector's length [rad], (n, 3) to (n, 4)."""
    angle = torch.linalg.vector_norm(vector, dim=1, keepdim=True)
    return torch.cat([(0.5 * angle).cos(), 0.5 * torch.sinc(angle / (2 * torch.pi)) * vector], dim=1)
