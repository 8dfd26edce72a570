"""A robot has one delay: joints that follow later than it are held at it, so that what makes them late is sought.

Simulated alone, each joint has a separate delay, which would take up what the whole robot's model cannot.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from pace_optim.diagnosis.diagnosis_cfg import DEFAULT, DiagnosisCfg
from pace_optim.joints.fits.base_fit import later_than_most
from pace_optim.joints.fits.fits import Fits
from pace_optim.joints.fits.fitted import Fitted
from pace_optim.joints.fits.model import COLUMN
from pace_optim.joints.simulation.problem import TwinProblem

_DELAY = COLUMN["delay"]


def hold_late_joints(
    fits: Fits, twins: TwinProblem, base: Fitted, *, cfg: DiagnosisCfg = DEFAULT
) -> tuple[Fitted, list[str]]:
    """The base model with the robot's delay on joints that are later and have nothing else to explain.

    Args:
        fits: Fits models.
        twins: The joints simulated alone.
        base: The base model, fitted, with a delay of each joint's own.
        cfg: When a joint is late.

    Returns:
        The model, fitted with its Jacobian (``base`` itself where no joint is late), and what was held, in a sentence.
    """
    if not cfg.has("late_joints"):
        return base, []
    delay = base.physical[:, _DELAY]
    late = later_than_most(delay, cfg=cfg.fitting)
    while bool(late.any()):
        held = _held(fits, twins, base, late, delay.median())
        with_one, with_own = (errors.mse for errors in fits.validation_errors(twins, [held, base]))
        if (only_late := late & (cfg.judging.far**2 * with_own < with_one)).equal(late):
            return held, [_sentence(twins, delay, late)]
        late = only_late
    return base, []


def _held(fits: Fits, twins: TwinProblem, base: Fitted, joints: torch.Tensor, delay: torch.Tensor) -> Fitted:
    """The base model fitted with that delay on some joints."""
    lower, upper = base.model.lower.clone(), base.model.upper.clone()
    lower[joints, _DELAY] = upper[joints, _DELAY] = delay
    start = Fitted.start(replace(base.model, lower=lower, upper=upper), base.physical)
    return fits.side_by_side(twins, [start], fits.cfg.again, keep_jacobian=True)[0]


def _sentence(twins: TwinProblem, delay: torch.Tensor, late: torch.Tensor) -> str:
    one, ms = delay.median(), 1e3 * twins.control_dt
    said = [f"{twins.joint_names[j]} by {ms * float(delay[j] - one):.2g} ms" for j in late.nonzero()[:, 0].tolist()]
    return (
        f"Some joints are later than the delay of {ms * float(one):.3g} ms that most have: {', '.join(said)}. The "
        "model has a single delay, so the extra lag of these joints was treated as an error to explain."
    )
