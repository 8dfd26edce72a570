"""Which variable carries what the model does not explain."""

from __future__ import annotations

from typing import Any

import torch

from pace_optim.diagnosis.descent import Fitted
from pace_optim.joint_twins.problem import TwinProblem


def error_map(problem: TwinProblem, model: Fitted, floor: torch.Tensor) -> dict[str, Any]:
    """Placeholder until the maps are drawn."""
    del problem, model, floor
    return {}
