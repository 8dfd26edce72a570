"""Which joints influence each other, found from the model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import mujoco

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv


def independent_trees(env: ManagerBasedEnv) -> list[list[str]]:
    """Groups of driven joints that do not influence each other's motion.

    Each kinematic tree of the model is a group (for a fixed base: each leg). Equality constraints (closed chains, mimic
    joints) and tendons tie the trees that they hold together; contacts can tie all.

    Returns:
        Groups of joint names, in the order of the joints.
    """
    model, robot = env.sim.model, env.scene["robot"]
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return [list(robot.joint_names)]
    group = list(range(model.ntree))
    for tied in _tied_trees(model):
        members = {group[tree] for tree in tied if tree >= 0}
        group = [min(members) if g in members else g for g in group]
    trees: dict[int, list[str]] = {}
    for name, column in zip(robot.joint_names, robot.dof_columns.tolist(), strict=True):
        trees.setdefault(group[int(model.dof_treeid[column])], []).append(name)
    return list(trees.values())


def _tied_trees(model: mujoco.MjModel) -> Iterator[set[int]]:
    """The trees that each active equality constraint, and each tendon, holds together; -1 is the world."""
    for t in range(model.ntendon):
        yield _trees_of_tendon(model, t)
    for e in range(model.neq):
        if not model.eq_active0[e]:
            continue
        ends = [int(end) for end in (model.eq_obj1id[e], model.eq_obj2id[e]) if end >= 0]
        kind, what = int(model.eq_type[e]), int(model.eq_objtype[e])
        if kind == mujoco.mjtEq.mjEQ_TENDON:
            yield set().union(*(_trees_of_tendon(model, end) for end in ends))
        elif kind == mujoco.mjtEq.mjEQ_JOINT:
            yield {int(model.dof_treeid[model.jnt_dofadr[end]]) for end in ends}
        elif what == mujoco.mjtObj.mjOBJ_SITE:
            yield {int(model.body_treeid[model.site_bodyid[end]]) for end in ends}
        elif what == mujoco.mjtObj.mjOBJ_BODY:
            yield {int(model.body_treeid[end]) for end in ends}
        else:  # of a kind that this does not know: all may be tied
            yield set(range(model.ntree))


def _trees_of_tendon(model: mujoco.MjModel, tendon: int) -> set[int]:
    first, trees = int(model.tendon_adr[tendon]), set()
    for w in range(first, first + int(model.tendon_num[tendon])):
        kind, of = int(model.wrap_type[w]), int(model.wrap_objid[w])
        if kind == mujoco.mjtWrap.mjWRAP_JOINT:
            trees.add(int(model.dof_treeid[model.jnt_dofadr[of]]))
        elif kind == mujoco.mjtWrap.mjWRAP_SITE:
            trees.add(int(model.body_treeid[model.site_bodyid[of]]))
        elif kind in (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER):
            trees.add(int(model.body_treeid[model.geom_bodyid[of]]))
    return trees
