"""Registering environments with Gymnasium and building them: torch and MuJoCo are loaded when one is built."""

from __future__ import annotations

import copy
import difflib
import sys
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium as gym

if TYPE_CHECKING:
    from pace_envs.gym_vector import PaceVectorEnv
    from pace_envs.manager_based_env import ManagerBasedEnvCfg
    from pace_envs.manager_based_rl_env import ManagerBasedRLEnv, ManagerBasedRLEnvCfg
    from pace_envs.motor_coordinates import Rows

_TASKS = {
    "Pace-AnymalD-v0": "pace_envs.tasks.pace.anymal_d:anymal_d_pace_env_cfg",
    "Pace-Go2-v0": "pace_envs.tasks.pace.go2:go2_pace_env_cfg",
    "Pace-SO101-v0": "pace_envs.tasks.pace.so101:so101_pace_env_cfg",
    "Pace-TestBench-v0": "pace_envs.tasks.pace.test_bench:test_bench_pace_env_cfg",
    "Pace-AnymalD-Velocity-v0": "pace_envs.tasks.velocity.anymal_d:anymal_d_velocity_env_cfg",
    "Pace-Go2-Velocity-v0": "pace_envs.tasks.velocity.go2:go2_velocity_env_cfg",
    "Pace-SO101-Reach-v0": "pace_envs.tasks.reach.reach_env_cfg:so101_reach_env_cfg",
}

_REGISTERED_BY: dict[str, dict[str, Any]] = {}
"""Globals of the module that registered a task, by the task's name."""


def register_envs() -> None:
    """Register the project's environments with Gymnasium, once; ``import pace_envs`` does it."""
    for task, entry_point in _TASKS.items():
        if task not in gym.registry:
            register_task(task, entry_point)


def register_task(task: str, env_cfg_entry_point: str | Callable[[], ManagerBasedRLEnvCfg]) -> None:
    """Register an environment, for ``gym.make(task, num_envs=…)`` and ``gym.make_vec(task, num_envs=…)``.

    Args:
        task: Its name, such as ``"Pace-MyRobot-v0"``.
        env_cfg_entry_point: A function that returns its configuration, or ``"module:function"``.

    Raises:
        ValueError: If the name is taken.
    """
    caller, before = sys._getframe(1).f_globals, _REGISTERED_BY.get(task)
    if before is not None and before is not caller and before["__name__"] == caller["__name__"] != __name__:
        del gym.registry[task]  # a module of that name, since replaced by one of another folder, had registered it
    if task in gym.registry:
        raise ValueError(f"An environment named {task!r} is already registered. Choose another name.")
    _REGISTERED_BY[task] = caller
    gym.register(
        id=task,
        entry_point="pace_envs.registration:make_env",
        vector_entry_point="pace_envs.registration:make_vector_env",
        disable_env_checker=True,
        order_enforce=False,
        kwargs={"env_cfg_entry_point": env_cfg_entry_point},
    )


def registered_tasks() -> list[str]:
    """Names of all environments that were registered this way."""
    return sorted(name for name, spec in gym.registry.items() if "env_cfg_entry_point" in spec.kwargs)


def registered_by(task: str) -> str | None:
    """The module that registered a task, by the task's name; ``None`` if this package did, or no module."""
    module = _REGISTERED_BY.get(task, {}).get("__name__", __name__)
    return None if module.partition(".")[0] == "pace_envs" else module


def load_env_cfg(task: str, control_dt: float | None = None, motors: Rows | None = None) -> Any:
    """A fresh configuration of an environment; nothing is imported to find it.

    Args:
        task: Its registered name, also after ``module:`` or ``path/to/file.py:``; or a model file.
        control_dt: Time between two commands [s], of a model file; ``None``: 2.5 ms.
        motors: Motors that move several joints of a model file and that it does not have, {motor: {joint: ratio}}.

    Raises:
        ValueError: If there is no such environment, or it states its control step itself.
    """
    from pace_envs.model_file import is_model_file

    if is_model_file(task):
        from pace_envs.from_model import cfg_from_model  # its configuration is one of this package

        return cfg_from_model(task, motors=motors, **({} if control_dt is None else {"control_dt": control_dt}))
    if control_dt is not None:
        raise ValueError(
            f"control_dt is {control_dt:g} s, which only a model file (.xml, .urdf) needs: {task} states its "
            "control step. Omit --control_dt, or change sim.dt and decimation in its configuration."
        )
    module, _, task = task.rpartition(":")
    if task not in registered_tasks():
        if module:
            known = ", ".join(name for name in _REGISTERED_BY if registered_by(name)) or "none"
            raise ValueError(
                f"{module} registered no environment {task!r}; registered were {known}. Register it there with "
                f"pace_envs.register_task. In Python, import {module} first: only commands import it."
            )
        close = difflib.get_close_matches(task, registered_tasks(), n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise ValueError(
            f"There is no environment {task!r}.{hint} Available: {', '.join(registered_tasks())}. "
            "Register your own with pace_envs.register_task."
        )
    return _load(gym.registry[task].kwargs["env_cfg_entry_point"])


def make_env(
    env_cfg_entry_point: str | Callable[[], ManagerBasedRLEnvCfg],
    cfg: ManagerBasedRLEnvCfg | None = None,
    num_envs: int | None = None,
    physics_dt: float | None = None,
    delay_mode: str | None = None,
    seed: int | None = None,
    render_mode: str | None = None,
    device: str | None = None,
) -> ManagerBasedRLEnv:
    """Build an environment; ``gym.make`` calls this.

    Args:
        env_cfg_entry_point: Where its configuration comes from.
        physics_dt: A finer physics time step under the same control rate [s].
        delay_mode: ``"command"`` or ``"effort"``, for all drives.
        seed: Seed of all random draws.
        render_mode: ``None`` or ``"rgb_array"``.
        device: ``"cpu"`` or a GPU, ``"cuda:0"``.
    """
    from pace_envs.manager_based_rl_env import ManagerBasedRLEnv

    env_cfg = copy.deepcopy(cfg) if cfg is not None else _load(env_cfg_entry_point)
    if num_envs is not None:
        env_cfg.scene.num_envs = num_envs
    if seed is not None:
        env_cfg.seed = seed
    if device is not None:
        env_cfg.sim.device = device
    if physics_dt is not None:
        set_physics_dt(env_cfg, physics_dt)
    if delay_mode is not None:
        for drive in env_cfg.scene.robot.actuators.values():
            drive.delay_mode = delay_mode
    return ManagerBasedRLEnv(env_cfg, render_mode)


def make_vector_env(num_envs: int = 1, **kwargs: Any) -> PaceVectorEnv:
    """Build Gymnasium's vector form of an environment; ``gym.make_vec`` calls this."""
    from pace_envs.gym_vector import PaceVectorEnv

    return PaceVectorEnv(make_env(num_envs=num_envs, **kwargs))


def set_physics_dt(cfg: ManagerBasedEnvCfg, physics_dt: float, name: str = "physics_dt") -> None:
    """Make the physics step finer; the controllers, and the environment, keep their rates.

    The finer steps are of second order (``"leapfrog"``).

    Args:
        cfg: The environment; it is changed.
        physics_dt: The finer step [s].
        name: What asks for it, for the message.

    Raises:
        ValueError: If the present time step is no multiple of the finer one.
    """
    ratio = round(cfg.sim.dt / physics_dt) if physics_dt > 0 else 0
    if ratio < 1 or abs(ratio * physics_dt - cfg.sim.dt) > 1e-9:
        raise ValueError(
            f"{name} is {physics_dt:g} s, expected a whole fraction of the time step {cfg.sim.dt:g} s, "
            f"such as {cfg.sim.dt / 5:g}."
        )
    if ratio == 1:
        return
    cfg.sim.dt /= ratio
    cfg.decimation *= ratio
    cfg.sim.integrator = "leapfrog"
    for drive in cfg.scene.robot.actuators.values():
        drive.control_decimation *= ratio


def _load(entry_point: str | Callable[[], Any]) -> Any:
    from pace_envs.manager_based_env import ManagerBasedEnvCfg

    if isinstance(entry_point, str):
        module, _, name = entry_point.partition(":")
        entry_point = getattr(import_module(module), name)
    cfg = copy.deepcopy(entry_point())  # type: ignore[operator]
    if not isinstance(cfg, ManagerBasedEnvCfg):
        raise ValueError(
            f"{entry_point} returned {cfg!r}, expected the configuration of an environment. Return a "
            "ManagerBasedRLEnvCfg, such as PaceSim2realEnvCfg."
        )
    cfg.prepare()
    return cfg
