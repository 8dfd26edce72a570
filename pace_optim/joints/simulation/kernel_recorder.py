"""Notes what one control step does to one joint that is simulated alone."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, cast

import torch

from pace_actuators import PaceDCMotor
from pace_envs.compiled_drive.drive_code import Program
from pace_envs.compiled_drive.one_joint import OneJoint, position_term
from pace_optim.joints.simulation.simulation import TwinSimulation

if TYPE_CHECKING:
    from pace_optim.problem.rollout import Rollout


def record(rollout: Rollout, actuator: PaceDCMotor, rows: range) -> Program:
    """What a control step does to joints of a drive in some rows, in all of which the same effects act.

    Args:
        rollout: Of joints that are simulated alone; it has begun with a control step.
        actuator: One of its robot's drives.
        rows: Environments.

    Raises:
        NotTraceableError: If a kernel cannot do it, such as an effect that branches over a tensor's values.
    """
    position_term(rollout.env)
    joint = OneJoint(rollout.robot, actuator, rows)
    with torch.inference_mode(False):
        sim = _simulation(joint, cast(TwinSimulation, rollout.env.sim))
    with joint.noting():
        robot = joint.in_robot(sim, rollout.dataset)

        def hold() -> None:
            for field, held in zip((sim.qpos, sim.qvel), joint.held(joint.drive.encoder_bias), strict=True):
                sim._set(field, held)
            robot._refresh()

        is_held = rollout.dataset.carried is not None
        shown = joint.control_step(rollout.env.cfg.decimation, rollout.dataset, hold=hold if is_held else None)
        return joint.program(shown)


def _simulation(joint: OneJoint, true: TwinSimulation) -> Any:
    """The simulation of one joint."""
    sim, columns = copy.copy(true), joint.dof_columns
    own, alone = vars(sim), true._stands_alone[columns].double().expand(1, len(joint.rows), -1)
    own |= {"num_envs": 1, "_as_in_model": True, "_shape": (1, 1), "_columns": torch.tensor([0])}
    own |= {"_felt": None, "_steps": 0, "path": _Path(joint, list(true._model_values))}
    softness = () if true.friction_time is None else ("friction_time", "_rate", "_softness", "_rest_inertia")
    for key in ("qpos", "qvel", "qfrc_applied", "_implicit", *softness):
        joint.replace(own, vars(true), key, columns=columns)
    for key, values, places in (
        ("_expanded", true._expanded, columns),
        ("_model_values", true._model_values, true._place(columns)),
    ):
        own[key] = dict(values)
        for name in values:
            joint.replace(own[key], values, name, columns=places)
    own["_stands_alone"] = joint.leaf(lambda: alone, "bool")
    for key in ("inertia", "torque", "stiffness"):
        own[f"_{key}"] = _Series(joint, key)
    for key in ("middle", "begin", "load"):
        own[f"_{key}"] = [_Series(joint, f"{key}.{part}") for part in range(true._steps_per_interval)]
    return sim


class _Series:
    """Values by control step: the present one."""

    def __init__(self, joint: OneJoint, name: str):
        """Of a name."""
        self._joint, self._name = joint, name

    def __getitem__(self, step: int) -> torch.Tensor:
        """At the present step."""
        return self._joint.series(self._name)


class _Path:
    """What effects on the model change of what joints feel."""

    def __init__(self, joint: OneJoint, keys: list[tuple[str, str]]):
        """Of some effects' parameters."""
        self.model_effects = {key: _Change(joint, ".".join(key)) for key in keys}


class _Change:
    """Per unit of one parameter."""

    def __init__(self, joint: OneJoint, name: str):
        """Of a name."""
        self.inertia, self.torque, self.load, self.stiffness = (
            _Series(joint, f"{name}.{part}") for part in ("inertia", "torque", "load", "stiffness")
        )
