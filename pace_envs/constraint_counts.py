"""How many contacts and constraints a model can have at once: MuJoCo Warp allocates them beforehand."""

from __future__ import annotations

import mujoco

_PLANE, _SPHERE, _CAPSULE, _BOX = (
    mujoco.mjtGeom.mjGEOM_PLANE,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_BOX,
)
_MOST_CONTACTS = 64
"""More at once are not expected of a robot, however many of its geoms could touch."""
_CONTACTS = {
    frozenset({_PLANE, _CAPSULE}): 2,
    frozenset({_CAPSULE}): 2,
    frozenset({_CAPSULE, _BOX}): 2,
    frozenset({_BOX}): 8,
}
_SINGLE = 1
_OTHERS = 4


def most_contacts(model: mujoco.MjModel) -> int:
    """Contacts that the colliding pairs of geoms can have together, at most 64."""
    total = int(model.npair) * _OTHERS
    for i in range(model.ngeom):
        for j in range(i + 1, model.ngeom):
            if _collide(model, i, j):
                total += _contacts_of(int(model.geom_type[i]), int(model.geom_type[j]))
    return min(total, _MOST_CONTACTS)


def most_constraints(model: mujoco.MjModel, contacts: int) -> int:
    """Rows of the constraint solver: equalities, joint friction, limits, and the pyramids of that many contacts."""
    equalities = 6 * int(model.neq)
    limits = int(model.jnt_limited.sum()) + 2 * int(model.ntendon)
    widest = int(model.geom_condim.max(initial=1))
    rows = max(1, 2 * (widest - 1))
    return equalities + int(model.nv) + int(model.ntendon) + limits + rows * contacts


def _collide(model: mujoco.MjModel, i: int, j: int) -> bool:
    if not (model.geom_contype[i] & model.geom_conaffinity[j] or model.geom_contype[j] & model.geom_conaffinity[i]):
        return False
    a, b = (int(model.body_weldid[model.geom_bodyid[g]]) for g in (i, j))
    if a == b:
        return False
    parents = [int(model.body_weldid[model.body_parentid[body]]) for body in (a, b)]
    return 0 in (a, b) or not (parents[0] == b or parents[1] == a)


def _contacts_of(one: int, other: int) -> int:
    kinds = frozenset({one, other})
    if _SPHERE in kinds:
        return _SINGLE
    return _CONTACTS.get(kinds, _OTHERS)
