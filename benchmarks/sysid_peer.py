"""``mujoco.sysid`` on the drive problem, used as its documentation does."""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from drive_problem import FITTED, DriveProblem
from solver_trace import Trace

from pace_envs.robot_spec import load_robot_spec
from pace_envs.simulation import Simulation

_SETTERS: dict[str, Callable[[Any, float], None]] = {
    "armature": lambda joint, value: setattr(joint, "armature", value),
    "viscous_friction": lambda joint, value: setattr(joint, "damping", [value, 0.0, 0.0]),  # a polynomial in the speed
    "friction": lambda joint, value: setattr(joint, "frictionloss", value),
}


def load_peer() -> Any:
    """The package ``mujoco.sysid``.

    Raises:
        ValueError: If what it needs is not installed.
    """
    from mujoco import sysid

    if not hasattr(sysid, "optimize"):  # it swallows its own import error
        raise ValueError(
            "mujoco.sysid lacks packages that it needs. Install them with: pip install 'pace-mujoco[benchmark]'"
        )
    logging.getLogger("absl").setLevel(logging.ERROR)  # it warns that the recording holds positions, no sensors
    return sysid


class Peer:
    """The peer's model, parameters and residual of the same problem."""

    def __init__(self, case: DriveProblem):
        """Put the drive into the model and lay out the recording.

        Raises:
            ValueError: If the peer is not installed.
        """
        self.sysid = load_peer()
        self.case = case
        names = case.problem.joint_names
        recording = case.recording
        qpos, times = recording.dof_pos, recording.time
        sequences = self.sysid.ModelSequences(
            "anymal_d",
            peer_spec(case),
            recording.name,
            self._initial_state(qpos[0]),
            self.sysid.TimeSeries(times, recording.des_dof_pos),
            # positions are taken from the state: a sensor's value is that before the step
            self.sysid.TimeSeries(
                times,
                qpos,
                {f"{name}_qpos": (self.sysid.SignalType.MjStateQPos, np.array([i])) for i, name in enumerate(names)},
            ),
            allow_missing_sensors=True,
        )
        self.residual = self.sysid.build_residual_fn(models_sequences=[sequences], resample_true=False)
        self.scale = np.linalg.norm(qpos[1:], axis=0) / np.sqrt(2)
        """What the peer divides each joint's errors by [rad]."""

    def parameters(self, values: np.ndarray | None = None) -> Any:
        """The peer's parameters, at given physical values (36,) or at the centre of the bounds."""
        space, sysid = self.case.problem.space, self.sysid
        lower, upper = (bound[self.case.fitted].numpy().reshape(3, -1) for bound in (space.lower, space.upper))
        start = (lower + upper) / 2 if values is None else np.asarray(values).reshape(3, -1)
        result = sysid.ParameterDict()
        for row, name in enumerate(FITTED):
            result.add(sysid.Parameter(name, start[row], lower[row], upper[row], modifier=self._modifier(name)))
        return result

    def error(self, values: np.ndarray) -> np.ndarray:
        """Errors of physical values (36,) after the first sample, (T - 1, 12) [rad]."""
        residuals, _, _ = self.residual(values, self.parameters())
        return -residuals[0].reshape(-1, len(self.scale)) * self.scale

    def run(self, optimizer: str, **options: Any) -> Trace:
        """Let the peer identify from the centre of the bounds.

        Args:
            optimizer: The peer's name of its optimizer, such as ``"mujoco"`` or ``"scipy"``.
            options: Of the peer's ``optimize``.
        """
        trace = Trace(solver=f"mujoco.sysid ({optimizer})")
        again = Peer(self.case)  # building the model counts
        steps_each = len(self.case.recording.time) - 1
        simulations = 0

        def residual(x: np.ndarray, params: Any, **kwargs: Any) -> Any:
            nonlocal simulations
            result = again.residual(x, params, **kwargs)
            vectors = np.asarray(x).reshape(len(x), -1)
            simulations += vectors.shape[1]
            if vectors.shape[1] == 1:
                errors = result[0][0].reshape(-1, len(again.scale)) * again.scale
                score = float(np.square(errors).sum() / (steps_each + 1))
                trace.add(score, self.case.relative_error(vectors[:, 0].copy()), simulations * steps_each)
            return result

        with contextlib.redirect_stdout(io.StringIO()):  # it prints every iteration
            _, outcome = self.sysid.optimize(again.parameters(), residual, optimizer, verbose=False, **options)
        objective = (outcome.get("extras") or {}).get("objective")
        trace.end(outcome.get("njev", 0) if objective is None else len(objective) - 1, simulations * steps_each)
        return trace

    def _modifier(self, name: str) -> Any:
        write, joints = _SETTERS[name], self.case.problem.joint_names

        def modify(spec: mujoco.MjSpec, parameter: Any) -> None:
            for joint, value in zip(joints, parameter.value, strict=True):
                write(spec.joint(joint), float(value))

        return modify

    def _initial_state(self, position: np.ndarray) -> np.ndarray:
        names = list(self.case.problem.joint_names)
        model = peer_spec(self.case).compile()
        return self.sysid.create_initial_state(model, position, qpos_names=[f"{name}_qpos" for name in names])


def peer_spec(case: DriveProblem) -> mujoco.MjSpec:
    """The same model with its drives as position actuators: torque = clip(kp (target - q) - kd v, ±limit).

    The integrator is Euler, whose implicit joint damping is what ``implicitfast`` makes of a model without actuators;
    with ``implicitfast`` MuJoCo would treat the actuators' kd implicitly too, which is another drive.
    """
    cfg = case.problem.env_cfg
    spec = load_robot_spec(cfg.scene.robot)
    Simulation(cfg.sim, spec, 1).close()  # the same options and joint friction
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    (drive,) = cfg.scene.robot.actuators.values()
    for name in case.problem.joint_names:
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=drive.stiffness, kv=drive.damping)
        actuator.forcelimited = True
        actuator.forcerange = [-drive.effort_limit, drive.effort_limit]
    return spec
