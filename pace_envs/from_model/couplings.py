"""Which joints follow which, from a model's equality constraints on joints."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco


def linear_couplings(model: mujoco.MjModel) -> Iterator[tuple[int, int, float, float]]:
    """Joints that follow another: (follower, leader, ratio, offset), q_follower = ratio q_leader + offset."""
    for e in range(model.neq):
        if int(model.eq_type[e]) != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[e] or model.eq_obj2id[e] < 0:
            continue
        follower, leader = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        offset, ratio, *curved = model.eq_data[e, :5].tolist()
        if not any(curved) and ratio:
            zero, zero_of_leader = (float(model.qpos0[model.jnt_qposadr[j]]) for j in (follower, leader))
            yield follower, leader, ratio, zero + offset - ratio * zero_of_leader


def followers(model: mujoco.MjModel) -> set[int]:
    """Joints whose position an active equality constraint derives from another joint's, or holds where it is."""
    return {
        int(model.eq_obj1id[e])
        for e in range(model.neq)
        if int(model.eq_type[e]) == mujoco.mjtEq.mjEQ_JOINT and model.eq_active0[e]
    }


def followed_ratio(model: mujoco.MjModel, joint: int, leader: int) -> tuple[float, float] | None:
    """Ratio and offset with which a joint follows another, q = ratio q_leader + offset; ``None`` if it does not."""
    known = {leader: (1.0, 0.0)}
    edges = list(linear_couplings(model))
    for _ in edges:
        for follower, lead, ratio, offset in edges:
            if lead in known and follower not in known:
                r, o = known[lead]
                known[follower] = (ratio * r, ratio * o + offset)
            elif follower in known and lead not in known:
                r, o = known[follower]
                known[lead] = (r / ratio, (o - offset) / ratio)
    return known.get(joint)
