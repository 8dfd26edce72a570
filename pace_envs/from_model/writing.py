"""A model file's configuration as a short Python file to edit."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path
from typing import cast

import torch

from pace_actuators.base_parameters import PER_JOINT
from pace_envs.from_model.defaults import CONTROL_DT
from pace_envs.from_model.robot import cfg_from_model
from pace_envs.generated_python import Word, python_page
from pace_envs.tasks.pace import ExcitationCfg, PaceSim2realEnvCfg

_PAGE = '''\
_ABOUT_

import math
import re
from pathlib import Path

from pace_actuators import PaceDCMotorCfg
from pace_envs import (
    ArticulationCfg,
    ExcitationCfg,
    InitialStateCfg,
    PaceCfg,
    PaceSim2realEnvCfg,
    PaceSim2realSceneCfg,
    SimulationCfg,
    register_task,
)

HERE = Path(__file__).parent

# Units of hinges; a slide has m for rad, N for N m, kg for kg m^2. The last five bound the search:
# kp, kd, effort limit, speed limit, centre and amplitude of the motion; least and largest armature, and the largest
# viscous friction, friction and encoder bias
JOINTS = _JOINTS_
HOME = _HOME_
LONGEST_DELAY = _DELAY_  # [control steps]


def env_cfg() -> PaceSim2realEnvCfg:
    """The identification environment."""
    names = tuple(JOINTS)
    kp, kd, effort, speed, centre, amplitude, *bounded = map(list, zip(*JOINTS.values()))
    least, armature, viscous, friction, bias = bounded
    drives = PaceDCMotorCfg(
        joint_names_expr=[re.escape(name) for name in names],
        stiffness=kp,
        damping=kd,
        effort_limit=effort,
        velocity_limit=speed,
        delay=0.0,  # with max_delay alone the drive would act with that delay
        max_delay=LONGEST_DELAY,
        implicit=_IMPLICIT_,  # whether the loop runs continuously; else it holds its torque between two commands
    )
    robot = ArticulationCfg(
        mjcf_path=HERE / _MODEL_,
        init_state=InitialStateCfg(
            pos=_POSITION_,
            rot=_ROTATION_,
            joint_pos={re.escape(name): value for name, value in HOME.items()},
        ),
        actuators={"drives": drives},
        joint_order=names,
        couplings=_COUPLINGS_,
    )
    bounds = {
        "armature": list(zip(least, armature, strict=True)),
        "viscous_friction": [(0.0, most) for most in viscous],
        "friction": [(0.0, most) for most in friction],
        "encoder_bias": [(-most, most) for most in bias],
        "delay": (0.0, LONGEST_DELAY),
    }
    return PaceSim2realEnvCfg(
        scene=PaceSim2realSceneCfg(robot=robot),
        sim=SimulationCfg(dt=_STEP_, integrator=_INTEGRATOR_, gravity=_GRAVITY_),
        sim2real=PaceCfg(
            robot_name=_ROBOT_,
            data_dir=_DATA_,
            joint_order=names,
            bounds=bounds,
            excitation=ExcitationCfg(
                bias=tuple(middle / size for middle, size in zip(centre, amplitude, strict=True)),
                direction=(1.0,) * len(names),
                scale=tuple(amplitude),
            ),
            sample_params=_SAMPLE_,
            start_params={  # of a fit: a tenth of the upper bounds
                "delay": 0.1 * LONGEST_DELAY,
                **{
                    group: {name: 0.1 * pair[1] for name, pair in zip(names, bounds[group], strict=True)}
                    for group in ("armature", "viscous_friction", "friction")
                },
            },
            physics_steps=_STEPS_,  # in a control step of a fit
            assumed_gains=_ASSUMED_,  # without those whose gains you state above
        ),
    )


register_task(_TASK_, env_cfg)
'''


def configuration_text(
    model: str | Path, output: str | Path, control_dt: float | None = None
) -> tuple[str, str, PaceSim2realEnvCfg]:
    """The Python file of a model file's configuration.

    Args:
        output: Where the text will lie; the model is named from there.
        control_dt: Time between two commands [s]; ``None``: 2.5 ms.

    Returns:
        The text, the name of the task that it registers, and the configuration.
    """
    cfg = cfg_from_model(model, CONTROL_DT if control_dt is None else control_dt)
    sim2real, robot = cfg.sim2real, cfg.scene.robot
    drive = robot.actuators["drives"]
    names = sim2real.joint_order
    upper = torch.stack([sim2real.bounds[name][:, 1] for name in PER_JOINT])
    excitation = cast(ExcitationCfg, sim2real.excitation)
    rows = {}
    for i, name in enumerate(names):
        values = [_of(drive.stiffness, i), _of(drive.damping, i), _of(drive.effort_limit, i)]
        values += [_of(drive.velocity_limit, i), excitation.bias[i] * excitation.scale[i], excitation.scale[i]]
        values.append(float(sim2real.bounds["armature"][i, 0]))
        rows[name] = tuple(_number(v) for v in [*values, *upper[:, i].tolist()])
    task = f"Pace-{''.join(word.capitalize() for word in sim2real.robot_name.replace('-', '_').split('_'))}-v0"
    home = robot.init_state.joint_pos if isinstance(robot.init_state.joint_pos, dict) else {}
    about = [
        f"{sim2real.robot_name}: its identification, as {Path(model).name} states it. Every value is yours to edit.",
        "",
        *(f"- {note}" for note in sim2real.notes),
        "",
        f"    pace fit --task {shlex.quote(f'{Path(output).stem}.py:{task}')} --data RECORDING",
        "",
    ]
    text = python_page(
        _PAGE,
        {
            "_ABOUT_": "\n".join(about),
            "_JOINTS_": rows,
            "_HOME_": {_plain(name): _number(value) for name, value in home.items()},
            "_DELAY_": _number(float(sim2real.bounds["delay"][0, 1])),
            "_IMPLICIT_": drive.implicit,
            "_MODEL_": os.path.relpath(Path(model).resolve(), Path(output).resolve().parent),
            "_POSITION_": tuple(robot.init_state.pos),
            "_ROTATION_": tuple(robot.init_state.rot),
            "_COUPLINGS_": {motor: dict(row) for motor, row in robot.couplings.items()},
            "_STEP_": _number(cfg.sim.dt),
            "_INTEGRATOR_": cfg.sim.integrator,
            "_STEPS_": sim2real.physics_steps,
            "_GRAVITY_": tuple(cfg.sim.gravity),
            "_ROBOT_": sim2real.robot_name,
            "_DATA_": f"data/{sim2real.robot_name}/chirp.npz",
            "_SAMPLE_": {key: _short(value) for key, value in sim2real.sample_params.items()},
            "_ASSUMED_": sim2real.assumed_gains,
            "_TASK_": task,
        },
    )
    return text.replace("        couplings={},\n", ""), task, cfg


def _of(values: object, i: int) -> float:
    return float("inf") if values is None else float(torch.as_tensor(values)[i])


def _number(value: float) -> float | Word:
    return Word("math.inf") if value == float("inf") else float(f"{value:.6g}")


def _short(values: object) -> object:
    return {key: float(f"{value:.4g}") for key, value in values.items()} if isinstance(values, dict) else values


def _plain(pattern: str) -> str:
    """The name that an escaped expression matches."""
    return re.sub(r"\\(.)", r"\1", pattern, flags=re.DOTALL)
