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
from .replay import replay
from .scores import scores
from .trajectories import trajectories

SECTIONS: dict[Callable[[RunData], Section | None], str | None] = {
    overview: None,
    ladder: "comparison.json",
    trajectories: None,
    replay: "model.mjb",
    failure: "comparison.json",
    diagnosis: "diagnosis.json",
    parameters: None,
    consistency: "consistency.json",
    correlation: None,
    scores: "history.json",
    recordings: None,
    making: "settings.json",
}
"""Each with the file that it is about, where that is another than those of the fit."""

__all__ = ["SECTIONS"]
