"""Simulating candidates on recordings, all in one batch."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from pace_actuators.identified import DRIVE_FIELDS
from pace_envs.compiled_drive.robot_kernel import CompiledRobot
from pace_envs.moving_frame import Course
from pace_optim.problem.drive_steps import loop_dt
from pace_optim.problem.parameter_space import ParameterSpace
from pace_optim.recording.commands import acting_loops
from pace_optim.recording.dataset import Dataset, Torques, Work

if TYPE_CHECKING:
    from pace_envs import ManagerBasedEnv
    from pace_envs.contact_sensor import ContactSensor

_LOAD_STEPS = 6
"""Fixed-point steps of a start whose positions depend on the load there."""

_LARGEST = 50_000_000
"""Positions that are kept at once, at most: 400 MB."""

_READ_AT_ONCE = 256
"""Samples that are read between steps at once: what is computed for them needs ten times their memory."""


class Rollout:
    """Lets every candidate follow every recording's commands.

    Environment ``c * R + r`` simulates candidate c on recording r, with that recording's gains, limits and load.
    Iterating simulates; at every sample it yields the simulated and measured positions:

        rollout.start(physical)
        for sim_dof_pos, real_dof_pos in rollout:   # each (num_envs, n) [rad]
            …

    ``sim_dof_pos`` is what the encoders would show without bias (the true joint position, unless an effect changes
    that): subtract the candidate's encoder bias to compare.
    During the iteration, ``weight`` (num_envs, 1) says how much each environment's sample counts in the score (its
    sum over the rollout is 1 per candidate), and ``sim_dof_vel`` and ``real_dof_vel`` are at hand.
    """

    def __init__(self, env: ManagerBasedEnv, dataset: Dataset, space: ParameterSpace):
        """Give each environment its recording's facts.

        Args:
            env: Its number of environments must be a multiple of the number of recordings.

        Raises:
            ValueError: If the number of environments does not fit, or a recording's facts cannot be simulated.
        """
        count = dataset.num_recordings
        if env.num_envs % count:
            raise ValueError(
                f"num_envs is {env.num_envs}, expected a multiple of the number of recordings ({count}): "
                f"try {max(1, env.num_envs // count) * count}."
            )
        self.env = env
        self.robot = env.scene["robot"]
        self.dataset = dataset.to(env.device, env.dtype)
        self.space = space
        self.num_candidates = env.num_envs // count
        self.simulated_steps = 0
        self._course = self._course_of(dataset)
        self._compiled = CompiledRobot(env, self.dataset, self._course)
        self._where = self.dataset.train
        self._enable_changes = _changes(dataset.torque_enable)
        self._step, self._contacts_at, self._is_late = 0, -1, False
        self.weight: torch.Tensor | float = 0.0
        self.physical = torch.empty(0)
        for r in range(count):
            self._set_facts(r)
        begin = self.dataset.session_start.repeat(self.num_candidates)[:, None]
        self._session_start = begin.expand(-1, self.robot.num_joints)

    @property
    def step(self) -> int:
        """Control step of the present sample."""
        return self._step

    @property
    def sim_dof_vel(self) -> torch.Tensor:
        """Simulated joint velocities at the present sample, (num_envs, n) [rad/s].

        Raises:
            ValueError: If samples are not taken at control steps.
        """
        self._refuse_late("velocities")
        return self.robot.data.joint_vel

    @property
    def real_dof_vel(self) -> torch.Tensor:
        """Measured joint velocities at the present sample, (num_envs, n) [rad/s]."""
        return self._rows(self.dataset.measured_vel[self._step])

    @property
    def sim_ee_pose(self) -> torch.Tensor:
        """Pose of the site ``PaceCfg.ee_site`` in the base's frame at the present sample, shaped as the measured one.

        Raises:
            ValueError: If the configuration names no such site, or samples are not taken at control steps.
        """
        self._refuse_late("the end effector's pose")
        measured = self.real_ee_pose
        pose = self.robot.site_pose(self.env.cfg.sim2real.ee_site)[:, : measured.shape[1]]  # type: ignore[attr-defined]
        if pose.shape[1] > 3:  # q and -q are one rotation
            pose[:, 3:] *= (pose[:, 3:] * measured[:, 3:]).sum(dim=1, keepdim=True).sign()
        return pose

    @property
    def real_ee_pose(self) -> torch.Tensor:
        """Measured pose of the end effector at the present sample.

        (num_envs, 3), a position [m], or (num_envs, 7), position and quaternion (w, x, y, z).

        Raises:
            ValueError: If a recording has none.
        """
        if self.dataset.ee_pose is None:
            raise ValueError(
                "The recordings have no pose of the end effector. Add the series real_ee_pose to each of them: (T, 3) "
                "[m], or (T, 7) with a quaternion (w, x, y, z)."
            )
        return self._rows(self.dataset.ee_pose[self._step])

    def contacts(self, name: str) -> ContactSensor:
        """A contact sensor of the scene, as it is at the present sample.

        Raises:
            ValueError: If contacts are off, there is no such sensor, or samples are not taken at control steps.
        """
        scene, sensors = self.env.scene, ", ".join(self.env.scene.sensors) or "none"
        if not self.env.cfg.sim.contacts or name not in scene.sensors:
            raise ValueError(
                f"There is no contact sensor {name!r} to read (there are: {sensors}). In the task's configuration set "
                f"sim.contacts = True and scene.contact_sensors = {{{name!r}: ContactSensorCfg(geom_names=…)}}."
            )
        self._refuse_late("contacts")
        if self._contacts_at != self._step:
            self._contacts_at = self._step
            scene.update_sensors(self.env.step_dt)
        return scene.sensors[name]

    def _refuse_late(self, what: str) -> None:
        if self.dataset.sample_offset is not None or self._is_late:
            raise ValueError(
                f"Only positions are known at the instants of these samples, which do not lie on control steps: {what} "
                "are not. Choose a control step that divides the recording's, or leave out effects on the recording."
            )

    @property
    def duration_steps(self) -> int:
        """Control steps of the present rollout."""
        return self.dataset.last_step(self._where)

    def start(
        self,
        physical: torch.Tensor,
        where: torch.Tensor | None = None,
        per_joint: Mapping[str, torch.Tensor] | None = None,
        initial_offset: torch.Tensor | None = None,
        shift: torch.Tensor | None = None,
        push: torch.Tensor | None = None,
    ) -> None:
        """Write candidates and put every environment at its recording's first sample.

        Args:
            physical: Physical parameters, (num_candidates, size).
            where: Which samples count, (T, R) bool; ``None`` means those to train on.
            per_joint: Values per joint of shared parameters, in place of those in ``physical``:
                {name: (num_candidates, n)}.
            initial_offset: Added to each recording's first position, (num_candidates, n) [rad].
            shift: Added to positions [rad] and speeds [rad/s] at which joints are held until a free phase begins,
                (num_candidates, n, 2).
            push: Added to the angular acceleration [rad/s²] and the specific force [m/s²] of a base that moves,
                (num_candidates, 6).
        """
        count = self.dataset.num_recordings
        self.look_at(self.dataset.train if where is None else where)
        on_device = self.env.sim.tensor
        self.physical = on_device(physical).repeat_interleave(count, dim=0)
        self.env.scene.reset()
        copies = {name: on_device(values).repeat_interleave(count, dim=0) for name, values in (per_joint or {}).items()}
        self.space.apply(self.env, self.physical, copies)
        changes = (initial_offset, shift, push)
        self.begin(*(0.0 if each is None else on_device(each).repeat_interleave(count, dim=0) for each in changes))

    def __iter__(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Simulate up to the last sample that counts; yields (sim_dof_pos, real_dof_pos) at every sample."""
        return self._pairs(self.samples())

    def at_once(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """The same pairs, for those who read nothing else of the robot: drives that can be compiled simulate first."""
        size = self.duration_steps * self.env.num_envs * self.robot.num_joints
        if size > _LARGEST or self.env.device.type != "cpu":
            return iter(self)
        return self._pairs(enumerate(self.positions(torch.arange(self.duration_steps))))

    def _pairs(self, samples: Iterable[tuple[int, torch.Tensor]]) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Pairs of simulated and measured positions, of samples as :meth:`samples` gives them."""
        data = self.dataset
        weights = (self._where.double() / self._where.sum()).to(self.env.dtype)
        counts = self._where.any(dim=1).tolist()
        self._is_late = self.observation_lag(self.duration_steps) is not None
        self._contacts_at = -1
        for k, sim_dof_pos in samples:
            self._step = k
            if counts[k]:
                self.weight = self._rows(weights[k, :, None])
                yield sim_dof_pos, self._rows(data.measured[k])

    def positions(self, at: torch.Tensor) -> torch.Tensor:
        """Simulated positions at samples, as when iterating, (len(at), num_envs, n) [rad]; the numbers are the same.

        Where drives can be compiled the robot's own state stays where it is; iterate to read more of it.

        Args:
            at: Control steps of the samples, ascending, the last one that counts among them.
        """
        steps, reading = self.duration_steps, self.reading(self.duration_steps)
        if reading is None:
            return self._in_one_go(at)
        return self._read(reading, at, self._in_one_go(torch.arange(steps + reading.ahead)))

    def positions_and_torques(self, at: torch.Tensor, sensed: Torques) -> tuple[torch.Tensor, torch.Tensor]:
        """The same, and the motors' torques as late as sensors show them, both (len(at), num_envs, n) [rad, N m].

        Torques run straight between control steps.

        Args:
            at: As for :meth:`positions`.
            sensed: What measured torques are compared with it.
        """
        last, offset, after = self.duration_steps, self.dataset.sample_offset, sensed.after[at]
        beyond = 2 + math.ceil(max(0.0, float(after.max()) - float(sensed.lag.min())))
        lag, reading = self.observation_lag(last), self.reading(last)
        steps = last if reading is None else last + reading.ahead
        torque = torch.zeros(steps + beyond, self.env.num_envs, self.robot.num_joints, dtype=self.env.dtype)
        seen = self._in_one_go(torch.arange(steps + beyond), torque=torque)[:steps]
        positions = seen[at] if reading is None else self._read(reading, at, seen)
        after = after if offset is None else after + offset[at]
        when = torch.stack([self._rows(each[:, None]) for each in at[:, None] + after]).expand_as(positions)
        if lag is not None:
            when = when - torch.lerp(lag[0], lag[1], (at / max(1, last - 1))[:, None, None])
        return positions, _straight(torque, when - sensed.lag)

    def motion(self, steps: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Simulate that many control steps.

        Returns:
            Sensed positions at each, as late as the effects on the recording have them, (steps, num_envs, n) [rad], and
            there MuJoCo's positions, (steps, num_envs, nq), and speeds, (steps, num_envs, nv).
        """
        sim, reading = self.env.sim, self.reading(steps)
        count, sizes = steps if reading is None else steps + reading.ahead, [sim.qpos.shape[1], sim.qvel.shape[1]]
        state = torch.empty(count, self.env.num_envs, sum(sizes), dtype=sim.dtype, device=sim.device)
        seen = self._in_one_go(torch.arange(count), state)
        positions, speeds = (each.contiguous() for each in state[:steps].split(sizes, dim=-1))
        return seen if reading is None else self._read(reading, torch.arange(steps), seen), positions, speeds

    def _in_one_go(
        self, at: torch.Tensor, state: torch.Tensor | None = None, torque: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Simulated positions at control steps, (len(at), num_envs, n) [rad].

        ``state`` gets MuJoCo's there, and ``torque`` the motors', which is not that of the last step where it ends.
        """
        last, robot = int(at[-1]), self.robot

        def note(row: int, step: int) -> None:
            self.hold(step)
            result[row] = robot.sensed_joint_pos()
            if state is not None:
                state[row] = torch.cat([self.env.sim.qpos, self.env.sim.qvel], dim=1)

        shape = len(at), self.env.num_envs, robot.num_joints
        result = torch.empty(shape, dtype=self.env.dtype, device=self.env.device)
        begin = int(at[0] == 0)
        self.hold(0)
        if begin:
            note(0, 0)
        if last > 0:
            robot.note_torque = torque[0] if begin and torque is not None else None
            self.advance(0)
            rest = (None if each is None else each[begin:] for each in (state, torque))
            compiled = self._compiled.positions(at[begin:], *rest)
            if compiled is None:
                row = {k: i for i, k in enumerate(at.tolist())}
                for k in range(1, last + 1):
                    if k in row:
                        note(row[k], k)
                    else:
                        self.hold(k)
                        robot.sensed_joint_pos()  # brings the motor to the present
                    if k < last:
                        robot.note_torque = torque[row[k]] if k in row and torque is not None else None
                        self.advance(k)
            else:
                result[begin:] = compiled
        self.simulated_steps += last * self.env.num_envs
        return result

    def samples(self) -> Iterator[tuple[int, torch.Tensor]]:
        """Step and sensed positions at every control step, as late as the effects on the recording have them.

        The robot is simulated meanwhile, so that all else of it can be read; of positions only the last are kept.
        """
        steps, reading = self.duration_steps, self.reading(self.duration_steps)
        if reading is None:
            yield from enumerate(self.simulated(steps))
            return
        length = reading.ahead + reading.behind + 1
        shape = length, self.env.num_envs, self.robot.num_joints
        seen = torch.zeros(shape, dtype=self.env.dtype, device=self.env.device)
        for j, position in enumerate(self.simulated(steps + reading.ahead)):
            seen[j % length] = position
            if j == 0:
                seen[:] = position
            if (k := j - reading.ahead) >= 0:
                shown = seen[k % length].clone()
                at = reading.taken_at(torch.tensor([k], device=self.env.device), reading.late)
                shown[reading.late] = between_steps(seen[:, reading.late], at, ring=True)[0]
                yield k, shown

    def _read(self, reading: Reading, at: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
        """The same at some steps, read between positions at all steps, (len(at), num_envs, n) [rad]."""
        shown, own = seen[at], seen[:, reading.late]
        for rows in torch.arange(len(at)).split(_READ_AT_ONCE):
            shown[rows[:, None], reading.late] = between_steps(own, reading.taken_at(at[rows], reading.late))
        return shown

    def reading(self, steps: int) -> Reading | None:
        """How samples are taken between steps; ``None``: at the steps themselves."""
        lag, offset = self.observation_lag(steps), self.dataset.sample_offset
        if lag is None and offset is None:
            return None
        if lag is None:
            lag = torch.zeros(2, self.env.num_envs, self.robot.num_joints, dtype=self.env.dtype, device=self.env.device)
        most = 0.0 if offset is None else float(offset.abs().max())
        moved = (lag != 0).any(dim=2).any(dim=0)
        return Reading(
            late=(moved if offset is None else torch.ones_like(moved)).nonzero()[:, 0],
            first=lag[0],
            rate=(lag[-1] - lag[0]) / max(1, steps - 1),
            offset=offset,
            ahead=max(0, math.ceil(most - float(lag.min()))) + 2,
            behind=max(0, math.ceil(most + float(lag.max()))) + 2,
        )

    def observation_lag(self, steps: int) -> torch.Tensor | None:
        """How late the first and the last sample are [control steps], (2, num_envs, n); ``None``: never."""
        dt = self.env.step_dt
        shape = 2, self.env.num_envs, self.robot.num_joints
        total = torch.zeros(shape, dtype=self.env.dtype, device=self.env.device)
        start = self._rows(self.dataset.start_time[:, None])
        found = False
        for actuator in self.robot.actuators.values():
            if actuator.effects is not None and actuator.effects.lags:
                found = True
                for row, at in enumerate((0.0, (steps - 1) * dt)):
                    lag = actuator.effects.observation_lag((start + at).expand(-1, actuator.num_joints))
                    if lag is not None:
                        total[row][:, actuator.joint_indices] = lag / dt
        return total if found else None

    def simulated(self, steps: int) -> Iterator[torch.Tensor]:
        """Simulate that many control steps; yields the sensed positions at each, (num_envs, n) [rad]."""
        for j in range(steps):
            self.hold(j)
            yield self.robot.sensed_joint_pos()
            if j + 1 == steps:
                break
            self.advance(j)
        self.simulated_steps += (steps - 1) * self.env.num_envs

    def advance(self, step: int) -> None:
        """Simulate a control step, the one after ``step``."""
        data, enable = self.dataset, self.dataset.torque_enable
        k = min(step, len(data.command) - 1)
        if enable is not None and (step == 0 or k in self._enable_changes):
            for actuator in self.robot.actuators.values():
                actuator.set_torque_enable(self._rows(enable[k, :, None])[:, 0])
        if data.command_vel is not None:
            self.robot.set_joint_velocity_target(self._rows(data.command_vel[k]))
        if data.command_effort is not None:
            self.robot.set_joint_effort_target(self._rows(data.command_effort[k]))
        if self._course is not None:
            motion = self._course.motion[k].repeat(1, self.num_candidates, 1)
            motion[..., 3:] += self._course.push
            self.env.sim.move_base(motion, self._course.point.repeat(self.num_candidates, 1).numpy())
        self.env.simulate(self._rows(data.command[k]))

    def hold(self, step: int) -> None:
        """Put joints that are not free to where encoders show what was measured at a control step."""
        if self._course is None:
            return
        held = self._course.held[min(step, len(self._course.held) - 1)].repeat(self.num_candidates, 1, 1)
        free = held[..., 0].isnan()
        if not bool(free.all()):
            position, speed = (held + self._course.shift).nan_to_num().unbind(dim=-1)
            self.robot.write_joint_state_to_sim(*self.robot.held(position, speed, free))

    def _course_of(self, dataset: Dataset) -> Course | None:
        """How the base moves and joints are held, as the simulation wants it."""
        carried = dataset.carried
        if carried is None:
            return None
        if self.env.device.type != "cpu":
            raise ValueError(
                "The base moves in these recordings, which is simulated on the processor alone: use --device cpu."
            )
        held = loop_dt(self.env.cfg, self.env.step_dt)  # type: ignore[arg-type]
        return Course(
            motion=carried.motion(self.env.cfg.decimation, self.env.step_dt, held),
            point=carried.point,
            held=carried.held(),
            shift=torch.zeros(self.env.num_envs, self.robot.num_joints, 2, dtype=self.env.dtype),
            push=torch.zeros(self.env.num_envs, 6, dtype=self.env.dtype),
        )

    def _rows(self, per_recording: torch.Tensor) -> torch.Tensor:
        """(R, m) to (num_envs, m): the same for every candidate."""
        count = self.dataset.num_recordings
        if count == 1:
            return per_recording.expand(self.env.num_envs, -1)
        return per_recording.expand(self.num_candidates, -1, -1).reshape(self.env.num_envs, -1)

    def look_at(self, where: torch.Tensor) -> None:
        """Say which samples count, (T, R) bool."""
        self._where = where.to(self.env.device)

    def begin(
        self,
        offset: torch.Tensor | float = 0.0,
        shift: torch.Tensor | float = 0.0,
        push: torch.Tensor | float = 0.0,
    ) -> None:
        """Put every environment at its recording's first sample, with the parameters that it has.

        Args:
            offset: Added to the first positions, (num_envs, n) [rad].
            shift: Added to where joints are held, (num_envs, n, 2) [rad, rad/s].
            push: Added to the base's angular acceleration [rad/s²] and specific force [m/s²], (num_envs, 6).
        """
        if self._course is not None:
            self._course.shift[:], self._course.push[:] = shift, push
            for actuator in self.robot.actuators.values():
                self._course.shift[:, actuator.joint_indices, 0] += actuator.encoder_bias
        shown = self._rows(self.dataset.measured[0]).clone()
        if self.dataset.sample_offset is not None:
            late = self.dataset.sample_offset[0, :, None] * self.env.step_dt
            shown -= self._rows(late * self.dataset.start_vel)
        for actuator in self.robot.actuators.values():
            ids = actuator.joint_indices
            shown[:, ids] += actuator.encoder_bias
            actuator.set_session_time(self._session_start[:, ids])
            if self.dataset.work is not None:
                actuator.remember(partial(self._heat, self.dataset.work, ids))
            actuator.notice(partial(self._conditions, ids))
        speed = self._rows(self.dataset.start_vel)
        needs_load = any(actuator.needs_load for actuator in self.robot.actuators.values())
        for _ in range(_LOAD_STEPS if needs_load else 1):  # the load bends what an encoder on the motor shows
            self.robot.write_joint_state_to_sim(self.robot.joint_pos_that_shows(shown) + offset, speed)
            if needs_load:
                self.env.sim.forward()

    def _heat(self, work: Work, joints: Any, time_constant: torch.Tensor, rows: slice) -> torch.Tensor:
        """Heat of a group of joints when the recordings of some environments begin: see :data:`Heat`."""
        return work.heat(self._session_start[rows, :1], time_constant, joints)

    def _conditions(self, joints: Any, name: str, places: int, rows: slice) -> tuple[torch.Tensor, torch.Tensor] | None:
        """What was logged of the conditions of a group of joints, for some environments: see :data:`Conditions`."""
        if (logged := self.dataset.condition(name, places)) is None:
            return None
        time, values = self._rows(logged.time)[:, None], self._rows(logged.values.flatten(1))
        return time[rows], values.unflatten(1, (-1, places))[rows][:, joints]

    def _set_facts(self, r: int) -> None:
        recording = self.dataset.recordings[r]
        rows = slice(r, None, self.dataset.num_recordings)
        for actuator in self.robot.actuators.values():
            for name in DRIVE_FIELDS:
                value = getattr(recording.drive, name)
                if value is not None:
                    getattr(actuator, name)[rows] = self.env.sim.tensor(value)[actuator.joint_indices]
            if recording.drive.saturation_effort is not None:  # infinite: there is no line
                stall = actuator.saturation_effort[rows]
                actuator.velocity_limit[rows] = actuator.velocity_limit[rows].where(stall.isfinite(), torch.inf)
                actuator.saturation_effort[rows] = stall.clamp(max=torch.finfo(stall.dtype).max)
            ids = actuator.joint_indices
            stiffness = np.zeros(recording.num_joints)
            stiffness[ids if isinstance(ids, slice) else torch.as_tensor(ids).cpu().numpy()] = (
                actuator.stiffness[r].cpu().numpy()
            )
            for name, acts in zip(("stiffness", "damping"), acting_loops(recording, stiffness), strict=True):
                gain = getattr(actuator, name)[rows]
                gain[:, ~torch.as_tensor(acts, device=gain.device)[ids]] = 0.0
        load = {
            key: value
            for key in ("load_mass", "load_length", "arm_mass")
            if (value := getattr(recording.load, key)) is not None
        }
        apply_load = self.env.cfg.sim2real.apply_load  # type: ignore[attr-defined]
        if load and apply_load is not None:
            apply_load(self.env, rows, load)
        for body, mass in recording.load.added_mass.items():
            self.robot.add_body_mass(body, mass, rows, place=recording.load.added_mass_at.get(body))


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """Samples of step k are taken at k - lag + offset: some steps are simulated ahead, some are remembered."""

    late: torch.Tensor
    """Environments whose samples are not taken at the steps."""
    first: torch.Tensor
    """The lag of each environment at the first step, (num_envs, n) [control steps]."""
    rate: torch.Tensor
    """What it grows by with each: lags are linear in time."""
    offset: torch.Tensor | None
    """Of the recordings, (T, R)."""
    ahead: int
    behind: int

    def taken_at(self, steps: torch.Tensor, envs: torch.Tensor) -> torch.Tensor:
        """When samples of some steps are taken in some environments, (len(steps), len(envs), n) [control steps]."""
        k = steps[:, None, None].to(self.first.dtype)
        at = k - (self.first[envs] + self.rate[envs] * k)
        return at if self.offset is None else at + self.offset[steps][:, envs % self.offset.shape[1], None]

    def to(self, device: torch.device) -> Reading:
        """The same on a device."""
        offset = None if self.offset is None else self.offset.to(device)
        late, first, rate = (each.to(device) for each in (self.late, self.first, self.rate))
        return replace(self, late=late, first=first, rate=rate, offset=offset)


def _changes(enable: torch.Tensor | None) -> frozenset[int]:
    """Steps at which a (T, R) mask is another than at the step before."""
    if enable is None:
        return frozenset()
    return frozenset(((enable[1:] != enable[:-1]).any(dim=1).nonzero()[:, 0] + 1).tolist())


def between_steps(seen: torch.Tensor, at: torch.Tensor, *, ring: bool = False) -> torch.Tensor:
    """Samples (length, m, n) at real-valued steps (K, m, n), by the cubic through four samples (Lagrange).

    Args:
        seen: One sample per step.
        ring: Whether the samples are those of the last steps, each at its step modulo the length.
    """
    whole = at.floor()
    f, index = at - whole, whole.long()
    weights = (
        -f * (f - 1) * (f - 2) / 6,
        (f + 1) * (f - 1) * (f - 2) / 2,
        -(f + 1) * f * (f - 2) / 2,
        (f + 1) * f * (f - 1) / 6,
    )
    result = torch.zeros_like(at)
    for i, weight in enumerate(weights, start=-1):
        rows = (index + i) % len(seen) if ring else (index + i).clamp(0, len(seen) - 1)
        result += weight * seen.gather(0, rows)
    return result


def _straight(series: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
    """Values (length, m, n) at real-valued steps (K, m, n), straight between two; the first before it."""
    whole = at.floor().clamp(0, len(series) - 2)
    low = whole.long()
    return torch.lerp(series.gather(0, low), series.gather(0, low + 1), (at - whole).clamp(0.0, 1.0))
