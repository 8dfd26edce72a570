"""Errors on the recordings that were not trained on."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pace_optim.diagnosis.fitting.side_by_side import SideBySide, Slot
from pace_optim.diagnosis.judging.acceptance import BlockErrors, block_errors
from pace_optim.diagnosis.model.fitted import Fitted
from pace_optim.single_joint_model.problem import TwinProblem


def validation_errors(problem: TwinProblem, models: Sequence[Fitted]) -> list[BlockErrors]:
    """Errors of fitted models on the recordings that were not trained on."""
    slots = [Slot(model=m.model, rows=1) for m in models]
    batch = SideBySide(problem, slots, training=False)
    where = batch.dataset.validation
    every = torch.zeros_like(where)
    every[: batch.dataset.last_step(where)] = True
    errors = batch.simulate([m.model.to_physical(m.x)[None] for m in models], every)
    return [block_errors(error, where[: errors.shape[1]], problem.control_dt) for error in errors]
