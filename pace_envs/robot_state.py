"""A robot's joints in the simulation: finding them, reading and writing their state and targets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import torch

from pace_actuators import resolve_joint_values
from pace_actuators.joint_units import JointType
from pace_actuators.text import listed
from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.closed_loops import ClosedLoops
from pace_envs.indexing import EnvIds, JointIds, assign, checked_values, find_names, indices, zeros_like
from pace_envs.motor_coordinates import SINGLE, DrivenJoints, MotorCoordinates, fixed_tendon, joint_ranges
from pace_envs.quaternions import down, multiply, rotate_inverse
from pace_envs.simulation import Simulation


@dataclass(kw_only=True)
class ArticulationData:
    """State, targets and defaults; joints in the articulation's ``joint_names`` order, of the simulation's type.

    Tensors of the state may share memory with the simulation: clone them to keep them.
    """

    joint_pos: torch.Tensor
    """True joint positions [rad], (num_envs, num_joints)."""
    joint_vel: torch.Tensor
    """Joint velocities [rad/s], (num_envs, num_joints)."""
    default_joint_pos: torch.Tensor
    """[rad], (num_envs, num_joints)."""
    default_joint_vel: torch.Tensor
    """[rad/s], (num_envs, num_joints)."""
    joint_pos_limits: torch.Tensor
    """Lower and upper [rad], (num_joints, 2); infinite without a limit."""
    soft_joint_pos_limits: torch.Tensor
    """Lower and upper [rad], (num_joints, 2)."""
    joint_pos_target: torch.Tensor
    """[rad], (num_envs, num_joints)."""
    joint_vel_target: torch.Tensor | None = None
    """[rad/s], (num_envs, num_joints); ``None`` until one is set, which means zero."""
    joint_effort_target: torch.Tensor | None = None
    """Feed-forward [N m], (num_envs, num_joints); ``None`` until one is set, which means zero."""
    computed_torque: torch.Tensor
    """Torque that the controllers ask for [N m], (num_envs, num_joints)."""
    applied_torque: torch.Tensor
    """Torque at the joints [N m], (num_envs, num_joints)."""
    root_pos_w: torch.Tensor | None = None
    """Position of a floating base in the world [m], (num_envs, 3); ``None`` for a fixed base."""
    root_quat_w: torch.Tensor | None = None
    """Orientation of a floating base, w x y z, (num_envs, 4)."""
    root_lin_vel_w: torch.Tensor | None = None
    """Linear velocity of a floating base in the world [m/s], (num_envs, 3)."""
    root_ang_vel_b: torch.Tensor | None = None
    """Angular velocity of a floating base in its frame [rad/s], (num_envs, 3)."""

    @property
    def root_lin_vel_b(self) -> torch.Tensor:
        """Linear velocity of a floating base in its frame [m/s], (num_envs, 3)."""
        return rotate_inverse(of_floating_base(self.root_quat_w), of_floating_base(self.root_lin_vel_w))

    @property
    def projected_gravity_b(self) -> torch.Tensor:
        """Direction of gravity in a floating base's frame, (num_envs, 3)."""
        return down(of_floating_base(self.root_quat_w))


def of_floating_base(state: torch.Tensor | None) -> torch.Tensor:
    """A part of the root's state."""
    if state is None:
        raise ValueError("This robot's base is fixed: it has no root state. Set fix_base=False.")
    return state


@dataclass(frozen=True, kw_only=True, eq=False)
class JointLayout:
    """The joints that can have drives, in the robot's order."""

    joint_names: tuple[str, ...]
    """Their names."""
    qpos_columns: torch.Tensor
    """Column of each joint in ``qpos``, (num_joints,)."""
    dof_columns: torch.Tensor
    """Column of each joint in ``qvel`` and all that belongs to degrees of freedom, (num_joints,)."""
    root: tuple[int, int] | None
    """First columns of a floating base in ``qpos`` and ``qvel``; ``None`` for a fixed one."""
    driven: DrivenJoints
    """The joints that they are, or that motors among them move."""
    passive_names: tuple[str, ...]
    """Hinge and slide joints of the model that are not among them: they move as their loads and loops do."""
    passive_columns: torch.Tensor
    """Column of each passive joint in ``qpos``."""

    @classmethod
    def of_model(
        cls,
        model: mujoco.MjModel,
        joint_order: Sequence[str] | None,
        path: str | Path,
        device: torch.device | str = "cpu",
    ) -> JointLayout:
        """Find the joints in a model.

        Args:
            joint_order: Their order, and motors that move several joints; ``None`` means the model's joints.
        """
        root, single = None, {}
        for j in range(model.njnt):
            name, kind = model.joint(j).name, mujoco.mjtJoint(int(model.jnt_type[j]))
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                root = (int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j]))
            elif kind in SINGLE:
                single[name] = j
            elif joint_order is None or name in joint_order:
                raise ValueError(f"The joint {name!r} is a ball joint. Only hinge and slide joints have drives.")
        if not single:
            raise ValueError(f"The model {path} has no joints to drive.")
        order = joint_order or tuple(single)
        unknown = [name for name in order if name not in single and fixed_tendon(model, name) is None]
        if unknown or len(set(order)) != len(order):
            wrong = f"names unknown joints: {', '.join(unknown)}" if unknown else "names a joint twice"
            raise ValueError(f"joint_order {wrong}. Joints of the model {path}: {', '.join(single)}.")
        driven = DrivenJoints.of_model(model, order)
        ids = [single[name] for name in driven.joints]
        passive = {name: j for name, j in single.items() if name not in driven.joints}
        return cls(
            joint_names=tuple(order),
            qpos_columns=torch.tensor([int(model.jnt_qposadr[j]) for j in ids], device=device),
            dof_columns=torch.tensor([int(model.jnt_dofadr[j]) for j in ids], device=device),
            root=root,
            driven=driven,
            passive_names=tuple(passive),
            passive_columns=torch.tensor(
                [int(model.jnt_qposadr[j]) for j in passive.values()], dtype=torch.long, device=device
            ),
        )

    @cached_property
    def side_by_side(self) -> bool:
        """Whether the joints lie side by side in the model, in order: their tensors are then views of its arrays."""
        return _are_a_span(self.qpos_columns) and _are_a_span(self.dof_columns)

    @cached_property
    def qpos_view(self) -> slice:
        """Columns in ``qpos``, where the joints lie side by side."""
        return _span(self.qpos_columns)

    @cached_property
    def dof_view(self) -> slice:
        """Columns in ``qvel``, where the joints lie side by side."""
        return _span(self.dof_columns)


def _span(columns: torch.Tensor) -> slice:
    first = int(columns[0])
    return slice(first, first + len(columns))


def _are_a_span(columns: torch.Tensor) -> bool:
    view = _span(columns)
    return torch.equal(columns.cpu(), torch.arange(view.start, view.stop))


class RobotState:
    """A robot without its drives, batched over environments; every joint index is an index into ``joint_names``."""

    def __init__(self, cfg: ArticulationCfg, sim: Simulation):
        """Find the robot's joints in the simulation.

        Args:
            sim: The simulation that holds the robot.
        """
        self.cfg = cfg
        self._sim = sim
        layout = JointLayout.of_model(sim.model, cfg.joint_order, cfg.mjcf_path, sim.device)
        self._layout, self.joint_names, self.dof_columns = layout, list(layout.joint_names), layout.dof_columns
        self._body_ids = list(range(1, sim.model.nbody))
        self.body_names = [sim.model.body(i).name for i in self._body_ids]
        n, device, dtype = self.num_joints, sim.device, sim.dtype
        init = cfg.init_state
        limits = sim.tensor(layout.driven.range_of_motors(joint_ranges(sim.model, layout.driven.joints)))
        middle = limits.mean(dim=1, keepdim=True).nan_to_num(0.0)
        zeros = torch.zeros(sim.num_envs, n, dtype=dtype, device=device)
        default_pos, self._passive_pos = self._initial_positions()
        default_vel = sim.tensor(
            resolve_joint_values(init.joint_vel, self.joint_names, field="init_state.joint_vel", default=0.0)
        )
        self.data = ArticulationData(
            joint_pos=sim.qpos[:, self._layout.qpos_view] if self._layout.side_by_side else zeros.clone(),
            joint_vel=sim.qvel[:, self._layout.dof_view] if self._layout.side_by_side else zeros.clone(),
            default_joint_pos=default_pos.repeat(sim.num_envs, 1),
            default_joint_vel=default_vel.repeat(sim.num_envs, 1),
            joint_pos_limits=limits,
            soft_joint_pos_limits=middle + cfg.soft_joint_pos_limit_factor * (limits - middle),
            joint_pos_target=default_pos.repeat(sim.num_envs, 1),
            computed_torque=zeros.clone(),
            applied_torque=zeros.clone(),
        )
        if self._layout.root is not None:
            q, v = self._layout.root
            self.data.root_pos_w, self.data.root_quat_w = sim.qpos[:, q : q + 3], sim.qpos[:, q + 3 : q + 7]
            self.data.root_lin_vel_w, self.data.root_ang_vel_b = (
                sim.qvel[:, v : v + 3],
                sim.qvel[:, v + 3 : v + 6],
            )
        self._loops = ClosedLoops.of_model(sim.model, layout.dof_columns.tolist())
        if sim.turns_motors and (layout.driven.are_coupled or cfg.couplings):
            shared = {name: row for name, row in cfg.couplings.items() if name in row and name in self.joint_names}
            continuous = any(drive.implicit for drive in cfg.actuators.values())
            sim.couple(MotorCoordinates(sim, layout.driven, shared, continuous=continuous))
        elif layout.driven.are_coupled:
            motors = [name for name in layout.driven.names if name not in layout.driven.joints]
            raise ValueError(
                f"The motors {listed(motors)} move several joints together, which is simulated on the processor alone. "
                'Use sim.device = "cpu" (--device cpu).'
            )
        if self._loops is not None and sim.coordinates is None and (carrying := self._loops.carrying) is not None:
            sim.carrying = sim.tensor(carrying)
        self._initial_root = sim.tensor([*init.pos, *init.rot, *init.lin_vel, *init.ang_vel])

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self._sim.num_envs

    @property
    def _shape(self) -> tuple[int, int]:
        """Of a value for each joint of each environment."""
        return self.num_envs, self.num_joints

    @property
    def is_fixed_base(self) -> bool:
        """Whether the base is held in place."""
        return self._layout.root is None

    @property
    def driven(self) -> DrivenJoints:
        """What the drives move: joints, or joints through a constant matrix."""
        return self._layout.driven

    @property
    def slide_joints(self) -> tuple[str, ...]:
        """Those of the joints that slide."""
        model, driven = self._sim.model, self._layout.driven
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        return tuple(
            name
            for name in self.joint_names
            if all(int(model.joint(joint).type[0]) == slide for joint in driven.joints_of(name))
        )

    @property
    def joint_types(self) -> tuple[JointType, ...]:
        """Whether each of the joints turns or slides."""
        slides = self.slide_joints
        return tuple("slide" if name in slides else "hinge" for name in self.joint_names)

    @property
    def base_id(self) -> int:
        """Model index of the robot's base: its first body; where a joint moves that one on the world, the world."""
        first = self._body_ids[0]
        return 0 if self._sim.model.body_jntnum[first] and self.is_fixed_base else first

    def site_pose(self, name: str | None) -> torch.Tensor:
        """Pose of a site, or of a body, in the frame of the robot's base (``base_id``), as the state is now.

        Args:
            name: The site's name, or the body's.

        Returns:
            Position [m] and quaternion (w, x, y, z), (num_envs, 7).
        """
        sim, model = self._sim, self._sim.model
        sites = [model.site(i).name for i in range(model.nsite)]
        bodies = [model.body(i).name for i in range(model.nbody)]
        if name not in sites + bodies:
            raise ValueError(
                f"The site is {name!r}, expected a site or a body of the model. Available: "
                f"{', '.join(sites) or 'no site'}; bodies {', '.join(bodies)}. Name one in PaceCfg.ee_site, or in "
                "reach_env_cfg."
            )
        base = self.base_id
        quat, place, sites_at = (sim.bind(field) for field in ("xquat", "xpos", "site_xpos"))
        sim.forward()  # fills what is bound
        if name in sites:
            i = sites.index(name)
            local = sim.tensor(model.site_quat[i]).expand(self.num_envs, -1)
            at, turned = sites_at[:, i], multiply(quat[:, int(model.site_bodyid[i])], local)
        else:
            at, turned = (field[:, bodies.index(name)] for field in (place, quat))
        base_quat = quat[:, base]
        position = rotate_inverse(base_quat, at - place[:, base])
        rotation = multiply(base_quat * base_quat.new_tensor([1.0, -1.0, -1.0, -1.0]), turned)
        return torch.cat([position, rotation], dim=1)

    def find_joints(
        self, name_keys: str | Sequence[str], *, preserve_order: bool = False
    ) -> tuple[list[int], list[str]]:
        """Joints whose names match regular expressions.

        Args:
            preserve_order: Order by the expressions instead of by ``joint_names``.

        Returns:
            Indices and names.
        """
        return find_names(name_keys, self.joint_names, preserve_order, "joint")

    def find_bodies(
        self, name_keys: str | Sequence[str], *, preserve_order: bool = False
    ) -> tuple[list[int], list[str]]:
        """Bodies whose names match regular expressions: model body indices and names."""
        found, names = find_names(name_keys, self.body_names, preserve_order, "body")
        return [self._body_ids[i] for i in found], names

    def reset_state(self, env_ids: EnvIds = None) -> None:
        """Put all or some environments' robots back to their initial state, and their targets."""
        rows = self._sim.rows(env_ids)
        if self._layout.root is not None:
            self.write_root_state_to_sim(self._initial_root, env_ids)
        if len(self._layout.passive_names):
            assign(self._sim.qpos, rows, self._layout.passive_columns, self._passive_pos)
        self.write_joint_state_to_sim(
            self.data.default_joint_pos[rows], self.data.default_joint_vel[rows], env_ids=env_ids
        )
        self.data.joint_pos_target[rows] = self.data.default_joint_pos[rows]
        for target in (self.data.joint_vel_target, self.data.joint_effort_target):
            if target is not None:
                target[rows] = 0.0

    @property
    def targets(self) -> list[torch.Tensor]:
        """The targets that are set, (num_envs, num_joints) each."""
        data = self.data
        every = (data.joint_pos_target, data.joint_vel_target, data.joint_effort_target)
        return [target for target in every if target is not None]

    def write_joint_state_to_sim(
        self,
        position: torch.Tensor,
        velocity: torch.Tensor,
        joint_ids: JointIds = None,
        env_ids: EnvIds = None,
    ) -> None:
        """Write positions [rad] and velocities [rad/s], (len(env_ids), len(joint_ids)) or broadcastable.

        The passive joints of closed chains go where they close them, from where they are.
        """
        self._write(self._sim.qpos, self._layout.qpos_columns, position, joint_ids, env_ids, "the position")
        self._write(self._sim.qvel, self._layout.dof_columns, velocity, joint_ids, env_ids, "the velocity")
        if self._loops is not None:
            rows = slice(None) if env_ids is None else self._sim.resolve_env_ids(env_ids)
            self._sim.qpos[rows], self._sim.qvel[rows] = self._closed(self._sim.qpos[rows], self._sim.qvel[rows])
        self._refresh()

    def _closed(self, qpos: torch.Tensor, qvel: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Postures and speeds whose passive joints close the loops; those of drives stay."""
        if self._loops is None or (turn := self._sim.coordinates) is None:
            return (qpos, qvel) if self._loops is None else self._loops.closed(qpos, qvel)
        qpos, qvel = self._loops.closed(turn.of_driven(qpos, turn.places), turn.of_driven(qvel, turn.columns))
        return turn.positions_of_motors(qpos), turn.speeds_of_motors(qvel)

    def write_root_state_to_sim(self, root_state: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Write a floating base's state, (len(env_ids), 13) or broadcastable.

        Args:
            root_state: Position [m], quaternion (w x y z), linear velocity in the world [m/s] and angular
                velocity in the base's frame [rad/s].
            env_ids: The environments, or ``None`` for all.
        """
        if self._layout.root is None:
            raise ValueError("This robot's base is fixed: it has no root state to write.")
        rows, (q, v) = indices(env_ids), self._layout.root
        self._sim.qpos[rows, q : q + 7] = root_state[..., :7]
        self._sim.qvel[rows, v : v + 6] = root_state[..., 7:]

    def set_joint_position_target(
        self, target: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """Set position targets [rad]; they reach the drives with :meth:`write_data_to_sim`."""
        if joint_ids is None and env_ids is None:
            values = checked_values(target, self._shape, "the position target")
            self.data.joint_pos_target.copy_(torch.as_tensor(values))
        else:
            assign(self.data.joint_pos_target, indices(env_ids), indices(joint_ids), target, "the position target")

    def set_joint_velocity_target(
        self, target: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """Set velocity targets [rad/s]."""
        if self.data.joint_vel_target is None:
            self.data.joint_vel_target = zeros_like(self.data.joint_pos_target)
        assign(self.data.joint_vel_target, indices(env_ids), indices(joint_ids), target, "the velocity target")

    def set_joint_effort_target(self, target: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None) -> None:
        """Set feed-forward efforts [N m]."""
        if self.data.joint_effort_target is None:
            self.data.joint_effort_target = zeros_like(self.data.joint_pos_target)
        assign(self.data.joint_effort_target, indices(env_ids), indices(joint_ids), target, "the effort target")

    def _slow_down(self, place: torch.Tensor | slice, fastest: float) -> None:
        """Limit speeds, in the simulator itself."""
        speeds = self._sim.qvel
        if isinstance(place, slice):
            speeds[:, place].clamp_(-fastest, fastest)
        else:
            speeds[:, place] = speeds[:, place].clamp(-fastest, fastest)

    @property
    def qpos_columns(self) -> torch.Tensor:
        """Column of each joint in the simulation's positions, (num_joints,)."""
        return self._layout.qpos_columns

    @property
    def has_passive_joints(self) -> bool:
        """Whether joints without drives move too."""
        return bool(self._layout.passive_names)

    @property
    def closed_loops(self) -> ClosedLoops | None:
        """What closes the robot's kinematic loops; ``None`` where it has none."""
        return self._loops

    @property
    def load_effort(self) -> torch.Tensor:
        """Torque of gravity and of the other joints' motion on each joint [N m], (num_envs, num_joints)."""
        return -self._sim.qfrc_bias[:, self._layout.dof_view if self._layout.side_by_side else self._layout.dof_columns]

    def _initial_positions(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Initial positions [rad] of the joints, (num_joints,), and of the passive ones."""
        value, layout = self.cfg.init_state.joint_pos, self._layout
        if not isinstance(value, Mapping):
            own = resolve_joint_values(value, self.joint_names, field="init_state.joint_pos", default=0.0)
            return self._sim.tensor(own), self._sim.tensor(self._sim.model.qpos0)[layout.passive_columns]
        names = [*self.joint_names, *layout.passive_names]
        every = self._sim.tensor(resolve_joint_values(value, names, field="init_state.joint_pos", default=0.0))
        return every[: self.num_joints], every[self.num_joints :]

    def _write(
        self,
        field: torch.Tensor,
        columns: torch.Tensor,
        value: torch.Tensor | float,
        joint_ids: JointIds,
        env_ids: EnvIds,
        what: str = "the value",
    ) -> None:
        assign(field, indices(env_ids), columns[indices(joint_ids)], value, what)

    def _refresh(self) -> None:
        if not self._layout.side_by_side:
            torch.index_select(self._sim.qpos, 1, self._layout.qpos_columns, out=self.data.joint_pos)
            torch.index_select(self._sim.qvel, 1, self._layout.dof_columns, out=self.data.joint_vel)
