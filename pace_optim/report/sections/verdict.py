"""A diagnosis in short: what is missing, how large it is, and the run that has it."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from pace_actuators.joint_units import joint_label, units_for
from pace_actuators.text import capitalised, conjoined, in_words, listed, sizes_by_joints, three_figures
from pace_optim.run.result import FitResult
from pace_optim.terminal.cli import command

from ..markup import bold, bullets, html, joined, table
from ..run_data import RunData

_SHOWN = 4
"""Joints in the headline, at most."""


def verdict_first(run: RunData) -> Markup:
    """For the top of the page: the verdict, sizes, likes, and a link to the run that has what was missing."""
    with run.blaming("diagnosis.json"):
        return _in_short(run)


def _in_short(run: RunData) -> Markup:
    content = run.read_json("diagnosis.json")
    if not content:
        return Markup("")
    said = [
        f"{effect} cannot be separated from {', '.join(likes)}" for effect, likes in content.get("likes", {}).items()
    ]
    link = html('<p><a href="#diagnosis">What was tried, and the evidence</a></p>')
    return _callout(run, content, joined([_laws(content), bullets(said, "notes") if said else Markup(""), link]))


def _laws(content: dict[str, Any]) -> Markup:
    """Of each joint the law that was found, how large it is, and the error before and after, also in floors.

    Joints without a law that end near their floor share a row, with the largest of their errors.
    """
    joints, types = content["joints"], [joint.get("type", "hinge") for joint in content["joints"].values()]
    curves = {label.partition("@")[0] for label in content.get("free_form", [])}
    sizes: dict[tuple[str, str], list[str]] = {}
    for (effect, parameter, text), own in sizes_by_joints(content.get("sizes", [])).items():
        for name in own:
            sizes.setdefault((effect, name), []).append(f"{parameter} {text}")
    rows = []
    for (name, joint), own in zip(joints.items(), types, strict=True):
        if joint["effects"] or name in content.get("more", {}):
            laws = [f"curve: {in_words(effect).lower()}" if effect in curves else effect for effect in joint["effects"]]
            size = ["; ".join(sizes.get((effect, name), [])) for effect in joint["effects"]]
            knots = ["knots: see the diagnosis"] if curves & set(joint["effects"]) else []
            about = [", ".join(laws) or "–", "; ".join([*filter(None, size), *knots]) or "–"]
            rows.append([bold(joint_label(name, own, types)), *about, *_errors([joint])])
    others = [j for name, j in joints.items() if not j["effects"] and name not in content.get("more", {})]
    if others:
        which = f"{'other' if rows else 'all'} joints ({len(others)}): the largest"
        rows.append([which, "–", "–", *_errors(others)])
    parts = " (validation / training)" if any(joint.get("training_rmse") for joint in joints.values()) else ""
    unit = units_for("mrad", types)
    head = ["joint", "law found", "size", f"before [{unit}]", f"left [{unit}]{parts}", "left in floors"]
    return table(head, rows, "laws")


def _errors(joints: Sequence[dict[str, Any]]) -> list[str]:
    """The largest error before and after, in validation and training, and the latter in floors."""
    keys = [key for key in ("validation_rmse_after", "training_rmse") if joints[0].get(key) is not None]
    return [
        three_figures(1e3 * max(joint["validation_rmse_before"] for joint in joints)),
        " / ".join(three_figures(1e3 * max(joint[key] for joint in joints)) for key in keys),
        " / ".join(f"{max(joint[key] / joint['floor'] for joint in joints):.2g}" for key in keys),
    ]


def headline(run: RunData) -> str:
    """The verdict for the top of the page: "Missing: Stribeck friction at LF_KFE and RF_KFE"; else ""."""
    with run.blaming("diagnosis.json"):
        content = run.read_json("diagnosis.json")
        return _heading(run, content)[1] if content else ""


def is_before(run: RunData) -> bool:
    """Whether another run has what was found to be missing in this one: then that run's error says more."""
    with run.blaming("diagnosis.json"):
        content = run.read_json("diagnosis.json")
        if not content:
            return False
        return not _has_it(run.result, content) and _other_run(run, content) is not None


def _heading(run: RunData, content: dict[str, Any]) -> tuple[str, str]:
    """Class and words of a diagnosis' heading. It is good where nothing is missing beside what was found."""
    fit, has_it = run.result, _has_it(run.result, content)
    left = f"{fit.times_noise or 0.0:,.0f} times the noise" if fit.std_means_nothing else ""
    if content["verdict"] == "nothing_missing":
        if left:  # each joint alone is at its floor: the fit of the robot is not
            return "bad", f"No effect is missing, but this fit ended at {left}"
        return "good", "Nothing is missing"
    found, more = conjoined(_found(content)), content.get("more", {})
    rest = [f"Covered by a curve: {listed(covered, _SHOWN)}"] if (covered := _covered(content)) else []
    if more:
        rest.append(f"More is missing on {listed((f'{joint} ({left})' for joint, left in more.items()), _SHOWN)}")
    if not found:
        return "bad", ". ".join(["Something is missing, and no known effect has earned its name", *rest])
    if left and has_it and not more:
        rest.append(f"More is missing: the error is {left}")
    elif content["verdict"] == "unknown" and not rest:
        rest.append("More is missing")
    is_bad = any(each.startswith("More") for each in rest) or content["verdict"] == "unknown"
    begin, this = ("Missing", " in this run") if content["added"] else ("Wrong in the model file", " of this run")
    if has_it:
        begin, this = "In this run" if rest else "What was missing is in this run", ""
    elif rest or not _other_run(run, content):
        this = ""
    return "bad" if is_bad else "good", ". ".join([f"{begin}{this}: {found}", *rest])


def _found(content: dict[str, Any]) -> list[str]:
    """What the diagnosis names: "Stribeck friction at LF_KFE", "mass of the link shank"; a single "" without names."""
    names = [f"{' and '.join(link['parts'])} of the link {link['link']}" for link in content.get("links", [])]
    for effect in dict.fromkeys(label.partition("@")[0] for label in content["added"]):
        joints = [name for name, joint in content["joints"].items() if effect in joint["effects"]]
        where = listed(joints) if len(joints) <= _SHOWN else f"{len(joints)} joints"
        names.append(f"{effect.replace('_', ' ')} at {where}" if joints else effect)
    return [capitalised(names[0]), *names[1:]] if names else [""]


def _covered(content: dict[str, Any]) -> list[str]:
    """Joints on which a curve stands where no effect has earned its name."""
    curves = {label.partition("@")[0] for label in content.get("free_form", [])}
    return [name for name, joint in content["joints"].items() if curves & set(joint["effects"])]


def _has_it(fit: FitResult, content: dict[str, Any]) -> bool:
    """Whether a fit has the effects and links that the diagnosis found."""
    effects, links = content.get("paying") or content["added"], content.get("links", [])
    found = {(value["parameter"], link["link"]) for link in links for value in link["values"]}
    sought = {(name, key) for name, values in fit.parameters.items() for key in values}
    return bool(effects or links) and set(effects) <= set(fit.effects) and found <= sought


def _callout(run: RunData, content: dict[str, Any], more: Markup) -> Markup:
    """What is missing, and the run that has it, or how to add it to a run."""
    effects = content.get("paying") or content["added"]
    links = [link["label"] for link in content.get("links", [])]
    other = _other_run(run, content)
    return html(
        '<div class="callout {{ css }}">{% for each in summary %}<p>{{ each }}</p>{% endfor %}'
        "{% if has_it %}<p>This run is the fit with it.</p>{% elif (effects or links) and not other %}<p>{{ why }}: "
        "<code>{{ command }} …{% if effects %} --effects {{ effects }}{% endif %}{% if links %} --links {{ links }}"
        '{% endif %}</code></p>{% endif %}{% if other %}<p class="other">'
        'The run {{ "without" if has_it else "with" }} it: <b>'
        '<a href="{{ other }}/report.html">{{ other.name }}</a></b></p>{% endif %}{{ more }}</div>',
        css=_heading(run, content)[0],
        summary=content.get("evidence") or [content["summary"]],
        has_it=_has_it(run.result, content),
        effects=shlex.join(dict.fromkeys([*run.result.effects, *effects])),
        links=shlex.join(links),
        other=other,
        why="Add it" if content["added"] or links else "Until it is known, this lowers the error",
        command=command("fit"),
        more=more,
    )


def _other_run(run: RunData, content: dict[str, Any]) -> Path | None:
    """From a diagnosed run to the one with what was missing, and back: its folder, seen from the run's.

    That is the refit of the diagnosis, or the last run beside it that has what was found on the same recordings.
    """
    here, places, has_it = run.folder.resolve(), [Path(each) for each in content["runs"]], _has_it(run.result, content)
    if len(places) > 1 or has_it:
        others = [place for place in places if place.name != here.name]
    else:
        others = [path.parent for path in sorted(here.parent.glob("*/result.json")) if _answers(path, run, content)]
    if not others:
        return None
    beside = here.parent / others[-1].name  # runs that are moved are moved together
    return Path(os.path.relpath(beside if beside.is_dir() else others[-1].resolve(), here))


def _answers(path: Path, run: RunData, content: dict[str, Any]) -> bool:
    """Whether a run beside this one has what was found, on the same recordings; not if it cannot be read."""
    try:
        other = FitResult.load(path.parent)
    except ValueError:
        return False
    return other.recordings == run.result.recordings and _has_it(other, content)
