"""The sections of a report, in their order on the page.

A section is a function of a run that returns a :class:`Section`, or ``None`` where the run has nothing for it. One
more section is one more file here and its function in :data:`SECTIONS`.
"""

from collections.abc import Callable

from ..markup import Section
from ..run_data import RunData
from .consistency import consistency
from .correlation import correlation
from .diagnosis import diagnosis
from .failure import failure
from .ladder import ladder
from .making import making
from .overview import overview
from .parameters import parameters
from .recordings import recordings
from .scores import scores
from .trajectories import trajectories

SECTIONS: tuple[Callable[[RunData], Section | None], ...] = (
    overview,
    ladder,
    trajectories,
    failure,
    diagnosis,
    parameters,
    consistency,
    correlation,
    scores,
    recordings,
    making,
)

__all__ = ["SECTIONS"]
