"""Many models of the joints, simulated side by side by compiled kernels: on a GPU, or on the processor."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial

import torch

from pace_envs.devices import find_device
from pace_optim.diagnosis.diagnosis_cfg import DiagnosisCfg
from pace_optim.diagnosis.fitting.fits import Fits
from pace_optim.diagnosis.fitting.side_by_side import SideBySide, Slot
from pace_optim.one_kernel import KernelRollout, NotTraceableError
from pace_optim.one_kernel.batch import Compiler
from pace_optim.one_kernel.host import host_kernels
from pace_optim.one_kernel.nvrtc import kernels_of
from pace_optim.single_joint_model.problem import TwinProblem


class KernelSideBySide(SideBySide):
    """A :class:`SideBySide` whose errors come from kernels and stay on their device.

    Where a kernel cannot do what an effect of the user's does, the drives themselves simulate as ever.
    """

    def __init__(
        self,
        problem: TwinProblem,
        slots: Sequence[Slot],
        training: bool,
        *,
        compiler: Compiler,
        device: torch.device,
    ):
        """Build the environment and what runs it.

        Args:
            problem: The joints simulated alone; its own effects are not used.
            slots: The models.
            training: Whether only recordings that are trained on are simulated.
            compiler: Compiles kernels.
            device: Where they run.
        """
        super().__init__(problem, slots, training)
        count, parts, begin = self.dataset.num_recordings, [], 0
        for _, own in itertools.groupby(self.slots, key=lambda slot: slot.model.effects):
            end = begin + count * sum(slot.rows for slot in own)
            parts.append(range(begin, end))
            begin = end
        self._kernels: KernelRollout | None = KernelRollout(self.rollout, parts, compiler, device)
        self._device = device
        self._measured = self.dataset.measured.to(device)

    @torch.inference_mode()
    def simulate(self, physical: Sequence[torch.Tensor], where: torch.Tensor, stride: int = 1) -> torch.Tensor:
        """As a :class:`SideBySide`."""
        try:
            return super().simulate(physical, where, stride)
        except NotTraceableError:
            self._kernels = None
            return super().simulate(physical, where, stride).to(self._device)

    def _errors(self, bias: torch.Tensor, steps: torch.Tensor) -> torch.Tensor:
        if self._kernels is None:
            return super()._errors(bias, steps)
        sim = self._kernels.positions(steps).view(len(steps), *bias.shape)
        return sim.sub_(bias.to(self._device)).sub_(self._measured[steps.to(self._device)][:, None]).float()


def fits_on(device: str, cfg: DiagnosisCfg) -> Fits:
    """What fits models on a device: ``"cpu"``, or a GPU as ``"cuda:0"``.

    On a processor with a compiler of C++ the same kernels run there; without one, the drives themselves do.

    Raises:
        ValueError: If there is no such device.
    """
    own = find_device(device)
    if own.type == "cpu":
        compiler = host_kernels()
        if compiler is None:
            return Fits(cfg=cfg)
        return Fits(cfg=cfg, batch=partial(KernelSideBySide, compiler=compiler, device=own))
    return Fits(cfg=cfg, batch=partial(KernelSideBySide, compiler=kernels_of(own), device=own), on_gpu=True)
