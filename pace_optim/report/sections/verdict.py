"""A diagnosis in short: what is missing, how large it is, and the run that has it."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Any

from markupsafe import Markup

from pace_actuators.text import capitalised, conjoined, in_words, listed, sizes_by_joints
from pace_optim.run.result import FitResult
from pace_optim.terminal.cli import command

from ..markup import bullets, html, joined
from ..run_data import RunData

_HEADINGS = {
    "link": ("good", "A link of the model file is wrong"),
    "effect": ("good", "An effect is missing, and it is known"),
    "nothing_missing": ("good", "Nothing is missing"),
    "unknown": ("bad", "Something is missing, and no known effect explains it"),
}
_PARTLY = 0.8
"""Effects that explain less than this part of the error above the floor are not all that is missing."""
_SHOWN = 4
"""Sizes in the overview, at most."""


def verdict_first(run: RunData) -> Markup:
    """For the top of the page: the verdict, sizes, likes, and a link to the run that has what was missing."""
    with run.blaming("diagnosis.json"):
        return _in_short(run)


def _in_short(run: RunData) -> Markup:
    content = run.read_json("diagnosis.json")
    if not content:
        return Markup("")
    sizes = [
        f"{effect} {parameter} of {listed(joints, 6)}: {text}"
        for (effect, parameter, text), joints in sizes_by_joints(content.get("sizes", [])).items()
    ]
    said = sizes[:_SHOWN]
    if len(sizes) > _SHOWN:
        said.append(f"and {len(sizes) - _SHOWN} more")
    said += [
        f"{effect} cannot be separated from {', '.join(likes)}" for effect, likes in content.get("likes", {}).items()
    ]
    link = html('<p><a href="#diagnosis">What was tried, and the evidence</a></p>')
    more = [*([bullets(said, "notes")] if said else []), _refit_link(run, content), link]
    return callout(content, run.result, joined(more))


def headline(run: RunData) -> str:
    """The verdict for the top of the page: "Missing: Stribeck friction at LF_KFE and RF_KFE"; else ""."""
    with run.blaming("diagnosis.json"):
        content = run.read_json("diagnosis.json")
        return _headline(content, run.result) if content else ""


def _headline(content: dict[str, Any], run: FitResult) -> str:
    css, heading, has_it = _heading(content, run)
    names = [f"{' and '.join(link['parts'])} of the link {link['link']}" for link in content.get("links", [])]
    for effect in dict.fromkeys(label.partition("@")[0] for label in content["added"]):
        joints = [name for name, joint in content["joints"].items() if effect in joint["effects"]]
        where = listed(joints) if len(joints) <= _SHOWN else f"{len(joints)} joints"
        names.append(f"{effect.replace('_', ' ')} at {where}" if joints else effect)
    if css == "bad" or not names:
        return heading
    begin = heading if has_it else "Missing" if content["added"] else "Wrong in the model file"
    return f"{begin}: {capitalised(conjoined(names))}"


def _heading(content: dict[str, Any], run: FitResult) -> tuple[str, str, bool]:
    """Class and words of a verdict's heading, and whether the run has what was missing."""
    css, heading = _HEADINGS.get(content["verdict"], ("bad", in_words(content["verdict"])))
    effects, part = content.get("paying") or content["added"], content.get("explained", 1.0)
    links = content.get("links", [])
    found = {(value["parameter"], link["link"]) for link in links for value in link["values"]}
    sought = {(name, key) for name, values in run.parameters.items() for key in values}
    has_it = bool(effects or links) and set(effects) <= set(run.effects) and found <= sought
    if has_it and content["verdict"] in ("effect", "link"):
        heading = "What was missing is in this run"
    if content.get("free_form"):
        part_known = "only a part of it is known" if content["added"] else "no known effect explains it"
        css, heading = "bad", f"Something is missing, and {part_known}: a curve takes the place of what is not"
    elif content["verdict"] not in ("nothing_missing", "link") and effects and (not content["added"] or part < _PARTLY):
        css, heading = "bad", f"Something is missing, and known effects explain {100 * max(0.0, part):.0f} % of it"
    return css, heading, has_it


def callout(content: dict[str, Any], run: FitResult, more: Markup | str = "") -> Markup:
    """What is missing, and how to add it to a run, unless that has it."""
    css, heading, has_it = _heading(content, run)
    effects = content.get("paying") or content["added"]
    links = [link["label"] for link in content.get("links", [])]
    return html(
        '<div class="callout {{ css }}"><h3>{{ heading }}</h3><p>{{ summary }}</p>{% if has_it %}<p>This run is the '
        "fit with it.</p>{% elif (effects or links) and not refitted %}<p>{{ why }}: <code>{{ command }} …"
        "{% if effects %} --effects {{ effects }}{% endif %}{% if links %} --links {{ links }}{% endif %}</code></p>"
        "{% endif %}{{ more }}</div>",
        css=css,
        heading=heading,
        summary=content["summary"],
        has_it=has_it,
        effects=shlex.join(dict.fromkeys([*run.effects, *effects])),
        links=shlex.join(links),
        refitted=len(content["runs"]) > 1,
        why="Add it" if content["added"] or links else "Until it is known, this lowers the error",
        command=command("fit"),
        more=more,
    )


def _refit_link(run: RunData, content: dict[str, Any]) -> Markup:
    """A link from a run to its refit, and back."""
    here, places = run.folder.resolve(), [Path(each) for each in content["runs"]]
    others = [place for place in places if place.name != here.name]
    if len(places) < 2 or not others:
        return Markup("")
    beside = here.parent / others[0].name  # runs that are moved are moved together
    other = beside if beside.is_dir() else others[0].resolve()
    what = "The run with it" if places[0].name == here.name else "The run without it"
    href = f"{Path(os.path.relpath(other, here)).as_posix()}/report.html"
    return html('<p>{{ what }}: <a href="{{ href }}">{{ name }}</a></p>', what=what, href=href, name=other.name)
