"""What a change of a link's inertia changes of what its joint feels: in closed form, against MuJoCo with that link."""

import mujoco
import numpy as np
import pytest
import torch

from pace_envs.link_inertia import FIELDS, fields_of, pseudo_inertia_of
from pace_optim.joints.simulation.joint_load import LinkStates

ARM = """
<mujoco><option gravity="1 -2 -9"/><worldbody><body pos="0 0 1"><joint name="a" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0.1 0 -0.3"/><body pos="0 0.1 -0.3" euler="10 20 30" gravcomp="0.6">
<joint name="b" type="slide" axis="1 0.3 0"/><geom size="0.05" pos="0.05 0.1 0"/>
<body pos="0.1 0 0" euler="40 0 0"><joint name="c" axis="0 0 1" pos="0.02 0 0"/>
<geom type="box" size="0.1 0.02 0.05" pos="0 0.1 0.1"/></body></body></body></worldbody></mujoco>
"""
FEELING = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.2], [0.0, 1.0, 0.3]])
"""How all speeds follow from the drives' in a robot with loops."""


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("follow", [np.eye(3), FEELING])
@pytest.mark.parametrize("body", [1, 2, 3])
def test_a_changed_link_is_felt_as_in_mujoco(body, follow, moves):
    rng, model, joint = np.random.default_rng(body), mujoco.MjModel.from_xml_string(ARM), body - 1
    model.body_sameframe[:] = 0  # the changed inertia has axes of its own
    qpos, qvel, qacc, own = rng.standard_normal((4, 7, 3))
    course = (rng.standard_normal((7, 9)), np.array([0.1, 0.2, 0.3])) if moves else (None, None)

    def states():
        return LinkStates.of(model, qpos, qvel, qacc, lambda _: follow, *course)

    before = states()
    fields = {name: torch.tensor(getattr(model, name)[body].copy()).reshape(1, -1) for name in FIELDS}
    fields["body_mass"] = fields["body_mass"][0]
    j = pseudo_inertia_of(fields)[0].numpy()
    added = 0.3 * np.outer(place := np.array([0.1, -0.05, 0.2, 1.0]), place)
    for name, value in fields_of(torch.tensor(j + added)[None]).items():
        getattr(model, name)[body] = value[0].numpy()
    changed = before.change({(body, joint): added}, np.eye(3), own)
    for value, without, with_it in zip(
        changed, before.feel(np.eye(3), own), states().feel(np.eye(3), own), strict=True
    ):
        assert value[:, joint] == pytest.approx((with_it - without)[:, joint], abs=1e-10)
