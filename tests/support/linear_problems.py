"""Problems whose residuals are linear in the parameters."""

import numpy as np
import torch

from pace_envs.tasks.pace import Parameter
from pace_optim.estimate.derivatives import Jacobian
from pace_optim.problem.evaluator import Residuals
from pace_optim.problem.parameter_space import Colouring, ParameterSpace


def linear(columns, error, names=None):
    """A linear problem of one joint: residuals' derivatives (entries, T), residuals (T,), bounds ±1."""
    names = names or [f"p{i}" for i in range(len(columns))]
    count = len(names)
    space = ParameterSpace(
        [
            Parameter(name=n, unit="1", lower=(-1.0,), upper=(1.0,), apply=lambda env, v: None, keys=("j",))
            for n in names
        ]
    )
    shaped = torch.as_tensor(np.asarray(columns))[:, :, None, None]
    where = torch.ones(len(error), 1, dtype=torch.bool)
    residuals = Residuals(error=torch.as_tensor(error)[None, :, None, None], where=where, step=torch.arange(len(error)))
    colouring = Colouring(colours=tuple((i,) for i in range(count)), joints=((0,),) * count)
    return Jacobian(residuals=residuals, columns=shaped, colouring=colouring), space
