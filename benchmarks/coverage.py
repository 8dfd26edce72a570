"""Do two error bars hold the truth in 95 % of small fits? A pendulum of plain MuJoCo, a 1 kHz drive, a 200 Hz log.

python benchmarks/coverage.py --fits 200
python benchmarks/coverage.py --fits 30 --noise quantised --drive_dt 0.001   # the loop's rate is stated

Each fit draws a drive, a motion and the noise anew, and is made by the command line's own function. A value counts
where the result has an error bar for it.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import mujoco
import numpy as np
import torch
from scipy import signal

import pace_optim.identification.fit as fit_module
from pace_optim.run.result import FitResult
from pace_optim.run.settings import FitSettings
from pace_optim.terminal.progress import ProgressLine

NOISES = ("white", "quantised", "correlated")
SIGMA = 1e-4
"""Standard deviation of the noise [rad]."""
CORRELATION = 0.8
"""Of correlated noise, from sample to sample."""
BITS = 14
"""Of the encoder that quantises, per turn."""
LOG_DT, LOOP_DT, PLANT_DT, DURATION = 0.005, 0.001, 1e-5, 4.0
KP, KD, LIMIT = 40.0, 1.0, 40.0
MODEL = """<mujoco model="pendulum"><compiler angle="radian"/><option timestep="{dt}" integrator="implicitfast"/>
<worldbody><body><joint name="joint" axis="0 1 0" damping="0" range="-3 3" limited="true"/>
<inertial pos="0 0 -0.15" mass="1" diaginertia="0.005 0.005 0.001"/></body></worldbody>
<actuator><motor joint="joint" ctrlrange="-{limit} {limit}"/></actuator></mujoco>"""


def drawn(rng: np.random.Generator) -> dict[str, float]:
    """A drive; the delay in seconds."""
    return {
        "armature": rng.uniform(0.02, 0.08),
        "viscous_friction": rng.uniform(0.2, 0.6),
        "friction": rng.uniform(0.1, 0.4),
        "encoder_bias": rng.uniform(-0.03, 0.03),
        "delay": PLANT_DT * round(rng.uniform(0.002, 0.012) / PLANT_DT),
    }


def motion(rng: np.random.Generator, count: int) -> np.ndarray:
    """Targets, (count,) [rad]."""
    t = LOG_DT * np.arange(count)[:, None]
    frequency = np.geomspace(0.3, 6.0, 8) * rng.uniform(0.9, 1.1, 8)
    waves = (np.sin(2 * np.pi * (frequency * t + rng.uniform(0, 1, 8))) / np.sqrt(frequency)).sum(axis=1)
    return 0.6 * waves / np.abs(waves).max()


def simulate(drive: dict[str, float], command: np.ndarray, limit: float = LIMIT) -> np.ndarray:
    """Encoder positions at the log's samples, (count,) [rad]; it stands still for a second before.

    Args:
        drive: As :func:`drawn` has it.
        command: Targets, (count,) [rad].
        limit: Of the drive's torque [N m].
    """
    model = mujoco.MjModel.from_xml_string(MODEL.format(dt=PLANT_DT, limit=limit))
    model.dof_armature[:], model.dof_damping[:] = drive["armature"], drive["viscous_friction"]
    model.dof_frictionloss[:] = drive["friction"]
    model.dof_solref[:], model.dof_solimp[:] = [2 * PLANT_DT, 1.0], [0.999, 0.9999, 0.001, 0.5, 2.0]
    data, bias = mujoco.MjData(model), drive["encoder_bias"]
    per_log, per_run = round(LOG_DT / PLANT_DT), round(LOOP_DT / PLANT_DT)
    data.qpos[:] = command[0] + bias
    seen, position, speed, before = np.empty(len(command)), 0.0, 0.0, 0.0
    for step in range(-round(1.0 / PLANT_DT), (len(command) - 1) * per_log + 1):
        if step >= 0 and step % per_log == 0:
            seen[step // per_log] = data.qpos[0] - bias
        if step % per_run == 0:
            position, speed = data.qpos[0] - bias, data.qvel[0]
        k = int(np.floor(((step + 0.5) * PLANT_DT - drive["delay"]) / LOG_DT))
        target = command[min(max(k, 0), len(command) - 1)]
        force = min(max(KP * (target - position) - KD * speed, -limit), limit)
        # where speeds move before positions a force acts half a step early, and the mean over two steps does not
        data.qfrc_applied[:] = 0.5 * (before + force)
        before = force
        mujoco.mj_step(model, data)
    return seen


def noisy(seen: np.ndarray, kind: str, rng: np.random.Generator) -> np.ndarray:
    """What the encoder shows, (count,) [rad]."""
    white = rng.standard_normal(len(seen))
    if kind == "correlated":
        white = signal.lfilter([np.sqrt(1 - CORRELATION**2)], [1, -CORRELATION], white)
    shown = seen + SIGMA * white
    step = 2 * np.pi / 2**BITS
    return np.round(shown / step) * step if kind == "quantised" else shown


def write_inputs(folder: Path, shown: np.ndarray, command: np.ndarray, limit: float = LIMIT) -> None:
    """``pendulum.xml`` and ``log.npz``, as a user has them."""
    (folder / "pendulum.xml").write_text(MODEL.format(dt=0.002, limit=limit))
    np.savez(
        folder / "log.npz",
        time=LOG_DT * np.arange(len(command)),
        dof_pos=shown[:, None],
        des_dof_pos=command[:, None],
        joint_names=np.array(["joint"]),
        stiffness=KP,
        damping=KD,
    )


@contextlib.contextmanager
def without_report() -> Iterator[None]:
    """No report of a fit."""
    with mock.patch.object(fit_module, "write_report"):
        yield


def one_fit(seed: int, kind: str, drive_dt: float | None) -> tuple[dict[str, float], FitResult]:
    """A truth, and what a fit finds."""
    rng = np.random.default_rng([seed, NOISES.index(kind)])
    drive, command = drawn(rng), motion(rng, round(DURATION / LOG_DT) + 1)
    shown = noisy(simulate(drive, command), kind, rng)
    with tempfile.TemporaryDirectory() as place, contextlib.redirect_stderr(io.StringIO()), without_report():
        folder = Path(place)
        write_inputs(folder, shown, command)
        settings = FitSettings(
            task=str(folder / "pendulum.xml"),
            data=[str(folder / "log.npz")],
            optimizer="least_squares",
            drive_dt=drive_dt,
            log_dir=place,
        )
        result, _ = fit_module.fit(settings, ProgressLine(io.StringIO()))
    return drive, result


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=200)
    parser.add_argument("--first_seed", type=int, default=0)
    parser.add_argument("--noise", choices=NOISES, nargs="+", default=list(NOISES))
    parser.add_argument("--drive_dt", type=float, help="state the loop's rate [s]; left out: nobody states it")
    parser.add_argument("--output", type=Path, help="JSON lines: truth, value and error bar of each fit")
    args = parser.parse_args()
    torch.set_num_threads(1)
    scores: dict[str, list[float]] = {}
    begin, rows = time.process_time(), []
    for i in range(args.fits):
        kind, seed = args.noise[i % len(args.noise)], args.first_seed + i // len(args.noise)
        drive, result = one_fit(seed, kind, args.drive_dt)
        for name, truth in drive.items():
            key = "all" if name == "delay" else "joint"
            value, std = result.parameters[name][key], result.std[name][key]
            scale = result.control_dt if name == "delay" else 1.0
            rows.append([kind, seed, name, truth, value * scale, None if std is None else std * scale])
            if std:
                scores.setdefault(name, []).append((value * scale - truth) / (std * scale))
        told = {name: f"{each[-1]:+.1f}" for name, each in scores.items()}
        print(
            kind,
            seed,
            told,
            f"{result.rmse['train']['all'] * 1e3:.3g} mrad",
            result.loop_rate.get("used_s"),
            flush=True,
        )
        if args.output:
            args.output.write_text("\n".join(json.dumps(row) for row in rows))
    for name, each in scores.items():
        z = np.array(each)
        inside = np.mean(np.abs(z) < 2)
        print(f"{name:18s} {inside:6.1%} of {len(z)} within two error bars; z {z.mean():+.2f} ± {z.std():.2f}")
    print(f"{time.process_time() - begin:.0f} processor seconds")


if __name__ == "__main__":
    main()
