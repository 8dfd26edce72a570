"""Motors that move several joints together: are their parameters found, and does the exported MJCF move as the fit?

    python benchmarks/coupled_drives.py            # record, fit, export, replay; then the table

Plants in plain MuJoCo, without code of the project: a differential wrist, a two-motor ankle (pitch and roll) and a belt
whose second motor sits in the base. A PD loop at 1 kHz in the motors' coordinates, a delay of the commands, encoder
noise of 0.1 mrad. The model file that the fit gets has the motors as fixed tendons, without their parameters. Or it has
the joints alone, and the log states the motors and their gains.
"""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

CONTROL_DT, PLANT_DT, NOISE = 1e-3, 2.5e-5, 1e-4
ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Case:
    """A robot whose motors move its two joints together."""

    name: str
    bodies: str
    joints: tuple[str, str]
    rows: dict[str, dict[str, float]]
    """How each motor turns with the joints; the motor of one joint has its name."""
    kp: float
    kd: float
    limit: float
    amplitude: float
    truth: dict[str, tuple[float, float]]
    delay: float = 3.3e-3

    def xml(self, *, bare: bool = False) -> str:
        """The model file: links, tendons, and position servos on them; or links alone."""
        tendons, servos = [], []
        for motor, row in self.rows.items():
            joints = "".join(f'<joint joint="{joint}" coef="{ratio}"/>' for joint, ratio in row.items())
            tendons.append(f'<fixed name="{motor}">{joints}</fixed>')
            servos.append(
                f'<position name="{motor}" tendon="{motor}" kp="{self.kp}" kv="{self.kd}" '
                f'forcerange="{-self.limit} {self.limit}"/>'
            )
        drives = f"<tendon>{''.join(tendons)}</tendon><actuator>{''.join(servos)}</actuator>"
        return (
            f'<mujoco model="{self.name}"><compiler angle="radian"/><option timestep="0.001"/>'
            f"<worldbody>{self.bodies}</worldbody>{'' if bare else drives}</mujoco>"
        )

    def facts(self) -> dict:
        """What a log states beside such a file."""
        return {"couplings": self.rows, "stiffness": self.kp, "damping": self.kd, "effort_limit": self.limit}


CASES = (
    Case(
        name="differential_wrist",
        bodies="""
          <body name="cross" pos="0 0 .12"><joint name="pitch" axis="0 1 0" range="-1.2 1.2"/>
            <inertial pos="0 0 .01" mass=".1" diaginertia="1e-4 1e-4 1e-4"/>
            <body name="hand"><joint name="roll" axis="1 0 0" range="-1.2 1.2"/>
              <inertial pos="0 .01 .08" mass=".6" diaginertia="1.5e-3 1.2e-3 6e-4"/></body></body>""",
        joints=("pitch", "roll"),
        rows={"motor_a": {"pitch": 1.5, "roll": 1.0}, "motor_b": {"pitch": 1.5, "roll": -1.0}},
        kp=12.0,
        kd=0.2,
        limit=6.0,
        amplitude=0.35,
        truth={
            "armature": (2e-3, 3e-3),
            "viscous_friction": (0.06, 0.05),
            "friction": (0.05, 0.04),
            "encoder_bias": (0.01, -0.015),
        },
    ),
    Case(
        name="two_motor_ankle",
        bodies="""
          <body name="cross" pos="0 0 .4"><joint name="ankle_pitch" axis="0 1 0" range="-.9 .6"/>
            <inertial pos="0 0 0" mass=".05" diaginertia="2e-5 2e-5 2e-5"/>
            <body name="foot"><joint name="ankle_roll" axis="1 0 0" range="-.4 .4"/>
              <inertial pos=".04 0 -.04" mass=".6" diaginertia="3e-4 2e-3 2e-3"/></body></body>""",
        joints=("ankle_pitch", "ankle_roll"),
        rows={"left": {"ankle_pitch": 1.1, "ankle_roll": 0.7}, "right": {"ankle_pitch": 1.1, "ankle_roll": -0.75}},
        kp=30.0,
        kd=0.5,
        limit=25.0,
        amplitude=0.2,
        truth={
            "armature": (4e-3, 5e-3),
            "viscous_friction": (0.12, 0.15),
            "friction": (0.15, 0.1),
            "encoder_bias": (-0.01, 0.012),
        },
    ),
    Case(
        name="belt",
        bodies="""
          <body name="upper"><joint name="shoulder" axis="0 1 0" range="-2 2"/>
            <inertial pos=".1 0 0" mass=".8" diaginertia="1e-3 4e-3 4e-3"/>
            <body name="fore" pos=".25 0 0"><joint name="elbow" axis="0 1 0" range="-2 2"/>
              <inertial pos=".1 0 0" mass=".4" diaginertia="5e-4 2e-3 2e-3"/></body></body>""",
        joints=("shoulder", "elbow"),
        rows={"shoulder": {"shoulder": 1.0}, "belt": {"shoulder": 1.0, "elbow": 1.0}},
        kp=40.0,
        kd=0.8,
        limit=20.0,
        amplitude=0.3,
        truth={
            "armature": (8e-3, 6e-3),
            "viscous_friction": (0.2, 0.15),
            "friction": (0.2, 0.1),
            "encoder_bias": (0.01, -0.02),
        },
    ),
)


def record(case: Case, seed: int, seconds: float, noise: float = NOISE) -> dict[str, np.ndarray]:
    """What the motors' encoders show, and their targets: ``time``, ``dof_pos``, ``des_dof_pos``."""
    model = mujoco.MjModel.from_xml_string(case.xml())
    rows = np.array([[row.get(joint, 0.0) for joint in case.joints] for row in case.rows.values()])
    model.tendon_armature[:], model.tendon_damping[:] = case.truth["armature"], case.truth["viscous_friction"]
    model.tendon_frictionloss[:] = case.truth["friction"]
    model.tendon_solref_fri[:], model.tendon_solimp_fri[:] = (2 * PLANT_DT, 1.0), (0.999, 0.999, 0.001, 0.5, 2.0)
    model.opt.timestep, model.opt.integrator = PLANT_DT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    target = commands(case, seed, round(seconds / CONTROL_DT))
    bias, parts = np.array(case.truth["encoder_bias"]), round(CONTROL_DT / PLANT_DT)
    late = round(case.delay / PLANT_DT)
    shown = np.empty_like(target)
    for k in range(len(target)):
        shown[k], speed = rows @ data.qpos - bias, rows @ data.qvel
        for part in range(parts):
            command = target[max(0, (k * parts + part - late) // parts)]
            torque = case.kp * (command - shown[k]) - case.kd * speed
            data.qfrc_applied[:] = rows.T @ np.clip(torque, -case.limit, case.limit)
            mujoco.mj_step(model, data)
    shown += np.random.default_rng(seed + 100).normal(0.0, noise, shown.shape)
    return {"time": CONTROL_DT * np.arange(len(target)), "dof_pos": shown, "des_dof_pos": target}


def commands(case: Case, seed: int, count: int) -> np.ndarray:
    """A chirp from 0.3 to 4 Hz on each motor, from rest, (count, 2) [rad]."""
    rng, time = np.random.default_rng(seed), CONTROL_DT * np.arange(count)
    turns = 0.3 * time + 0.5 * 3.7 * time**2 / time[-1]
    each = [np.sin(2 * np.pi * (1 + 0.17 * i) * turns + rng.uniform(0, 2 * np.pi)) for i in range(len(case.joints))]
    return case.amplitude * np.stack(each, axis=1) * np.minimum(1.0, time / 0.3)[:, None]


def replay(xml: str, names: list[str], rows: np.ndarray, target: np.ndarray, start: np.ndarray) -> np.ndarray:
    """What the exported model's motors show in plain MuJoCo, at each command, (count, n) [rad]."""
    model = mujoco.MjModel.from_xml_string(xml)
    data, parts = mujoco.MjData(model), round(CONTROL_DT / model.opt.timestep)
    data.qpos[:] = np.linalg.solve(rows, start)
    order = [names.index(model.actuator(i).name) for i in range(model.nu)]
    for i, j in enumerate(order):
        if model.actuator_delay[i]:
            count = int(model.actuator_history[i, 0])
            mujoco.mj_initCtrlHistory(model, data, i, None, np.full(count, target[0, j]))
    shown = np.empty_like(target)
    for k in range(len(target)):
        shown[k] = rows @ data.qpos
        data.ctrl[:] = target[k, order]
        for _ in range(parts):
            mujoco.mj_step(model, data)
    return shown


def _row(case: Case, folder: Path, stated: bool) -> str:
    names, xml = list(case.rows), folder / f"{case.name}.xml"
    xml.write_text(case.xml(bare=stated))
    rows = np.array([[row.get(joint, 0.0) for joint in case.joints] for row in case.rows.values()])
    logs = [record(case, seed, 6.0) for seed in (0, 1)]
    for log, name in zip(logs, ("a", "b"), strict=True):  # of the joints, as a robot's state publisher logs them
        turned = {key: log[key] @ np.linalg.inv(rows).T for key in ("dof_pos", "des_dof_pos")}
        np.savez(folder / f"{name}.npz", time=log["time"], joint_names=np.array(case.joints), **turned)
        if stated:
            (folder / f"{name}.json").write_text(json.dumps(case.facts()))
    script = [sys.executable, str(ROOT / "scripts" / "fit.py"), "--task", str(xml), "--optimizer", "least_squares"]
    done = subprocess.run(
        [*script, "--drive_dt", "0.001", "--data", str(folder / "a.npz"), "--validation", str(folder / "b.npz"),
         "--log_dir", str(folder)], capture_output=True, text=True, check=True,
    )  # fmt: skip
    run = Path(done.stdout.strip().splitlines()[-1].removeprefix("run: "))
    result = json.loads((run / "result.json").read_text())
    found = result["parameters"]
    off = {
        name: max(
            abs(found[name][motor] / true - 1) for motor, true in zip(names, case.truth[name], strict=True)
        )
        for name in ("armature", "viscous_friction", "friction")
    }  # fmt: skip
    model = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "export.py"), str(run), "--format", "mjcf"],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    fitted = _fitted(run)
    moved = replay(model, names, rows, logs[0]["des_dof_pos"], fitted[0])
    apart = 1e3 * np.abs(moved - fitted).max()
    cells = [f"{100 * each:.2g} %" for each in off.values()]
    late = 1e6 * abs(result["delay_s"] - case.delay)
    train, held_out = (1e3 * result["rmse"][key]["all"] for key in ("train", "validation"))
    words = [
        f"{case.name}{', stated by the log' if stated else ''}",
        *cells,
        f"{late:.0f} µs",
        f"{train:.4f} / {held_out:.4f}",
        f"{apart:.3f} mrad",
    ]
    return f"| {' | '.join(words)} |"


def _fitted(run: Path) -> np.ndarray:
    """What the fitted model's motors show on its first recording, (count, n) [rad]."""
    import torch

    from pace_optim.run.open import open_problem

    problem = open_problem(run)
    values = problem.space.from_dict(json.loads((run / "result.json").read_text())["parameters"])
    rollout = problem.evaluator().rollout(1)
    rollout.start(values[None], torch.ones_like(problem.dataset.train))
    bias = np.array([float(values[problem.space.labels.index(f"encoder_bias/{n}")]) for n in problem.joint_names])
    return np.stack([position[0].numpy() - bias for position, _ in rollout])


def main() -> None:
    """Print the table."""
    print(
        "| robot | armature | viscous friction | friction | delay | error [mrad], fitted / held out | exported MJCF |"
    )
    print("|---|---|---|---|---|---|---|")
    for case, stated in itertools.product(CASES, (False, True)):
        with tempfile.TemporaryDirectory() as folder:
            print(_row(case, Path(folder), stated), flush=True)


if __name__ == "__main__":
    main()
