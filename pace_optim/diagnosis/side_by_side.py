"""Many models of the joints, simulated side by side in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from pace_actuators.effects import Effect, EffectCfg
from pace_optim.diagnosis.model import BASE, JointModel
from pace_optim.joint_twins.problem import TwinProblem
from pace_optim.rollout import Rollout


@dataclass(frozen=True, kw_only=True, eq=False)
class Slot:
    """A model and how many parameter sets of it are simulated."""

    model: JointModel
    rows: int


class SideBySide:
    """Simulates several parameter sets of several models on all recordings of a problem at once.

    An effect that is tried costs only in the environments of its slot.
    """

    def __init__(self, problem: TwinProblem, slots: Sequence[Slot], training: bool):
        """Build the environment.

        Args:
            problem: The joints simulated alone; its own effects are not used.
            slots: The models; each may have one effect that is not common to all.
            training: Whether only recordings that are trained on are simulated.
        """
        self.slots = list(slots)
        first = slots[0].model.effects
        self._common = tuple(e for e in first if all(e in slot.model.effects for slot in slots))
        self._own = [next((e for e in slot.model.effects if e not in self._common), None) for slot in slots]
        evaluator_problem = problem.with_effects(self._cfgs(problem, training))
        evaluator = evaluator_problem.training_evaluator() if training else evaluator_problem.evaluator()
        self.dataset = evaluator.dataset
        self._num_candidates = sum(slot.rows for slot in slots)
        self.rollout: Rollout = evaluator.rollout(self._num_candidates)

    @torch.inference_mode()
    def simulate(self, physical: Sequence[torch.Tensor], where: torch.Tensor, stride: int = 1) -> torch.Tensor:
        """Errors of all parameter sets, simulated less measured.

        Args:
            physical: For each slot (rows, n, P).
            where: Which samples count, (T, R) bool.
            stride: Only every so many steps.

        Returns:
            (candidates, K, R, n) float32 [rad], zero where there is no sample; the slots one after another.
        """
        rollout, count = self.rollout, self.dataset.num_recordings
        rollout.env.scene.reset()
        base = torch.cat([values[..., : len(BASE)] for values in physical]).repeat_interleave(count, dim=0)
        self._write_base(base)
        self._write_effects(physical)
        rollout.look_at(where)
        rollout.begin()
        bias = base[..., BASE.index("encoder_bias")]
        steps = where.any(dim=1).nonzero()[:, 0][::stride]
        index = {int(step): i for i, step in enumerate(steps)}
        shape = (self._num_candidates, count, bias.shape[1])
        errors, bias = torch.zeros(len(steps), *shape, dtype=torch.float32), bias.view(shape)
        for step, sim in enumerate(rollout.positions_at_every_step()):
            if step in index:
                errors[index[step]] = (sim.view(shape) - bias).sub_(self.dataset.measured[step])
        errors *= where[steps][:, None, :, None]
        return errors.nan_to_num_(nan=1e3, posinf=1e3, neginf=-1e3).clamp_(-1e3, 1e3).permute(1, 0, 2, 3)

    def split(self, values: torch.Tensor) -> list[torch.Tensor]:
        """The parts of something with one row per candidate, slot by slot."""
        return list(values.split([slot.rows for slot in self.slots]))

    def _groups(self) -> list[list[int]]:
        """Indices of neighbouring slots whose own effect is the same: one effect acts for all of them."""
        groups: list[list[int]] = []
        for i, own in enumerate(self._own):
            if groups and own is not None and self._own[groups[-1][0]] is own:
                groups[-1].append(i)
            else:
                groups.append([i])
        return groups

    def _cfgs(self, problem: TwinProblem, training: bool) -> list[EffectCfg]:
        count = len(problem.dataset.trained()) if training else problem.dataset.num_recordings
        cfgs = [EffectCfg(effect=effect.name) for effect in self._common]
        start = 0
        for group in self._groups():
            end = start + sum(self.slots[i].rows for i in group) * count
            own = self._own[group[0]]
            if own is not None:
                cfgs.append(EffectCfg(effect=own.name, env_rows=slice(start, end)))
            start = end
        return cfgs

    def _write_base(self, base: torch.Tensor) -> None:
        robot = self.rollout.robot
        column = dict(zip(BASE, base.unbind(dim=-1), strict=True))
        robot.write_joint_armature_to_sim(column["armature"])
        robot.write_joint_viscous_friction_coefficient_to_sim(column["viscous_friction"])
        robot.write_joint_friction_coefficient_to_sim(column["friction"])
        for actuator in robot.actuators.values():
            actuator.update_encoder_bias(column["encoder_bias"][:, actuator.joint_indices])
            actuator.update_time_lags(column["delay"][:, actuator.joint_indices])

    def _write_effects(self, physical: Sequence[torch.Tensor]) -> None:
        count, robot = self.dataset.num_recordings, self.rollout.robot
        for actuator in robot.actuators.values():
            stack = actuator.effects
            if stack is None:
                continue
            ids = actuator.joint_indices
            by_place = {(effect.name, effect.rows.start, effect.rows.stop): effect for effect in stack.effects}
            for common in self._common:
                values = torch.cat(
                    [_of_effect(slot.model, common, v) for slot, v in zip(self.slots, physical, strict=True)]
                )
                robot.write_effect_to_sim(
                    actuator, by_place[common.name, None, None], values.repeat_interleave(count, dim=0)[:, ids]
                )
            for group in self._groups():
                own = self._own[group[0]]
                if own is None:
                    continue
                begin = sum(slot.rows for slot in self.slots[: group[0]]) * count
                end = begin + sum(self.slots[i].rows for i in group) * count
                values = torch.cat([_of_effect(self.slots[i].model, own, physical[i]) for i in group])
                robot.write_effect_to_sim(
                    actuator, by_place[own.name, begin, end], values.repeat_interleave(count, dim=0)[:, ids]
                )


def _of_effect(model: JointModel, effect: type[Effect], physical: torch.Tensor) -> torch.Tensor:
    """An effect's values (rows, n, parameters), null where a joint does not have it."""
    values = physical[..., model.columns(effect)]
    null = torch.tensor([p.start if p.null is None else p.null for p in effect.parameters], dtype=torch.float64)
    return torch.where(model.has[model.effects.index(effect)][:, None], values, null)
