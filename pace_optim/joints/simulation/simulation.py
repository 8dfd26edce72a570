"""A simulation that moves each joint alone along a reference."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from pace_actuators.effects import Effect
from pace_actuators.effects.fading_friction import step_of_constraint
from pace_envs.coulomb import turned
from pace_envs.simulation import EnvIds, Simulation, SimulationCfg
from pace_optim.joints.simulation.path import ReferencePath


class TwinSimulation(Simulation):
    """Stands in for :class:`Simulation`: environment c * R + r is on recording r.

    Integrated by the trapezoidal rule, Coulomb friction exactly (it turns within a step, where the speed passes zero,
    and a joint sticks where friction can hold it):

        (M + J + h d/2 + h D) (v₊ - v) = h (τ + f + K (q + h v/2 - q_ref) - d v - D v - F sgn v)
        q₊ = q + h (v + v₊)/2

    with J armature, d viscous and F Coulomb friction, D what must act on v₊. Soft friction f replaces F sgn v.
    It follows MuJoCo's constraint, (v₊ - v)/h + b' v + R' f = 0 within ± F, with R' of the whole robot.
    """

    is_trapezoidal = True
    turns_motors = False

    def __init__(self, cfg: SimulationCfg, spec: mujoco.MjSpec, num_envs: int, path: ReferencePath):
        """Set up the state.

        Args:
            num_envs: Number of environments, a multiple of the path's recordings.
        """
        self.path = path
        super().__init__(cfg, spec, num_envs)
        self._implicit = torch.zeros_like(self.qvel)
        self._is_implicit = False
        self._rate, self._softness, self._rest_inertia = (torch.zeros_like(self.qvel) for _ in range(3))
        self._steps = 0
        self._as_in_model = torch.equal(self._columns, torch.arange(self.model.nv))
        self._shape = (-1, path.position.shape[1], len(self._columns))
        self._intervals = len(path.feel.torque)
        self._steps_per_interval = round(path.control_dt / cfg.dt)
        self._inertia, self._torque, self._stiffness = (
            self.series(name) for name in ("inertia", "torque", "stiffness")
        )
        self._middle, self._begin, self._load = (
            [self._in_part(name, part) for part in range(self._steps_per_interval)]
            for name in ("middle", "begin", "load")
        )
        self._model_values: dict[tuple[str, str], torch.Tensor] = {}
        self._felt: tuple[int, torch.Tensor, torch.Tensor] | None = None
        """Of an interval, what joints carry in it: it is asked for several times."""

    def series(self, name: str) -> torch.Tensor:
        """What the reference gives at every control step, (T, R, n): also where it has ended.

        Args:
            name: ``inertia``, ``torque`` or ``stiffness``; of a physics step of the interval, such as ``middle.1``,
                ``middle``, ``begin`` or ``load``; of a model effect, ``<effect>.<parameter>.inertia`` and so on.
        """
        if name in ("inertia", "torque", "stiffness"):
            return getattr(self.path.feel, name)
        kind, _, rest = name.partition(".")
        if rest.isdigit():
            last = self._steps_per_interval - 1
            return torch.cat([self._in_part(kind, int(rest)), self._in_part(kind, last)[-1:]])
        parameter, _, part = rest.partition(".")
        return getattr(self.path.model_effects[kind, parameter], part)

    def _in_part(self, name: str, part: int) -> torch.Tensor:
        """A position or load in a physics step of each interval, (T - 1, R, n)."""
        share = part / self._steps_per_interval
        if name == "load":
            return _between(_at_instants(self.path.feel.load), share)
        return _between(self.path.position, share + (0.5 / self._steps_per_interval if name == "middle" else 0.0))

    def note_model_effect(self, effect: Effect, columns: torch.Tensor) -> None:
        """Take over the parameters of an effect on the model, of joints with these degrees of freedom."""
        place, self._felt = self._place(columns), None
        for parameter in effect.parameters:
            key = effect.name, parameter.name
            values = self._model_values.setdefault(
                key, torch.zeros(self.num_envs, len(self._columns), dtype=torch.float64)
            )
            values[effect.rows] = values[effect.rows].index_copy(1, place, getattr(effect, parameter.name))

    @property
    def qfrc_bias(self) -> torch.Tensor:  # type: ignore[override]
        """Less the torque of gravity and of the other joints, (num_envs, nv) [N m]."""
        k, part = self._interval()
        load = self._load[part][k]
        for key, values in self._model_values.items():
            load = load + values.view(self._shape) * self.path.model_effects[key].load[k]
        load = torch.addcmul(load, self._pull(k), self._joints(self.qpos) - self._begin[part][k])
        if self._as_in_model:
            return load.neg_().view(self.qvel.shape)
        result = torch.zeros_like(self.qvel)
        result[:, self._columns] = load.neg_().view(len(result), -1)
        return result

    def move_base(self, motion: torch.Tensor | None, point: np.ndarray | None = None) -> None:
        """Nothing: what joints feel of it is on the path."""

    def bind(self, field: str) -> torch.Tensor:
        """A field of the state, at zero, (num_envs, ...), not shared."""
        return torch.zeros(self.num_envs, self.model.nq if field == "qpos" else self.model.nv, dtype=self.dtype)

    def expand(self, field: str) -> torch.Tensor:
        """The values per simulation of a field of the model; of those, the twins use what drives write."""
        if field not in self._expanded:
            value = torch.as_tensor(np.array(getattr(self.model, field)))
            self._expanded[field] = value.expand(self.num_envs, *value.shape).clone()
        return self._expanded[field]

    def write_passive(
        self,
        columns: torch.Tensor | slice,
        armature: torch.Tensor,
        friction: torch.Tensor,
        viscous: torch.Tensor,
        implicit: torch.Tensor | None,
    ) -> None:
        """Write what drives leave to the simulation."""
        self.expand("dof_armature")[:, columns] = armature
        self.expand("dof_frictionloss")[:, columns] = friction
        self.expand("dof_damping")[:, columns] = viscous
        if implicit is not None:
            self._is_implicit = True
            self._implicit[:, columns] = implicit

    def soften_friction(self, columns: torch.Tensor | slice, time_constant: torch.Tensor) -> None:
        """Let Coulomb friction give way, as :meth:`Simulation.soften_friction`."""
        if self.friction_time is None:
            self.friction_time = torch.zeros_like(self.qvel)
            rest = self.path.rest_inertia
            self._rest_inertia[:, self._columns] = rest.repeat(self.num_envs // len(rest), 1)
        self.friction_time[:, columns] = time_constant
        self._rate[:, columns], self._softness[:, columns] = step_of_constraint(time_constant, self.cfg.dt)

    def step(self) -> None:
        """Advance by ``dt``."""
        self._constants_changed = False
        h, (k, part) = self.cfg.dt, self._interval()
        q, v = self._joints(self.qpos), self._joints(self.qvel)
        inertia, torque = self._feel(k)
        stiffness = self._pull(k)
        damping = self._joints(self.expand("dof_damping"))
        resisting = (inertia + self._joints(self.expand("dof_armature"))).add_(damping, alpha=0.5 * h)
        if self._is_implicit:
            implicit = self._joints(self._implicit)
            resisting.add_(implicit, alpha=h)
            damping = damping + implicit
        bent = torch.add(q, v, alpha=0.5 * h).sub_(self._middle[part][k]).mul_(stiffness)
        push = bent.add_(self._joints(self.qfrc_applied)).add_(torque).addcmul_(damping, v, value=-1)
        pushed = torch.div(push, resisting).mul_(h)
        stop = torch.div(self._joints(self.expand("dof_frictionloss")), resisting).mul_(h)
        new = turned(v, pushed, stop)
        if self.friction_time is not None:
            new = self._yielding(v, new, pushed, stop, resisting)
        self._set(self.qpos, torch.add(q, v, alpha=0.5 * h).add_(new, alpha=0.5 * h))
        self._set(self.qvel, new)
        self._steps += 1

    def _yielding(
        self,
        speed: torch.Tensor,
        hard: torch.Tensor,
        pushed: torch.Tensor,
        stop: torch.Tensor,
        resisting: torch.Tensor,
    ) -> torch.Tensor:
        """Speed after a step, (candidates, recordings, n): with soft friction; elsewhere it is ``hard``.

        Args:
            speed: Before it.
            hard: After it with hard friction.
            pushed: What all but friction adds to it.
            stop: What friction can take from it.
            resisting: Inertia that all meets.
        """
        assert self.friction_time is not None
        rate, softness, time = (self._joints(each) for each in (self._rate, self._softness, self.friction_time))
        armature = self._joints(self.expand("dof_armature"))
        yields = softness * resisting / (self._joints(self._rest_inertia) + armature)
        asked = (pushed + self.cfg.dt * rate * speed) / (1 + yields)
        return torch.where(time > 0, speed + pushed - torch.clamp(asked, -stop, stop), hard)

    def felt_link(self, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """What joints carry, as :meth:`Simulation.felt_link`."""
        k, _ = self._interval()
        if self._felt is None or self._felt[0] != k:
            rows = (self.num_envs // self._shape[1], -1, -1)
            inertia = self._feel(k)[0].expand(rows).reshape(self.num_envs, -1)
            stiffness = self._pull(k).expand(rows).reshape(self.num_envs, -1)
            self._felt = k, inertia, stiffness.neg()
        _, inertia, pull = self._felt
        if not torch.equal(columns, self._columns):
            place = self._place(columns)
            inertia, pull = inertia.index_select(1, place), pull.index_select(1, place)
        return inertia, pull, inertia * self._stands_alone[columns]

    def forward(self, env_ids: EnvIds = None) -> None:
        """Nothing to compute: what joints feel follows from the instant."""

    def reset(self, env_ids: EnvIds = None) -> None:
        """Back to the beginning of the reference."""
        self._steps = 0

    def close(self) -> None:
        """Nothing to release."""

    def _start(self) -> None:
        """No simulation of the whole model runs."""

    def _compile(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """The model without joints that are not on the path; says where those that are have their columns."""
        columns, self.model = self.path.columns, super()._compile(spec)
        names = [self.model.joint(self.model.dof_jntid[column]).name for column in columns.tolist()]
        alone = self._stands_alone[columns]
        coupled = tuple(names) != self.path.names
        if (others := [joint for joint in spec.joints if joint.name not in names]) or coupled:
            for element in [*spec.sensors, *spec.equalities, *spec.tendons, *others]:
                spec.delete(element)
            for joint, name in zip([spec.joint(name) for name in names], self.path.names, strict=True):
                joint.name = name  # a motor stands in the place of a joint that it moves
            self.model = super()._compile(spec)
        self._columns = torch.tensor([int(self.model.joint(name).dofadr[0]) for name in self.path.names])
        self._stands_alone = torch.zeros(self.model.nv, dtype=torch.bool).index_put((self._columns,), alone)
        return self.model

    def _interval(self) -> tuple[int, int]:
        """The present control step, and which physics step of it begins; both stay where the reference ends."""
        k, part = divmod(self._steps, self._steps_per_interval)
        return (k, part) if k < self._intervals else (self._intervals - 1, self._steps_per_interval - 1)

    def _feel(self, k: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Inertia and torque in an interval, (candidates or 1, recordings, n)."""
        inertia, torque = self._inertia[k], self._torque[k]
        for key, values in self._model_values.items():
            change = self.path.model_effects[key]
            inertia = inertia + values.view(self._shape) * change.inertia[k]
            torque = torque + values.view(self._shape) * change.torque[k]
        return inertia, torque

    def _pull(self, k: int) -> torch.Tensor:
        """Derivative of the torque by the position in an interval, (candidates or 1, recordings, n)."""
        stiffness = self._stiffness[k]
        for key, values in self._model_values.items():
            stiffness = stiffness + values.view(self._shape) * self.path.model_effects[key].stiffness[k]
        return stiffness

    def _place(self, columns: torch.Tensor) -> torch.Tensor:
        """Where degrees of freedom are among the joints', (len(columns),)."""
        order = self._columns.tolist()
        return torch.tensor([order.index(column) for column in columns.tolist()])

    def _joints(self, field: torch.Tensor) -> torch.Tensor:
        """The joints' columns of a field, (candidates, recordings, n)."""
        return (field if self._as_in_model else field.index_select(1, self._columns)).view(self._shape)

    def _set(self, field: torch.Tensor, value: torch.Tensor) -> None:
        if self._as_in_model:
            field.copy_(value.view(field.shape))
        else:
            field[:, self._columns] = value.view(len(field), -1)


def _between(at_instants: torch.Tensor, part: float) -> torch.Tensor:
    """Values (T, …) at a part of each interval, (T - 1, …)."""
    return torch.lerp(at_instants[:-1], at_instants[1:], part)


def _at_instants(in_intervals: torch.Tensor) -> torch.Tensor:
    """Values in the middle of intervals (T - 1, …) at their ends, (T, …)."""
    inner = 0.5 * (in_intervals[:-1] + in_intervals[1:])
    first, last = (1.5 * in_intervals[a] - 0.5 * in_intervals[b] for a, b in ((0, 1), (-1, -2)))
    return torch.cat([first[None], inner, last[None]])
