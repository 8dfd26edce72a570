"""How the score fell, by search and by refinement."""

from __future__ import annotations

from pace_actuators.joint_units import units_for

from ..markup import Section, figure, log_step
from ..run_data import RunData

_SQUARED = "the squared error, summed over the joints"


def scores(run: RunData) -> Section | None:
    """The score over iterations, simulated steps or time."""
    history = run.history
    if history is None or not (history.search_best or history.refine_best):
        return None
    search, refine = history.places()
    axes = {
        "Iterations": (search, refine, "generations of the search and iterations of the refinement"),
        "Simulated steps": (history.search_steps, history.refine_steps, "simulated steps"),
        "Time": (history.search_time_s, history.refine_time_s, "time [s]"),
    }
    curves = [
        ("search, mean of the generation", history.search_mean, "var(--target)", True),
        ("search, best so far", history.search_best, "var(--measured)", True),
        ("refinement, best", history.refine_best, "var(--simulated)", False),
    ]
    curves = [curve for curve in curves if curve[1]]
    own = run.result.optimizer if run.result.objective else None
    unit = "" if own else units_for("rad²", run.result.joint_types)
    mode = "lines+markers" if len(search) + len(refine) < 80 else "lines"
    data = [
        {
            "type": "scatter",
            "mode": mode,
            "name": name,
            "x": search if is_search else refine,
            "y": values,
            "line": {"color": color, "width": 2},
            "marker": {"size": 5},
            "hovertemplate": f"%{{y:.3e}} {unit}",
        }
        for name, values, color, is_search in curves
    ]
    views = [
        {
            "label": label,
            "trace": {"x": [xs if is_search else xr for *_, is_search in curves]},
            "layout": {"xaxis.title.text": title, "xaxis.autorange": True},
        }
        for label, (xs, xr, title) in axes.items()
    ]
    layout = {
        "xaxis": {"title": {"text": axes["Iterations"][2]}},
        "yaxis": {
            "type": "log",
            "tickformat": ".0e",
            "dtick": log_step(value for _, values, *_ in curves for value in values),
            "title": {"text": "objective" if own else f"score [{unit}]"},
        },
        "hovermode": "x unified",
    }
    return Section(
        id="scores",
        title="Score",
        lead=f"Mean over the training samples of {f'the objective {own}' if own else _SQUARED}.",
        html=figure("score", data, layout, views=views),
    )
