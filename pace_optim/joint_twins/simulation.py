"""A simulation that moves each joint alone along a reference."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from pace_actuators.effects import Effect
from pace_envs.simulation import EnvIds, Simulation, SimulationCfg
from pace_optim.joint_twins.path import ReferencePath


class TwinSimulation(Simulation):
    """Stands in for :class:`Simulation`: environment c * R + r is on recording r.

    Integrated by the trapezoidal rule, Coulomb friction exactly (a joint sticks where friction can hold it):

        (M + J + h d/2 + h D) (v₊ - v) = h (τ + f + K (q + h v/2 - q_ref) - d v - D v)        then v₊ towards 0 by h F
        q₊ = q + h (v + v₊)/2

    with J armature, d viscous and F Coulomb friction, D what must act on v₊.
    """

    is_trapezoidal = True
    is_semi_implicit = False

    def __init__(self, cfg: SimulationCfg, spec: mujoco.MjSpec, num_envs: int, path: ReferencePath):
        """Set up the state.

        Args:
            cfg: The configuration; the time step counts.
            spec: The robot's model.
            num_envs: Number of environments, a multiple of the path's recordings.
            path: The reference.
        """
        self.cfg, self.num_envs, self.path = cfg, num_envs, path
        self.device = torch.device("cpu")
        self.model = self._compile(spec)
        self.batch = None
        model = self.model
        self._fields: dict[str, torch.Tensor] = {}
        self.qpos = torch.zeros(num_envs, model.nq, dtype=torch.float64)
        self.qvel = torch.zeros(num_envs, model.nv, dtype=torch.float64)
        self.qfrc_applied = torch.zeros(num_envs, model.nv, dtype=torch.float64)
        self._implicit = torch.zeros(num_envs, model.nv, dtype=torch.float64)
        self._load = torch.zeros(num_envs, model.nv, dtype=torch.float64)
        self._constants_changed = False
        self._steps = 0
        self._columns = path.columns
        self._as_in_model = torch.equal(path.columns, torch.arange(model.nv))
        self._count = path.position.shape[1]
        self._steps_per_interval = round(path.control_dt / cfg.dt)
        self._model_values: dict[tuple[str, str], torch.Tensor] = {}

    def note_model_effect(self, effect: Effect, columns: torch.Tensor) -> None:
        """Take over the parameters of an effect on the model, of joints with these degrees of freedom."""
        order = self._columns.tolist()
        place = torch.tensor([order.index(column) for column in columns.tolist()])
        for parameter in effect.parameters:
            key = effect.name, parameter.name
            values = self._model_values.setdefault(key, torch.zeros(self.num_envs, len(order), dtype=torch.float64))
            values[effect.rows] = values[effect.rows].index_copy(1, place, getattr(effect, parameter.name))

    @property
    def qfrc_bias(self) -> torch.Tensor:  # type: ignore[override]
        """Less the torque of gravity and of the other joints, (num_envs, nv) [N m]."""
        return -self._load

    def expand(self, field: str) -> torch.Tensor:
        """The values per simulation of a field of the model; of those, the twins use what drives write."""
        if field not in self._fields:
            value = torch.as_tensor(np.array(getattr(self.model, field)))
            self._fields[field] = value.expand(self.num_envs, *value.shape).clone()
        return self._fields[field]

    def write_passive(
        self, columns: torch.Tensor, friction: torch.Tensor, viscous: torch.Tensor, implicit: torch.Tensor | None
    ) -> None:
        """Write what drives leave to the simulation."""
        self.expand("dof_frictionloss")[:, columns] = friction
        self.expand("dof_damping")[:, columns] = viscous
        self._implicit[:, columns] = 0.0 if implicit is None else implicit

    def step(self) -> None:
        """Advance by ``dt``."""
        self._constants_changed = False
        path, n = self.path, len(self._columns)
        k, part = divmod(self._steps, self._steps_per_interval)
        k = min(k, len(path.feel.torque) - 1)
        shape = (-1, self._count, n)
        q, v = self._get(self.qpos).view(shape), self._get(self.qvel).view(shape)
        inertia, torque = self._feel(k)
        effort = self._get(self.qfrc_applied).view(shape)
        damping = self._get(self.expand("dof_damping")).view(shape)
        friction = self._get(self.expand("dof_frictionloss")).view(shape)
        implicit = self._get(self._implicit).view(shape)
        stiffness = path.stiffness[min(k, len(path.stiffness) - 1)]
        h = self.cfg.dt
        total = inertia + self._get(self.expand("dof_armature")).view(shape)
        resisting = total + h * (0.5 * damping + implicit)
        end = path.position[k + 1]
        reference = torch.lerp(path.position[k], end, (part + 0.5) / self._steps_per_interval)
        bent = torch.add(q, v, alpha=0.5 * h).sub_(reference).mul_(stiffness)
        push = bent.add_(effort + torque).addcmul_(damping + implicit, v, value=-1)
        free = torch.addcdiv(v, push, resisting, value=h)
        stop = h * friction / resisting
        new = free - torch.clamp(free, -stop, stop)
        q = torch.add(q, v + new, alpha=0.5 * h)
        v = new
        self._set(self.qpos, q.view(-1, n))
        self._set(self.qvel, v.view(-1, n))
        self._load[:, self._columns] = (torque + stiffness * (q - end)).view(-1, n)
        self._steps += 1

    def felt_link(self, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """What joints carry, as :meth:`Simulation.felt_link`."""
        k = self._steps // self._steps_per_interval
        order = self._columns.tolist()
        place = [order.index(column) for column in columns.tolist()]
        inertia = self._feel(min(k, len(self.path.feel.torque) - 1))[0]
        inertia = inertia.expand(self.num_envs // self._count, -1, -1).reshape(self.num_envs, -1)[:, place]
        stiffness = self.path.stiffness[min(k, len(self.path.stiffness) - 1)]
        stiffness = stiffness.repeat(self.num_envs // self._count, 1)[:, place]
        return inertia, -stiffness, inertia * self._stands_alone(columns)

    def forward(self, env_ids: EnvIds = None) -> None:
        """What the joints feel at the start."""
        path = self.path
        self._load[:, self._columns] = path.feel.torque[0].repeat(self.num_envs // self._count, 1)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Back to the beginning of the reference."""
        self._steps = 0

    def close(self) -> None:
        """Nothing to release."""

    def _feel(self, k: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Inertia and torque in an interval, (candidates or 1, recordings, n)."""
        path, shape = self.path, (-1, self._count, len(self._columns))
        inertia, torque = path.feel.inertia[k], path.feel.torque[k]
        for key, values in self._model_values.items():
            change = path.model_effects[key]
            inertia = inertia + values.view(shape) * change.inertia[k]
            torque = torque + values.view(shape) * change.torque[k]
        return inertia, torque

    def _get(self, field: torch.Tensor) -> torch.Tensor:
        return field if self._as_in_model else field.index_select(1, self._columns)

    def _set(self, field: torch.Tensor, value: torch.Tensor) -> None:
        if self._as_in_model:
            field.copy_(value)
        else:
            field[:, self._columns] = value
