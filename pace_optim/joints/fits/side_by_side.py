"""Many models of the joints, simulated side by side in one batch."""

from __future__ import annotations

import graphlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from pace_actuators.effects import Effect, EffectCfg
from pace_envs.compiler import CannotCompileError, Compiler
from pace_optim.joints.fits.model import BASE, COLUMN, JointModel
from pace_optim.joints.simulation.kernel_rollout import KernelRollout
from pace_optim.joints.simulation.problem import TwinProblem
from pace_optim.problem.rollout import Rollout

_PROCESSOR = torch.device("cpu")


@dataclass(frozen=True, kw_only=True, eq=False)
class Slot:
    """A model and how many parameter sets of it are simulated."""

    model: JointModel
    rows: int


class SideBySide:
    """Simulates several parameter sets of several models on all recordings of a problem at once.

    An effect costs only in the environments of the slots that have it.
    """

    def __init__(
        self,
        problem: TwinProblem,
        slots: Sequence[Slot],
        training: bool,
        *,
        compiler: Compiler | None = None,
        device: torch.device = _PROCESSOR,
    ):
        """Build the environment, and what runs it.

        Args:
            problem: The joints simulated alone; its own effects are not used.
            training: Whether only recordings that are trained on are simulated.
            compiler: Compiles kernels that simulate; without one the drives themselves do, on the processor.
            device: Where kernels run; errors stay there.
        """
        self.slots = list(slots)
        self._runs = _runs([slot.model.effects for slot in slots])
        evaluator_problem = problem.with_effects(self._cfgs(problem, training))
        evaluator = evaluator_problem.training_evaluator() if training else evaluator_problem.evaluator()
        self.dataset, self._phases = evaluator.dataset, evaluator.phases
        self._num_candidates = sum(slot.rows for slot in slots)
        self.rollout: Rollout = evaluator.rollout(self._num_candidates)
        self._device = device
        self._kernels = None if compiler is None else self._kernel_rollout(compiler)

    def _kernel_rollout(self, compiler: Compiler) -> KernelRollout:
        """What simulates by kernels: slots with the same effects share one."""
        count, parts, begin = self.dataset.num_recordings, [], 0
        for _, own in itertools.groupby(self.slots, key=lambda slot: slot.model.effects):
            end = begin + count * sum(slot.rows for slot in own)
            parts.append(range(begin, end))
            begin = end
        return KernelRollout(self.rollout, parts, compiler, self._device)

    @torch.inference_mode()
    def simulate(self, physical: Sequence[torch.Tensor], where: torch.Tensor, stride: int = 1) -> torch.Tensor:
        """Errors of all parameter sets, simulated less measured.

        Args:
            physical: For each slot (rows, n, P).
            stride: Only every so many steps.

        Returns:
            (candidates, K, R, n) float32 [rad], zero where there is no sample; the slots one after another.
        """
        steps = where.any(dim=1).nonzero()[:, 0][::stride]
        try:
            errors = self._errors(self._begin(physical, where), steps)
        except CannotCompileError:  # what an effect of the user's does is nothing for a kernel
            self._kernels = None
            errors = self._errors(self._begin(physical, where), steps)
        errors *= where[steps][:, None, :, None].to(errors.device)
        errors = errors.nan_to_num_(nan=1e3, posinf=1e3, neginf=-1e3).clamp_(-1e3, 1e3).permute(1, 0, 2, 3)
        if self._phases is None or self.dataset.weight is None:
            return errors
        known = self._phases.taken_out(errors.to("cpu", torch.float64), steps, where)
        return known.mul_(self.dataset.weight[steps]).to(errors)

    def _begin(self, physical: Sequence[torch.Tensor], where: torch.Tensor) -> torch.Tensor:
        """Write all parameter sets and begin; returns the encoders' biases, (candidates, R, n) [rad]."""
        rollout, count = self.rollout, self.dataset.num_recordings
        rollout.env.scene.reset()
        base = torch.cat([values[..., : len(BASE)] for values in physical]).repeat_interleave(count, dim=0)
        self._write_base(base)
        self._write_effects(physical)
        rollout.look_at(where)
        rollout.begin()
        bias = base[..., COLUMN["encoder_bias"]]
        return bias.view(self._num_candidates, count, bias.shape[1])

    def _errors(self, bias: torch.Tensor, steps: torch.Tensor) -> torch.Tensor:
        """Simulated less measured positions at some control steps, (K, candidates, R, n) float32 [rad]."""
        if self._kernels is not None:
            sim = self._kernels.positions(steps).view(len(steps), *bias.shape)
            measured = self.dataset.measured[steps].to(self._device)
            return sim.sub_(bias.to(self._device)).sub_(measured[:, None]).float()
        index = {int(step): i for i, step in enumerate(steps)}
        errors = torch.zeros(len(steps), *bias.shape, dtype=torch.float32)
        for step, sim in self.rollout.samples():
            if step in index:
                errors[index[step]] = (sim.view(bias.shape) - bias).sub_(self.dataset.measured[step])
        return errors.to(self._device)

    def split(self, values: torch.Tensor) -> list[torch.Tensor]:
        """The parts of something with one row per candidate, slot by slot."""
        return list(values.split([slot.rows for slot in self.slots]))

    def _cfgs(self, problem: TwinProblem, training: bool) -> list[EffectCfg]:
        count = len(problem.dataset.trained()) if training else problem.dataset.num_recordings
        return [EffectCfg(effect=run.effect.name, env_rows=self._env_rows(run, count)) for run in self._runs]

    def _env_rows(self, run: _Run, count: int) -> slice | None:
        """The environments of a run of slots, ``count`` for each parameter set; ``None`` if those are all."""
        if run.begin == 0 and run.end == len(self.slots):
            return None
        begin, end = (count * sum(slot.rows for slot in self.slots[:at]) for at in (run.begin, run.end))
        return slice(begin, end)

    def _write_base(self, base: torch.Tensor) -> None:
        for name, column in COLUMN.items():
            self.rollout.robot.write_base_parameter_to_sim(name, base[..., column])

    def _write_effects(self, physical: Sequence[torch.Tensor]) -> None:
        count, robot = self.dataset.num_recordings, self.rollout.robot
        for actuator in robot.actuators.values():
            stack = actuator.effects
            if stack is None:
                continue
            ids = actuator.joint_indices
            by_place = {(effect.name, effect.rows.start, effect.rows.stop): effect for effect in stack.effects}
            for run in self._runs:
                rows = self._env_rows(run, count) or slice(None)
                own = zip(self.slots[run.begin : run.end], physical[run.begin : run.end], strict=True)
                values = torch.cat([_of_effect(slot.model, run.effect, v) for slot, v in own])
                robot.write_effect_to_sim(
                    actuator,
                    by_place[run.effect.name, rows.start, rows.stop],
                    values.repeat_interleave(count, dim=0)[:, ids],
                )


@dataclass(frozen=True, kw_only=True)
class _Run:
    """Neighbouring slots that all have an effect: one instance of it acts for all of them."""

    effect: type[Effect]
    begin: int
    end: int
    """One after the last."""


def _runs(effects: Sequence[tuple[type[Effect], ...]]) -> list[_Run]:
    """The runs of each effect, in an order in which every slot has its effects in its own model's order."""
    runs = []
    for effect in _merged(effects):
        begin = 0
        for has, own in itertools.groupby(effect in each for each in effects):
            end = begin + len(list(own))
            if has:
                runs.append(_Run(effect=effect, begin=begin, end=end))
            begin = end
    return runs


def _merged(effects: Sequence[tuple[type[Effect], ...]]) -> list[type[Effect]]:
    """All effects of several models in an order that agrees with each model's own."""
    after = graphlib.TopologicalSorter[type[Effect]]()
    for each in effects:
        for before, effect in zip((None, *each), each, strict=False):
            after.add(effect, *([] if before is None else [before]))
    return list(after.static_order())


def _of_effect(model: JointModel, effect: type[Effect], physical: torch.Tensor) -> torch.Tensor:
    """An effect's values (rows, n, parameters), null where a joint does not have it."""
    values = physical[..., model.columns(effect)]
    null = torch.tensor([p.start if p.null is None else p.null for p in effect.parameters], dtype=torch.float64)
    return torch.where(model.has[model.effects.index(effect)][:, None], values, null)
