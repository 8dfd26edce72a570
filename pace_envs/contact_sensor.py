"""Contacts of a few geoms with the ground: forces, speeds, time in the air."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import torch

from pace_envs.robot_spec import find_geoms
from pace_envs.simulation import Simulation

_FOUND_FORCE, _NETFORCE, _ONE = 0b11, 3, 1  # fields of MuJoCo's contact sensor, its reduction, contacts reported


@dataclass(kw_only=True)
class ContactSensorCfg:
    """Which geoms are watched. MuJoCo computes what they need in every physics step, so name few."""

    geom_names: str | tuple[str, ...]
    """Expressions of colliding geoms, or of the bodies whose geoms they are."""

    track_velocity: bool = False
    """Whether the geoms' velocities are computed, too."""


class ContactSensor:
    """Contacts of geoms, batched over environments, as they are at the last physics step of an environment step.

    Attributes:
        geom_names: The geoms, in order.
        in_contact: Whether a geom touches something, (num_envs, num_geoms) bool.
        current_air_time: Since the last touch [s], 0 while touching, (num_envs, num_geoms).
        last_air_time: Length of the last flight [s], (num_envs, num_geoms).
        current_contact_time: Since the last landing [s], 0 in the air, (num_envs, num_geoms).
        first_contact: Whether the geom landed in the last environment step, (num_envs, num_geoms) bool.
    """

    def __init__(self, cfg: ContactSensorCfg, name: str, sim: Simulation):
        """Find the sensors that :func:`add_contact_sensor` put into the model."""
        self.cfg = cfg
        prefix = f"{name}/"
        contacts = [
            sim.model.sensor(i) for i in range(sim.model.nsensor) if sim.model.sensor(i).name.startswith(prefix)
        ]
        self.geom_names = [s.name.removeprefix(prefix) for s in contacts]
        self.geom_ids = [sim.model.geom(geom).id for geom in self.geom_names]
        data, count = sim.bind("sensordata"), len(self.geom_names)
        start = int(contacts[0].adr[0])
        self._contacts = data[:, start : start + 4 * count].unflatten(1, (count, 4))
        self._velocity: torch.Tensor | None = None
        if cfg.track_velocity:
            start += 4 * count
            self._velocity = data[:, start : start + 3 * count].unflatten(1, (count, 3))
        shape = (sim.num_envs, count)
        self.in_contact = torch.zeros(shape, dtype=torch.bool, device=sim.device)
        self.first_contact = torch.zeros_like(self.in_contact)
        self.current_air_time = torch.zeros(shape, dtype=sim.dtype, device=sim.device)
        self.last_air_time = torch.zeros_like(self.current_air_time)
        self.current_contact_time = torch.zeros_like(self.current_air_time)

    @property
    def net_forces_w(self) -> torch.Tensor:
        """Sum of the contact forces on a geom, in the world [N], (num_envs, num_geoms, 3)."""
        return -self._contacts[..., 1:]

    @property
    def lin_vel_w(self) -> torch.Tensor:
        """Velocities of the geoms' centres in the world [m/s], (num_envs, num_geoms, 3)."""
        if self._velocity is None:
            raise ValueError("This contact sensor has no velocities. Set track_velocity=True in its configuration.")
        return self._velocity

    def update(self, dt: float) -> None:
        """Read the contacts after an environment step of ``dt`` seconds."""
        torch.gt(self._contacts[..., 0], 0.0, out=self.in_contact)
        torch.logical_and(self.in_contact, self.current_air_time > 0.0, out=self.first_contact)
        self.current_air_time += dt
        self.current_contact_time += dt
        torch.where(self.first_contact, self.current_air_time, self.last_air_time, out=self.last_air_time)
        self.current_air_time.masked_fill_(self.in_contact, 0.0)
        self.current_contact_time.masked_fill_(~self.in_contact, 0.0)

    def reset(self, env_ids: torch.Tensor | slice) -> None:
        """Forget the contacts of some environments."""
        for buffer in (self.in_contact, self.first_contact):
            buffer[env_ids] = False
        for times in (self.current_air_time, self.last_air_time, self.current_contact_time):
            times[env_ids] = 0.0


def add_contact_sensor(spec: mujoco.MjSpec, name: str, cfg: ContactSensorCfg) -> None:
    """Put what a :class:`ContactSensor` reads into a model: one contact sensor per geom, then one velocity per geom."""
    names = [geom.name for geom in find_geoms(spec, cfg.geom_names)]
    for geom in names:
        spec.add_sensor(
            name=f"{name}/{geom}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname=geom,
            intprm=[_FOUND_FORCE, _NETFORCE, _ONE],
        )
    if cfg.track_velocity:
        for geom in names:
            spec.add_sensor(
                name=f"velocity/{name}/{geom}",
                type=mujoco.mjtSensor.mjSENS_FRAMELINVEL,
                objtype=mujoco.mjtObj.mjOBJ_GEOM,
                objname=geom,
            )
