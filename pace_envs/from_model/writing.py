"""A model file's configuration as a short Python file to edit."""

from __future__ import annotations

import os
from pathlib import Path
from typing import cast

import torch

from pace_envs.from_model.defaults import CONTROL_DT
from pace_envs.from_model.robot import cfg_from_model
from pace_envs.tasks.pace import ExcitationCfg, PaceSim2realEnvCfg

_TEXT = '''\
"""{name}: its identification, as {model} states it. Every value is yours to edit.

{notes}

    {command} --task {stem}.py:{task} --data RECORDING
"""

import math
import re
from pathlib import Path

import torch

from pace_actuators import PaceDCMotorCfg
from pace_envs import ArticulationCfg, InitialStateCfg, SimulationCfg, register_task
from pace_envs.tasks.pace import ExcitationCfg, PaceCfg, PaceSim2realEnvCfg, PaceSim2realSceneCfg

HERE = Path(__file__).parent

# Units of hinges; a slide has m for rad, N for N m, kg for kg m^2. The last four are the largest values to be tried.
JOINTS = {{
    # kp, kd, effort limit, speed limit, centre and amplitude of the motion, armature, viscous, friction, encoder bias
{rows}
}}
HOME = {{{home}}}
LONGEST_DELAY = {delay:g}  # [control steps]


def column(i: int) -> list[float]:
    """One value of every joint."""
    return [row[i] for row in JOINTS.values()]


def env_cfg() -> PaceSim2realEnvCfg:
    """The identification environment."""
    names = tuple(JOINTS)
    drives = PaceDCMotorCfg(
        joint_names_expr=[re.escape(name) for name in names],
        stiffness=column(0),
        damping=column(1),
        effort_limit=column(2),
        velocity_limit=column(3),
        delay=0.0,  # with max_delay alone the drive would act with that delay
        max_delay=LONGEST_DELAY,
        implicit={implicit},  # whether the loop runs continuously; else it holds its torque between two commands
    )
    robot = ArticulationCfg(
        mjcf_path=HERE / {path!r},
        init_state=InitialStateCfg(
            pos={pos},
            rot={rot},
            joint_pos={{re.escape(name): value for name, value in HOME.items()}},
        ),
        actuators={{"drives": drives}},
        joint_order=names,
    )
    bounds = [(1e-5 * a, a) for a in column(6)] + [(0.0, v) for v in (*column(7), *column(8))]
    bounds += [(-b, b) for b in column(9)] + [(0.0, LONGEST_DELAY)]
    return PaceSim2realEnvCfg(
        scene=PaceSim2realSceneCfg(robot=robot),
        sim=SimulationCfg(dt={dt:g}, integrator={integrator!r}, gravity={gravity}),
        sim2real=PaceCfg(
            robot_name={name!r},
            data_dir="data/{name}/chirp.npz",
            joint_order=names,
            bounds_params=torch.tensor(bounds, dtype=torch.float64),
            excitation=ExcitationCfg(
                bias=tuple(centre / size for centre, size in zip(column(4), column(5), strict=True)),
                direction=(1.0,) * len(names),
                scale=tuple(column(5)),
            ),
            sample_params={sample},
            start_params={{  # of a fit: a tenth of the upper bounds
                "delay": 0.1 * LONGEST_DELAY,
                **{{
                    group: dict(zip(names, [0.1 * upper for upper in column(i)], strict=True))
                    for i, group in ((6, "armature"), (7, "viscous_friction"), (8, "friction"))
                }},
            }},{assumed}
        ),
    )


register_task({task!r}, env_cfg)
'''


def configuration_text(
    model: str | Path, output: str | Path, control_dt: float | None = None
) -> tuple[str, str, PaceSim2realEnvCfg]:
    """The Python file of a model file's configuration.

    Args:
        model: MJCF or URDF.
        output: Where the text will lie; the model is named from there.
        control_dt: Time between two commands [s]; ``None``: 2.5 ms.

    Returns:
        The text, the name of the task that it registers, and the configuration.

    Raises:
        ValueError: If the model cannot be used.
    """
    cfg = cfg_from_model(model, CONTROL_DT if control_dt is None else control_dt)
    sim2real, robot = cfg.sim2real, cfg.scene.robot
    drive = robot.actuators["drives"]
    n, names = len(sim2real.joint_order), sim2real.joint_order
    upper = sim2real.bounds_params[:-1, 1].reshape(4, n)
    excitation = cast(ExcitationCfg, sim2real.excitation)
    rows = []
    for i, name in enumerate(names):
        values = [_of(drive.stiffness, i), _of(drive.damping, i), _of(drive.effort_limit, i)]
        values += [_of(drive.velocity_limit, i), excitation.bias[i] * excitation.scale[i], excitation.scale[i]]
        rows.append(f"    {name!r}: ({', '.join(_number(v) for v in [*values, *upper[:, i].tolist()])}),")
    task = f"Pace-{''.join(word.capitalize() for word in sim2real.robot_name.replace('-', '_').split('_'))}-v0"
    stem = Path(output).stem
    home = robot.init_state.joint_pos if isinstance(robot.init_state.joint_pos, dict) else {}
    text = _TEXT.format(
        name=sim2real.robot_name,
        model=Path(model).name,
        notes="\n".join(f"- {note}" for note in sim2real.notes),
        command="pace fit",
        stem=stem,
        task=task,
        rows="\n".join(rows),
        home=", ".join(f"{_plain(name)!r}: {value:.6g}" for name, value in home.items()),
        delay=float(sim2real.bounds_params[-1, 1]),
        path=os.path.relpath(Path(model).resolve(), Path(output).resolve().parent),
        implicit=drive.implicit,
        pos=tuple(robot.init_state.pos),
        rot=tuple(robot.init_state.rot),
        dt=cfg.sim.dt,
        integrator=cfg.sim.integrator,
        gravity=tuple(cfg.sim.gravity),
        assumed=_assumed(sim2real.assumed_gains),
        sample={key: value if key == "delay" else _short(value) for key, value in sim2real.sample_params.items()},
    )
    return text, task, cfg


def _assumed(names: tuple[str, ...]) -> str:
    """A line on gains that nobody has stated."""
    return f"\n            assumed_gains={names!r},  # without those whose gains you state above" if names else ""


def _of(values: object, i: int) -> float:
    return float("inf") if values is None else float(torch.as_tensor(values)[i])


def _number(value: float) -> str:
    return "math.inf" if value == float("inf") else f"{value:.6g}"


def _short(values: object) -> object:
    return {key: float(f"{value:.4g}") for key, value in values.items()} if isinstance(values, dict) else values


def _plain(pattern: str) -> str:
    """The name that an escaped expression matches."""
    return "".join(c for i, c in enumerate(pattern) if c != "\\" or (i and pattern[i - 1] == "\\"))
