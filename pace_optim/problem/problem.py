"""Everything that a fit starts from: task, recordings, parameters, trees, and how to build environments."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self

import torch

from pace_actuators.base_parameters import BASE_PARAMETERS
from pace_actuators.drive_result import LinkInertia
from pace_actuators.effects import PROBED_STIFFNESS, EffectCfg, effect_cfgs, probe_points
from pace_actuators.joint_units import JointType
from pace_envs import ManagerBasedRLEnv, load_env_cfg, set_physics_dt
from pace_envs.from_model.defaults import SHORTEST_CONTROL_DT, physics_steps
from pace_envs.link_inertia import Reference
from pace_envs.model_file.read import is_model_file
from pace_envs.motor_coordinates import Rows
from pace_envs.simulation import Simulation
from pace_envs.tasks.pace import GLOBAL, PaceCfg, PaceSim2realEnvCfg, sought_links
from pace_optim.problem.drive_steps import (
    check_loops,
    least_armature,
    loop_dt,
    of_joints,
    set_control_step,
    set_drive_rate,
    set_drive_step,
)
from pace_optim.problem.evaluator import Evaluator
from pace_optim.problem.kinematic_trees import independent_trees
from pace_optim.problem.log_and_robot import (
    contradicted_limits,
    drive_reach,
    loop_stiffness,
    refuse_open_loops,
    told_of_gains,
    widen_bounds,
    with_work,
    without_loops_of_torques,
)
from pace_optim.problem.moving_base import BasePath, base_path, on_moving_base
from pace_optim.problem.parameter_space import Colouring, ParameterSpace, colour
from pace_optim.problem.recordings import Logs, conform_all, motors_of_logs, read_logs, tell_on_stderr
from pace_optim.problem.unknown_facts import (
    GAINS,
    LIMITS,
    lift_limits,
    refined_limits,
    with_identified,
    with_unknown,
)
from pace_optim.recording import Recording
from pace_optim.recording.dataset import Dataset, Torques, make_dataset
from pace_optim.recording.parts import affordable
from pace_optim.recording.torque import MeasuredDrives, TorqueChannel, read_drives, torque_channel
from pace_optim.recording.windows import Windows
from pace_optim.terminal.choices import DELAY_MODES

_SHORTER = 0.95
"""Commands that come at this part of a control step, or faster, are faster."""
_STATED_FACTS: dict[str, Literal["stiffness", "effort_limit"]] = {"gains": "stiffness", "effort limit": "effort_limit"}
"""Facts whose notes on the model file do not hold where all recordings state them."""


@dataclass(kw_only=True, eq=False)
class Problem:
    """One identification problem."""

    task: str
    plain_cfg: PaceSim2realEnvCfg
    """The environment before effects and a finer physics step."""
    env_cfg: PaceSim2realEnvCfg
    """The environment with them."""
    dataset: Dataset
    space: ParameterSpace
    trees: list[list[str]]
    delay_mode: Literal["command", "effort"]
    control_dt: float
    """Control step [s]."""
    contradictions: tuple[str, ...] = ()
    """Limits that are stated of the drives and that the recordings contradict, in sentences."""
    device: str = "cpu"
    """Where environments are built."""
    measured: MeasuredDrives = field(default_factory=MeasuredDrives)
    """What the recordings' torques say of the drives."""
    unknown: tuple[str, ...] = ()
    """Unknown facts of the drives, which are identified."""
    passive_joints: bool = False
    """Whether joints without drives move too."""
    logged_rate: bool = False
    """Whether the control step is that of the log's commands, as nothing states one."""
    assumed_loop: float | None = None
    """Assumed period of the drives' loops [s]; 0: continuous. ``None``: it is stated."""
    imu_delays: Mapping[str, float] = field(default_factory=dict)
    """How much later than encoders IMUs are read [s], by recording; the dataset has them in time."""
    torque_notes: tuple[str, ...] = ()
    """Which measured torques are followed and which are not, in sentences."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints, in order."""
        return tuple(self.env_cfg.sim2real.joint_order)

    @property
    def joint_types(self) -> tuple[JointType, ...]:
        """Whether each joint turns or slides."""
        slides = self.env_cfg.sim2real.slide_joints
        return tuple("slide" if joint in slides else "hinge" for joint in self.joint_names)

    @property
    def physics_dt(self) -> float:
        """Physics step [s]."""
        return self.env_cfg.sim.dt

    @property
    def coarsest_dt(self) -> float:
        """Longest physics step that the drives allow [s]: the control step, unless a drive runs faster."""
        return self.plain_cfg.sim.dt

    def for_search(self, device: str = "cpu") -> Problem:
        """The same on a device, and at a longer physics step where steps of second order are stable there."""
        second_order = self.plain_cfg.sim.integrator == "leapfrog"
        problem = self.with_physics_dt(self.coarsest_dt) if second_order else self
        return problem if device == problem.device else replace(problem, device=device)

    @property
    def effects(self) -> list[str]:
        """The effects whose parameters are identified, as on the command line."""
        return [cfg.label for cfg in effect_cfgs(self.env_cfg.sim2real.effects)]

    @property
    def joints_stand_alone(self) -> bool:
        """Whether no joint moves another."""
        return not self.passive_joints and max(len(tree) for tree in self.trees) == 1

    def make_env(self, num_envs: int, simulation: Callable[..., Simulation] | None = None) -> ManagerBasedRLEnv:
        """Build the environment.

        Args:
            simulation: What builds its simulation; ``None`` keeps the configuration's.
        """
        cfg = copy.deepcopy(self.env_cfg)
        cfg.scene.num_envs = num_envs
        cfg.sim.device = self.device
        cfg.sim.class_type = simulation or cfg.sim.class_type
        return ManagerBasedRLEnv(cfg)

    def with_effects(self, effects: Sequence[EffectCfg | str]) -> Self:
        """The same recordings with other effects."""
        cfg = _configured(self.plain_cfg, self.physics_dt, effects)
        return replace(self, env_cfg=cfg, space=ParameterSpace.of(cfg.sim2real))

    @cached_property
    def colouring(self) -> Colouring:
        """Which entries are perturbed together."""
        return colour(self.space, self.trees, self.joint_names)

    @property
    def structures(self) -> dict[str, tuple[float, ...]]:
        """Values that parameters can have between which no descent leads, by label (see ``Effect.structural``)."""
        result: dict[str, tuple[float, ...]] = {}
        every = (cfg.effect_class for cfg in effect_cfgs(self.env_cfg.sim2real.effects))
        for effect in dict.fromkeys(each for each in every if each.structural):
            name = f"{effect.name}.{effect.structural}"
            values = tuple(sorted({point[effect.structural] for point in probe_points(effect)}))
            result |= {label: values for label in self.space.labels if label.split("/")[0] == name}
        return result

    def at_probes(self, physical: torch.Tensor, structure: float) -> list[torch.Tensor]:
        """A physical vector (size,) with effects at each of their probes that has a value of their structure."""
        sim2real, result = self.env_cfg.sim2real, []
        for effect in dict.fromkeys(cfg.effect_class for cfg in effect_cfgs(sim2real.effects)):
            points = probe_points(effect) if effect.structural else []
            for point in (each for each in points if each[effect.structural] == structure):
                own = physical.clone()
                for parameter in effect.parameters:
                    name = f"{effect.name}.{parameter.name}"
                    keys = next(p.keys for p in self.space.parameters if p.name == name)
                    loops = [sim2real.joint_stiffness.get(key, PROBED_STIFFNESS) for key in keys]
                    sizes = [loop / PROBED_STIFFNESS if parameter.follows_loop else 1.0 for loop in loops]
                    own[self.space[name]] = point[parameter.name] * torch.tensor(sizes, dtype=own.dtype)
                result.append(own)
        return result

    def holding(self, values: Mapping[str, float]) -> Problem:
        """The same with some entries held at physical values, by label."""
        physical = self.space.to_physical(self.space.start)
        for label, value in values.items():
            physical[self.space.labels.index(label)] = value
        return replace(self, space=self.space.holding(tuple(values), physical))

    def reaching(self, bounds: Mapping[str, tuple[float, float]]) -> Problem:
        """The same, its base parameters sought as far as another problem sought them too.

        Args:
            bounds: Lower and upper bound by label, ``<parameter>/<joint>``; of this problem's parameters alone.
        """

        def widen(sim2real: PaceCfg) -> None:
            for name, own in sim2real.bounds.items():
                keys = (GLOBAL,) if BASE_PARAMETERS[name].shared else self.joint_names
                other = own.new_tensor(
                    [bounds.get(f"{name}/{key}", pair) for key, pair in zip(keys, own.tolist(), strict=True)]
                )
                sim2real.set_bounds(name, torch.minimum(own, other)[:, 0], torch.maximum(own, other)[:, 1])

        return self._changed(widen)

    def _changed(self, change: Callable[[PaceCfg], object]) -> Problem:
        """The same with another configuration of what is identified."""
        plain, cfg = copy.deepcopy(self.plain_cfg), copy.deepcopy(self.env_cfg)
        for each in (plain, cfg):
            change(each.sim2real)
        return replace(self, plain_cfg=plain, env_cfg=cfg, space=ParameterSpace.of(cfg.sim2real))

    def with_physics_dt(self, physics_dt: float) -> Self:
        """The same with another physics step [s]."""
        return replace(self, env_cfg=_configured(self.plain_cfg, physics_dt, self.env_cfg.sim2real.effects))

    def with_loop(self, drive_dt: float, physics_dt: float | None = None) -> Problem:
        """The same with another step of the drives' loops, and a physics step of at most that [s]; 0: continuous."""
        plain = copy.deepcopy(self.plain_cfg)
        _set_drive_dt(plain, drive_dt)
        set_drive_rate(plain)
        longest = plain.sim.dt
        finest = longest / max(1, math.ceil(longest / (physics_dt or self.physics_dt) * (1 - 1e-9)))
        return replace(self, plain_cfg=plain, env_cfg=_configured(plain, finest, self.env_cfg.sim2real.effects))

    def as_found(self, parameters: Mapping[str, Mapping[str, float]], undetermined: Iterable[str]) -> Problem:
        """The same with unknown gains and limits as a fit found them, where its recordings determine them."""
        told = with_identified(self.plain_cfg, self.dataset.recordings, self.unknown, parameters, undetermined)
        return replace(self, dataset=replace(self.dataset, recordings=tuple(told)))

    def seeking(self, links: Sequence[Reference]) -> Problem:
        """The same with the inertial parameters of these links identified."""
        return self._changed(lambda sim2real: setattr(sim2real, "links", tuple(links)))

    def with_links(self, links: Mapping[str, LinkInertia]) -> Problem:
        """The same with these inertial parameters of links, which are not identified any more."""
        known = self.seeking(())
        for each in (known.plain_cfg, known.env_cfg):
            each.scene.robot.links = {**each.scene.robot.links, **links}
        return known

    def on_positions(self) -> Problem:
        """The same without the torques that are followed."""
        without = self._changed(lambda sim2real: setattr(sim2real, "torque_offsets", {}))
        return replace(without, dataset=replace(self.dataset, torques=None))

    @property
    def torque_noise(self) -> dict[str, float]:
        """Noise that torques are weighed by, by joint [N m]; none where none is followed."""
        torques = self.dataset.torques
        return {} if torques is None else self._followed(torques, torques.noise)

    @property
    def torque_floor(self) -> dict[str, float]:
        """What it is at least."""
        torques = self.dataset.torques
        return {} if torques is None else self._followed(torques, torques.floor)

    def _followed(self, torques: Torques, values: torch.Tensor) -> dict[str, float]:
        """Values of joints whose torques are followed, by joint."""
        each = zip(self.joint_names, values.tolist(), torques.weight.tolist(), strict=True)
        return {joint: value for joint, value, weight in each if weight > 0}

    def with_torque_noise(self, noise: Mapping[str, float]) -> Problem:
        """The same with other noise of the torques that are followed, by joint [N m]."""
        if (torques := self.dataset.torques) is None:
            return self
        values = torch.tensor([noise.get(joint, 0.0) for joint in self.joint_names], dtype=torch.float64)
        return replace(self, dataset=replace(self.dataset, torques=torques.with_noise(values)))

    def with_imu_delays(self, delays: Mapping[str, float]) -> Problem:
        """The same with IMUs that are read later than encoders by so much [s], by the name of whole recordings."""
        if not delays:
            return self
        every = {name: self.imu_delays.get(name, 0.0) + delay for name, delay in delays.items()}
        return replace(self, dataset=self.dataset.with_imu_delays(delays), imu_delays={**self.imu_delays, **every})

    @property
    def loop_dt(self) -> float:
        """Shortest time between two runs of the drives' loops [s]; 0: one runs continuously."""
        return loop_dt(self.plain_cfg, self.control_dt)

    @property
    def assumes_loop_rate(self) -> bool:
        """Whether the rate of the drives' loops is not stated."""
        return self.assumed_loop is not None

    def evaluator(self) -> Evaluator:
        """An evaluator of candidates on all recordings."""
        return Evaluator(self.make_env, self.dataset, self.space, self.trees)

    def training_evaluator(self) -> Evaluator:
        """An evaluator of candidates on the recordings that are trained on; derivatives take the longest step."""
        return self.evaluator_like(self)

    def evaluator_like(self, like: Problem) -> Evaluator:
        """The same by derivatives of a problem that moves almost alike."""
        data, nearby = self.dataset.select(self.dataset.trained()), None
        if like.coarsest_dt > self.physics_dt:
            nearby = Evaluator(like.with_physics_dt(like.coarsest_dt).make_env, data, self.space, self.trees)
        return Evaluator(self.make_env, data, self.space, self.trees, nearby=nearby)

    @cached_property
    def base_paths(self) -> list[BasePath | None]:
        """How the base of each recording went; ``None``: it rests."""
        if self.dataset.carried is None:
            return [None] * self.dataset.num_recordings
        env = self.make_env(1)
        paths = [base_path(recording, env.sim.model, self.joint_names) for recording in self.dataset.recordings]
        env.close()
        return paths

    def on_pieces(self, share: float) -> Problem:
        """The same, trained on windows of what the recordings train on, a share of each."""
        windows = Windows.of(self.dataset, self.control_dt).with_samples(self.dataset.train).part(share)
        return replace(self, dataset=windows.cut(self.dataset))


@dataclass(frozen=True, kw_only=True, eq=False)
class Facts:
    """A robot as its task states it, with the rates that a fit asks for; its configuration is copied, never changed."""

    task: str
    cfg: PaceSim2realEnvCfg
    """Its environment, before effects and a finer physics step."""
    delay_mode: str | None
    physics_dt: float | None
    """Physics step that is asked for [s]."""
    drive_dt: float | None
    """Time between two runs of the drives' loops that is asked for [s]; 0: continuous."""
    follows_log: bool
    """Whether commands come as fast as the log's: nothing states the control step of a model file."""
    logged_rate: bool = False
    """Whether they do."""
    motors: Rows = field(default_factory=dict)
    """Motors that move several joints, as recordings state them."""

    @classmethod
    def read(
        cls,
        task: str,
        env_cfg: Any = None,
        *,
        control_dt: float | None = None,
        delay_mode: str | None = None,
        physics_dt: float | None = None,
        drive_dt: float | None = None,
        motors: Rows | None = None,
    ) -> Facts:
        """Read what a task says of its robot; the arguments are those of :func:`load_problem`."""
        of_file = motors if is_model_file(task) else None
        cfg = load_env_cfg(task, control_dt, of_file) if env_cfg is None else copy.deepcopy(env_cfg)
        if not isinstance(cfg, PaceSim2realEnvCfg):
            raise ValueError(f"{task} is no identification task. Choose one with scripts/list_envs.py.")
        if delay_mode is not None and delay_mode not in DELAY_MODES:
            raise ValueError(f"Unknown delay mode {delay_mode!r}. Available: {', '.join(DELAY_MODES)}.")
        cfg.prepare()
        set_control_step(cfg)
        longest = float(cfg.sim2real.bounds["delay"][0, 1])
        for drive in cfg.scene.robot.actuators.values():
            drive.delay_mode = delay_mode or drive.delay_mode  # type: ignore[assignment]
            if drive.largest_delay < longest:
                step = 1e3 * cfg.sim.dt * cfg.decimation
                raise ValueError(
                    f"The delay's upper bound is {longest * step:g} ms ({longest:g} control steps), but the drive "
                    f"allows {drive.largest_delay * step:g} ms (max_delay = {drive.largest_delay:g}). Raise max_delay "
                    "in the robot's PaceDCMotorCfg or lower the bound."
                )
        if drive_dt is not None:
            _set_drive_dt(cfg, drive_dt)
        return cls(
            task=task,
            cfg=cfg,
            delay_mode=delay_mode,
            physics_dt=physics_dt,
            drive_dt=drive_dt,
            motors=motors or {},
            follows_log=env_cfg is None and control_dt is None and is_model_file(task),
        )

    @property
    def control_dt(self) -> float:
        """Time between two commands [s]."""
        return self.cfg.sim.dt * self.cfg.decimation

    def with_logs(self, logs: Logs) -> Facts:
        """The same with what logs say: the rate of their commands, where it follows them, and the joints they hold."""
        facts = self
        if self.follows_log and logs.command_dt < _SHORTER * self.control_dt:
            facts = Facts.read(
                self.task,
                control_dt=max(logs.command_dt, SHORTEST_CONTROL_DT),
                delay_mode=self.delay_mode,
                physics_dt=self.physics_dt,
                drive_dt=self.drive_dt,
                motors=self.motors,
            )
            facts = replace(facts, logged_rate=True)
        stated = {
            f"{name}: ": f"{name}: as the recordings state" for name, fact in _STATED_FACTS.items() if logs.state(fact)
        }
        known = any(note.startswith(tuple(stated)) for note in facts.cfg.sim2real.notes)
        if not logs.held and not logs.note and not known:
            return facts
        cfg = copy.deepcopy(facts.cfg).holding(logs.held)
        cfg.prepare()
        said = (next((new for old, new in stated.items() if note.startswith(old)), note) for note in cfg.sim2real.notes)
        cfg.sim2real.notes = (*said, *filter(None, [logs.note]))
        return replace(facts, cfg=cfg)

    def make_env(self) -> ManagerBasedRLEnv:
        """One environment of the robot, at the rate of its drives; its configuration is its own."""
        cfg = copy.deepcopy(self.cfg)
        cfg.scene.num_envs = 1
        set_drive_rate(cfg, self.physics_dt)
        return ManagerBasedRLEnv(cfg)


def load_problem(
    task: str,
    *,
    data: Sequence[str | Path] = (),
    validation: Sequence[str | Path] = (),
    delay_mode: str | None = None,
    physics_dt: float | None = None,
    drive_dt: float | None = None,
    control_dt: float | None = None,
    effects: Sequence[EffectCfg | str] = (),
    links: Sequence[str] = (),
    unknown: Sequence[str] = (),
    residual: Sequence[str] = (),
    env_cfg: Any = None,
    joints: str | None = None,
    columns: str | Path | None = None,
    facts: str | Path | None = None,
    rate: float | None = None,
    strict: bool = False,
    max_duration: float | None = None,
    tell: Callable[[str], None] = tell_on_stderr,
) -> Problem:
    """Read and check everything that a fit needs: what is known of the robot, its logs, then the problem they pose.

    Args:
        task: Registered name of the environment, or a model file.
        data: Recordings to train on; none means the robot's own sample.
        validation: Recordings that are never trained on; none keeps the last 30 % of each recording for that.
        delay_mode: ``"command"`` or ``"effort"``; ``None`` keeps the configuration's.
        physics_dt: A finer physics step under the same control rate [s].
        drive_dt: Time between two runs of the drives' own controllers [s]; 0: they run continuously; ``None`` keeps
            the configuration's.
        control_dt: Time between two commands to a model file's robot [s]; ``None``: as logged, at most 2.5 ms.
        effects: Physical effects beyond the base model, ``"name"``, ``"name@joints"`` or ``"name@shared"``; none
            keeps the configuration's.
        links: Links whose inertial parameters are identified, regular expressions of their names: ``"name"`` or
            ``"name@mass,com,inertia"`` with some of these.
        unknown: Unknown facts of the drives (:data:`UNKNOWN_FACTS`): read from the recordings' torques where
            they have them, else identified.
        residual: What a fit follows: ``"position"`` and ``"effort"``; none: positions alone.
        env_cfg: The task's configuration, if it has been loaded; it is not changed.
        joints: Regular expression of the joints to identify; the others are held. ``None``: those of the recordings.
        columns: Column map of logs that are not in this project's own form; ``None``: guessed.
        facts: JSON file of what is true of all recordings (gains, limits, loads), where they do not state it.
        rate: Rows per second of logs that have no column of time [Hz].
        strict: Whether one recording that cannot be used refuses all, instead of being set aside.
        max_duration: How long each recording may be [s], cut to the parts that move the joints most; ``None``: as long
            as a fit can afford.
        tell: Gets what was understood of logs, set aside, and cut.

    Raises:
        ValueError: If anything does not fit.
    """
    stated = Facts.read(
        task,
        env_cfg,
        control_dt=control_dt,
        delay_mode=delay_mode,
        physics_dt=physics_dt,
        drive_dt=drive_dt,
        motors=motors_of_logs(task, [*data, *validation], columns),
    )
    env = stated.make_env()
    try:
        files = (data or [stated.cfg.sim2real.recording], validation)
        logs = read_logs(files, env, joints=joints, columns=columns, facts=facts, rate=rate, strict=strict, tell=tell)
        if logs.note:
            tell(f"note: {logs.note}")
        known = stated.with_logs(logs)
        if known is not stated:
            env.close()
            env = known.make_env()
        return _posed(
            known, logs, env, effects, links, unknown, residual, strict=strict, max_duration=max_duration, tell=tell
        )
    finally:
        env.close()


def _posed(
    facts: Facts,
    logs: Logs,
    env: ManagerBasedRLEnv,
    effects: Sequence[EffectCfg | str],
    links: Sequence[str],
    unknown: Sequence[str],
    residual: Sequence[str],
    *,
    strict: bool,
    max_duration: float | None,
    tell: Callable[[str], None],
) -> Problem:
    """The problem that logs pose; what they say of bounds, limits and starts is written into the configuration."""
    cfg: PaceSim2realEnvCfg = env.cfg  # type: ignore[assignment]
    sim2real, robot, control_dt = cfg.sim2real, env.scene["robot"], facts.control_dt
    sim2real.slide_joints = robot.slide_joints
    sim2real.links = sought_links(env.sim.model, robot.joint_names, links)
    groups = [conform_all(group, env, control_dt, strict=strict, tell=tell) for group in logs.groups]
    groups = [[on_moving_base(recording, env) for recording in group] for group in groups]
    if any(recording.base_moves for group in groups for recording in group):
        sim2real.physics_steps = max(sim2real.physics_steps, physics_steps(control_dt))
    physics_dt = set_drive_step(cfg, env) if facts.physics_dt is None else facts.physics_dt
    groups = [[without_loops_of_torques(env, recording) for recording in group] for group in groups]
    sim2real.joint_ranges = _ranges(env, groups[0])
    sim2real.joint_efforts = drive_reach(env, groups[0])
    sim2real.joint_stiffness = loop_stiffness(env, groups[0])
    if is_model_file(facts.task):
        widen_bounds(sim2real, env, groups[0])
    count = len(groups[0])
    asked = unknown
    measured, unknown, channel = _read_torques(env, [*groups[0], *groups[1]], control_dt, unknown, residual)
    told, bounds = lift_limits(cfg, measured.recordings, unknown)
    effects = list(effects or sim2real.effects)
    if channel.noise and not LIMITS.keys() & set(unknown):
        cut = channel.noise.keys() & measured.taken.get("effort_limit", frozenset())
        told, limits, effects = refined_limits(told, cut, effects)
        bounds, unknown = {**bounds, **limits}, (*unknown, *(["effort_limit"] if limits else []))
    gains = measured.gain_bounds(unknown, GAINS, channel.noise)
    for fact in GAINS.keys() & (set(unknown) - set(asked)):  # gains that are stated beside those that are read
        gains[GAINS[fact]] = dict.fromkeys(sim2real.joint_order, (1.0, 1.0, 1.0)) | gains.get(GAINS[fact], {})
    sim2real.effect_bounds = {**sim2real.effect_bounds, **bounds, **gains}
    sim2real.torque_offsets = channel.offsets
    if "effort_limit" in asked:
        for drive in robot.actuators.values():
            drive.effort_limit.fill_(math.inf)
    if measured.delay_bounds is not None:  # sought where the recordings' torques have it, or from there
        if channel.noise:
            sim2real.start_params = {**sim2real.start_params, "delay": sum(measured.delay_bounds) / 2}
        else:
            sim2real.set_bounds("delay", *measured.delay_bounds)
    recordings, held_out = (_with_notes(env, each) for each in (told[:count], told[count:]))
    if not {"stiffness", "damping"} & set(unknown):  # sought where the loops are stable, with a width to seek in
        low, high = sim2real.bounds["armature"].unbind(dim=1)
        least = torch.as_tensor(least_armature(env, [*recordings, *held_out]))
        sim2real.set_bounds("armature", torch.maximum(low, torch.minimum(least, 0.5 * (low + high))))
    simulated = _configured(cfg, physics_dt, with_unknown(effects, unknown))
    space, trees = ParameterSpace.of(simulated.sim2real), independent_trees(env)
    recordings, held_out = affordable(
        [recordings, held_out], control_dt, _columns(space, trees), simulated.decimation, max_duration, tell
    )
    refuse_open_loops(env, [*recordings, *held_out])
    dataset = with_work(make_dataset(recordings, held_out), env)
    if channel.noise:
        held = all(
            not drive.implicit and (drive.drive_dt or control_dt) >= control_dt * (1 - 1e-6)
            for drive in cfg.scene.robot.actuators.values()
        )
        dataset = replace(dataset, torques=Torques.of(dataset, channel, held))
    return Problem(
        task=facts.task,
        plain_cfg=cfg,
        env_cfg=simulated,
        dataset=dataset,
        space=space,
        trees=trees,
        delay_mode=next(iter(cfg.scene.robot.actuators.values())).delay_mode,
        control_dt=control_dt,
        measured=measured,
        unknown=unknown,
        torque_notes=channel.notes,
        logged_rate=facts.logged_rate,
        assumed_loop=_assumed_loop(facts, cfg, told, unknown),
        contradictions=(*told_of_gains(env, told, unknown), *_contradictions(env, [*recordings, *held_out])),
        passive_joints=robot.has_passive_joints,
    )


def _assumed_loop(
    facts: Facts, cfg: PaceSim2realEnvCfg, recordings: Sequence[Recording], unknown: Sequence[str]
) -> float | None:
    """Period of loops whose rate is not stated [s].

    A model file states gains at most, and so does a log; only ``drive_dt`` states a rate. Where even the gains are
    assumed, a rate is no more than they are.
    """
    gains = not cfg.sim2real.assumed_gains or any(r.drive.stiffness is not None for r in recordings)
    assumed = is_model_file(facts.task) and facts.drive_dt is None and (gains or "stiffness" in unknown)
    return loop_dt(cfg, facts.control_dt) if assumed else None


def _set_drive_dt(cfg: PaceSim2realEnvCfg, drive_dt: float) -> None:
    """Set the period of all drives' loops [s]; 0: they run continuously."""
    for drive in cfg.scene.robot.actuators.values():
        drive.drive_dt, drive.implicit = drive_dt or None, drive_dt == 0
    said = f"drive loops: they run {f'every {1e3 * drive_dt:g} ms' if drive_dt else 'continuously'}, by --drive_dt"
    cfg.sim2real.notes = tuple(said if note.startswith("drive loops: ") else note for note in cfg.sim2real.notes)


def _read_torques(
    env: ManagerBasedRLEnv,
    recordings: Sequence[Recording],
    control_dt: float,
    unknown: Sequence[str],
    residual: Sequence[str],
) -> tuple[MeasuredDrives, tuple[str, ...], TorqueChannel]:
    """What the recordings' torques show of the drives, what stays unknown, and which torques a fit follows.

    A fact is read if every recording has it of every joint; else it is identified, and all recordings keep what they
    state. Gains that are read are refined, if a fit follows torques or they are declared unknown.
    """
    sim2real = env.cfg.sim2real  # type: ignore[attr-defined]
    low, high = sim2real.bounds["delay"][0].tolist()

    def read(facts: Sequence[str], sensed: Collection[str] = ()) -> MeasuredDrives:
        return read_drives(
            recordings,
            {name: of_joints(env, name) for name in ("stiffness", "damping", "effort_limit")},
            delay_bounds=(low, high),
            delay_mode=next(iter(env.scene["robot"].actuators.values())).cfg.delay_mode,
            control_dt=control_dt,
            unknown=facts,
            assumed=sim2real.assumed_gains,
            slides=sim2real.slide_joints,
            sensed=sensed,
        )

    measured = read(unknown)
    known = [fact for fact in unknown if len(measured.taken.get(fact, ())) == len(sim2real.joint_order)]
    if again := len(known) < len(unknown) and bool(measured.laws):
        measured = read(known)
    channel = TorqueChannel()
    if "effort" in residual:
        why_not = "the base moves" if any(recording.frame is not None for recording in recordings) else ""
        channel = torque_channel(recordings, measured, why_not)
    if channel.noise:
        measured = read(known if again else unknown, channel.noise)
    refined = [fact for fact in GAINS if channel.noise.keys() & measured.taken.get(fact, frozenset())]
    kept = tuple(fact for fact in unknown if fact not in known or fact in GAINS)
    return measured, (*kept, *(fact for fact in refined if fact not in kept)), channel


def _ranges(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> dict[str, tuple[float, float]]:
    """Between which positions each joint moves [rad]: its limits, else where recordings have it."""
    robot = env.scene["robot"]
    limits = robot.data.joint_pos_limits.tolist()
    logged = [(min(r.dof_pos[:, j].min() for r in recordings), max(r.dof_pos[:, j].max() for r in recordings))
              for j in range(robot.num_joints)]  # fmt: skip
    return {
        joint: (low, high) if math.isfinite(high - low) else (float(own[0]), float(own[1]))
        for joint, (low, high), own in zip(robot.joint_names, limits, logged, strict=True)
    }


def _columns(space: ParameterSpace, trees: list[list[str]]) -> int:
    """Parameters whose derivatives take a simulation each: those of one tree are perturbed beside those of others."""
    owners = space.owners(trees)
    return max((owners.count(i) for i in range(len(trees))), default=0) + owners.count(None)


def _configured(
    plain: PaceSim2realEnvCfg, physics_dt: float | None, effects: Sequence[EffectCfg | str]
) -> PaceSim2realEnvCfg:
    cfg = copy.deepcopy(plain)
    cfg.set_effects(effects)
    cfg.sim.sensors = False  # an encoder's positions are all that a recording is compared with
    if physics_dt is not None:
        set_physics_dt(cfg, physics_dt)
    return cfg


def _with_notes(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> list[Recording]:
    """The recordings with notes on their drives' loops."""
    loops = check_loops(env, recordings)
    return [replace(r, notes=(*r.notes, loop)) if loop else r for r, loop in zip(recordings, loops, strict=True)]


def _contradictions(env: ManagerBasedRLEnv, recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Limits of the drives that the recordings contradict."""
    limits = of_joints(env, "velocity_limit"), of_joints(env, "effort_limit")
    types = env.scene["robot"].joint_types
    return tuple(f"{r.name}: {text}" for r in recordings for text in contradicted_limits(r, *limits, types))


def as_vector(problem: Problem, values: dict) -> torch.Tensor:
    """The normalised vector of a result's ``parameters``."""
    return problem.space.to_normalised(problem.space.from_dict(values))
