"""Which joints influence each other, found from the model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv


def independent_trees(env: ManagerBasedEnv) -> list[list[str]]:
    """Groups of driven joints that do not influence each other's motion.

    Each kinematic tree of the model is a group (for a fixed base: each leg). Contacts, equality constraints
    and tendons can tie trees together; where the model has any, all joints form one group.

    Args:
        env: The environment.

    Returns:
        Groups of joint names, in the order of the joints.
    """
    model, robot = env.sim.model, env.scene["robot"]
    contacts = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    if contacts or model.neq or model.ntendon:
        return [list(robot.joint_names)]
    trees: dict[int, list[str]] = {}
    for name, column in zip(robot.joint_names, robot.dof_columns.tolist(), strict=True):
        trees.setdefault(int(model.dof_treeid[column]), []).append(name)
    return list(trees.values())
