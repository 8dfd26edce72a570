"""Every tuned number of fits of single joints, in one place."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class FittingCfg:
    """How models are fitted: Levenberg–Marquardt of each joint, from coarse to fine."""

    stride: int = 2
    """Only every so many control steps count in a fit and in screening."""
    part: float = 0.7
    """Refits begin on so much of each window."""
    coarse: int = 8
    """Iterations in windows at the control step, ..."""
    fine: int = 3
    """then in windows at the problem's physics step, ..."""
    whole: int = 2
    """then on whole recordings, ..."""
    chords: int = 4
    """and so many steps with the last derivatives, which weak directions need."""
    rounds: int = 3
    """At most so many times the coarse iterations while a model still falls; the base model's reference, that of what
    was found, and a trimmed fit are made again as often at most."""
    again: int = 6
    """Iterations where refits begin, and of a model that was changed or moves along a new reference."""
    narrow: float = 1e-3
    """Normalised step of the derivatives. Over a tenth of it, sticking makes them rough: error bars were too small by
    up to 2.2 times, and fits ended short of the minimum."""
    wide: tuple[float, ...] = (3e-2, 1e-2)
    """The same first where contacts and sticking make the error rough; the next is taken when one leads no further."""
    enough: float = 3e-3
    """A joint whose score falls by less than this part, in two iterations in a row, has converged; so has one whose
    linear model promises less than a tenth of it."""
    falls: float = 0.05
    """A model still falls whose squared error has fallen by more than this part over the last ``rounds`` iterations."""
    gain: float = 0.9
    """The reference is renewed, or windows are left out, again where that lowered the error to less than this part."""
    behind: float = 3.0
    """A model is not worth the finer step above this many times the best one's RMSE, and a window is an outlier above
    this many times the median."""
    moved: float = 0.02
    """Where a normalised parameter has moved further than this the reference is computed again."""
    away: float = 0.05
    """Joints are simulated along the measured motion unless they are further from it than this (RMS) [rad]: then
    gravity is not linear in between."""
    near: float = 0.01
    """With effects its reference is renewed unless it is this near (RMS) [rad]."""
    late: float = 0.2
    """A joint is late that is so many control steps later than the median, ..."""
    scatters: float = 6.0
    """and so many times the joints' scatter."""
    block_s: float = 1.0
    """Length of a block of held-out samples [s]; shorter where that gives fewer than ``blocks``, ..."""
    shortest_s: float = 0.25
    """but never below this: in less time neighbours are alike."""
    swing_s: float = 0.05
    """The same of the time in which joints of a robot that walks are free: each phase begins anew."""
    blocks: int = 6
    """Blocks wanted."""


DEFAULT = FittingCfg()
"""As it is shipped."""
