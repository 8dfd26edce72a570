"""What the fit is worth, in words, with everything to be warned of on top."""

from __future__ import annotations

import math
from collections.abc import Iterable
from textwrap import dedent

import numpy as np
from markupsafe import Markup

from pace_actuators.drive_result import ALL
from pace_actuators.joint_units import JointType, joint_label, units_for
from pace_actuators.text import (
    SHOWN,
    duration,
    in_short,
    position_text,
    position_unit,
    pretty_unit,
    three_figures,
    with_table,
)
from pace_optim.run.result import FitResult
from pace_optim.run.summary import ABOVE_NOISE, above_noise, few_joints, next_lines, why_above_noise

from ..markup import Section, bullets, folded, html
from ..run_data import RunData
from .verdict import headline, is_before, verdict_first

_STOPPED_EARLY = ("max_iteration", "interrupted")


def overview(run: RunData) -> Section:
    """The head of the page."""
    result = run.result
    head = html(
        '<p class="eyebrow">{{ robot }} · {{ task }} · {{ folder }}</p><h1>{{ headline }}</h1>'
        '{% if before %}{{ diagnosed }}<h3>This run is the fit without it</h3>{% endif %}<p class="lead">{{ verdict }}'
        "</p>{% if not before %}{{ diagnosed }}{% endif %}{% if next %}<p>Next: <code>{{ next }}</code></p>{% endif %}",
        robot=result.robot_name,
        task=result.task,
        folder=run.folder.resolve().name,
        headline=headline(run) or _plain_headline(result),
        verdict=_verdict(run),
        diagnosed=verdict_first(run),
        before=is_before(run),
        next=_next(run),
    )
    return Section(
        id="overview",
        title="Overview",
        html=head + _figures(result) + _warnings(result) + _errors_by_joint(result),
    )


def _plain_headline(result: FitResult) -> str:
    """Without a diagnosis: how far the error is above the noise, if that is known."""
    if not result.times_noise:
        return _follows(result)
    if result.std_means_nothing:
        return f"{result.times_noise:,.0f} times the noise: physics is missing"
    errors = result.rmse.get("validation") or result.rmse["train"]
    times = result.times_noise * errors[ALL] / result.rmse["train"][ALL]
    where = "on held-out data" if result.rmse.get("validation") else "on the training data"
    return (
        f"{times:.2g} times the noise {where}: {why_above_noise(result)}"
        if times >= ABOVE_NOISE
        else f"At the noise {where}"
    )


def _follows(result: FitResult) -> str:
    error = result.rmse.get("validation", {}).get(ALL)
    if error is not None:
        return f"The held-out error is {_of_all(result, error)}"
    return f"The training error is {_of_all(result, result.rmse['train'][ALL])}"


def _of_all(result: FitResult, error: float | None) -> str:
    return position_text(error, result.joint_types)


def _verdict(run: RunData) -> str:
    train = run.result.rmse["train"].get(ALL)
    held_out = run.result.rmse.get("validation", {}).get(ALL)
    share = _share_of_motion(run, held_out is not None)
    part = "" if share is None else f", {_percent(share)} of the motion"
    sentences = [f"{_follows(run.result)} (RMS of all joints){part}."]
    if held_out is None:
        sentences.append("Nothing was kept for validation, so this says little of other motions.")
    else:
        sentences.append(f"The training error is {_of_all(run.result, train)}.")
    if len(run.result.joint_names) > 1:
        worst, where = _worst_joint(run.result)
        sentences.append(f"The worst joint is {worst} with {position_text(where, [run.result.joint_type(worst)])}.")
    sentences.append(few_joints(run.result))
    last = run.result.stop_reasons[-1] if run.result.stop_reasons else ""
    if last.startswith(_STOPPED_EARLY):
        sentences.append(f"The fit was stopped before it had converged ({last}): going on may lower the error.")
    return " ".join(filter(None, sentences))


def _next(run: RunData) -> str:
    """The command that comes next, where nothing was diagnosed."""
    lines = [] if run.read_json("diagnosis.json") else next_lines(run.result, run.folder.resolve())
    return "".join(lines).removeprefix("next: ")


def _percent(share: float) -> str:
    return "less than 0.01 %" if share < 1e-4 else f"{100 * share:.2g} %"


def _share_of_motion(run: RunData, held_out: bool) -> float | None:
    """The error as a part of the joints' standard deviation, on what was held out or on what was trained on."""
    error, moved = 0.0, 0.0
    for recording in run.recordings:
        where = recording.held_out if held_out else recording.train
        if where.any():
            measured = recording.measured[where]
            error += float(np.square(recording.error[where]).sum())
            moved += float(np.square(measured - measured.mean(axis=0)).sum())
    share = (error / moved) ** 0.5 if moved > 0 else math.nan
    return share if math.isfinite(share) else None


def _worst_joint(result: FitResult) -> tuple[str, float]:
    errors = result.rmse.get("validation") or result.rmse["train"]
    return max(((joint, value) for joint, value in errors.items() if joint != ALL), key=lambda item: item[1])


def _times(ratio: float) -> str:
    return "below 0.1" if ratio < 0.1 else f"{ratio:.3g}"


_PARTS = ("train", "validation")


def _figures(result: FitResult) -> Markup:
    """The handful of numbers that everyone asks for."""
    worst, error = _worst_joint(result)
    held_out, train = result.rmse.get("validation", {}).get(ALL), result.rmse["train"].get(ALL)
    factor, unit = position_unit([held_out, train, error], ["hinge"])

    def said(value: float | None, types: Iterable[JointType] = result.joint_types) -> str:
        return "–" if value is None else units_for(f"{factor * value:.3g} {unit}", types)

    figures = [
        ("Validation", said(held_out), "error of all joints"),
        ("Training", said(train), "error of all joints"),
        ("Worst joint", said(error, [result.joint_type(worst)]), worst),
        ("Delay", f"{1e3 * result.delay_s:.3g} ms{' ?' * result.std_means_nothing}", f"of the {result.delay_mode}"),
        ("Score", f"{result.score:.2e}", units_for("rad², sum over the joints", result.joint_types)),
        ("Found in", duration(result.wall_time_s), f"{result.simulated_steps / 1e6:.3g} M simulated steps"),
    ]
    if result.times_noise and train:
        noise = train / result.times_noise
        parts = [("training", train), ("validation", held_out)]
        times = [f"{_times(error / noise)} × in {part}" for part, error in parts if error is not None]
        figures.insert(2, ("Noise", said(noise), f"the error is {', '.join(times)}"))
    if result.objective:
        own, kept = ("–" if part is None else f"{part:.2e}" for part in map(result.objective.get, _PARTS))
        figures.insert(-1, ("Objective", own, f"in training, {kept} in validation"))
    return html(
        '<dl class="figures">{% for name, value, about in figures %}<div><dt>{{ name }}</dt><dd>{{ value }}</dd>'
        "<dd class='small'>{{ about }}</dd></div>{% endfor %}</dl>",
        figures=figures,
    )


def _warnings(result: FitResult) -> Markup:
    count = len(result.warnings)
    if not count:
        text = "No parameter is at a bound, without influence, or confounded with another."
        if more := above_noise(result):
            text += f" But the training error is {more}."
        return html('<div class="callout good"><h3>No warnings of parameters</h3><p>{{ text }}</p></div>', text=text)
    title = "1 warning" if count == 1 else f"{count} warnings"
    sentences = [_with_table(pretty_unit(text)) for text in result.warnings]
    most = SHOWN if count > SHOWN + 1 else count  # one more takes no more room than its heading would
    said = bullets(sentences[:most])
    if rest := sentences[most:]:
        said += folded(len(rest), bullets(rest))
    text = (
        '<div class="callout bad"><h3>{{ title }}: read before you use the values '
        "<small>(meaning and cure of each code: docs/faq.md)</small></h3>{{ said }}</div>"
    )
    return html(text, title=title, said=said)


def _with_table(warning: str) -> Markup:
    """A warning, with the table and the line to copy below it that some have."""
    sentence, *table = with_table(warning)
    *rows, line = dedent("\n".join(table)).split("\n")
    text = '{{ sentence }}{% if line %}<pre class="rows">{{ rows }}</pre><pre>{{ line }}</pre>{% endif %}'
    return html(text, sentence=sentence, rows="\n".join(rows), line=line)


def _errors_by_joint(result: FitResult) -> Markup:
    """A row of bars per joint; a click shows its curves."""
    parts = [(name, result.rmse[name]) for name in ("train", "validation") if result.rmse.get(name)]
    every = [value for _, errors in parts for joint, value in errors.items() if joint != ALL]
    types = result.joint_types
    factor, unit = position_unit(every, ["hinge"])
    names, pattern = in_short(result.joint_names)
    labels = [joint_label(j, own, types, unit) for j, own in zip(names, types, strict=True)]
    largest = max([value for value in every if np.isfinite(value)], default=1.0) or 1.0
    rows = {
        (joint, label): [
            (name, f"{100 * errors[joint] / largest:.1f}", three_figures(factor * errors[joint]))
            for name, errors in parts
        ]
        for joint, label in zip(result.joint_names, labels, strict=True)
    }
    return html(
        '<h3>Error of each joint {{ pattern }} [{{ unit }}] {% for name in names %}<span class="key {{ name }}">'
        '{{ words[name] }}</span>{% endfor %}</h3><div class="errors">{% for (joint, label), bars in rows.items() %}'
        '<a class="error" href="#trajectories" data-joint="{{ joint }}"><b>{{ label }}</b><div>'
        '{% for name, width, value in bars %}<div class="bar {{ name }}"><i style="width:{{ width }}%"></i>'
        "<span>{{ value }}</span></div>{% endfor %}</div></a>{% endfor %}</div>",
        unit=units_for(unit, types),
        names=[name for name, _ in parts],
        pattern=pattern,
        words={"train": "training", "validation": "validation"},
        rows=rows,
    )
