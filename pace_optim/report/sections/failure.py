"""Where the model fails: the worst places in words, a row per joint, and the curves to choose from."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from pace_actuators.joint_units import joint_label, units_for
from pace_actuators.text import position_unit, three_figures

from ..markup import Section, bullets, choice, html, json_script, table
from ..run_data import RunData
from .failure_figures import FIGURES, types_of


def failure(run: RunData) -> Section | None:
    """What ``compare.py`` found."""
    content = run.read_json("comparison.json")
    if not content:
        return None
    recordings = [recording["name"] for recording in content["recordings"]]
    page = {
        "joints": content["joint_names"],
        "figures": {name: {"traces": made.traces, "layout": made.layout} for name, made in FIGURES.items()},
        "cells": [
            [
                {
                    name: made.cell(content["joints"][joint], r, content["recordings"][r])
                    for name, made in FIGURES.items()
                }
                for joint in content["joint_names"]
            ]
            for r in range(len(recordings))
        ],
    }
    r, j = _worst_place(content)
    return Section(
        id="failure",
        title="Where the model fails",
        lead=content["summary"] + _basis(content),
        html=html(
            '{{ places }}{{ by_joint }}{{ notes }}<div class="chooser">{{ recording }}{{ joint }}'
            '{% for name, made in figures.items() %}<div data-figure="{{ name }}"><h3>{{ made.title }}</h3>'
            '<p class="said"></p><div class="canvas" style="height:{{ made.height }}px"></div></div>{% endfor %}'
            "{{ script }}</div>",
            places=_places(content),
            by_joint=_by_joint(content),
            notes=bullets(content["notes"], "notes") if content["notes"] else "",
            recording=choice("recording", recordings, "failure-", r),
            joint=choice("joint", content["joint_names"], "failure-", j),
            figures=FIGURES,
            script=json_script(page),
        ),
    )


def _worst_place(content: dict[str, Any]) -> tuple[int, int]:
    """Recording and joint that the curves open on: of the worst place's joint, the recording with the largest error."""
    names = content["joint_names"]
    joint = content["worst_places"][0]["joint"] if content["worst_places"] else names[0]
    largest = [max(filter(None, one["rmse"].values()), default=0.0) for one in content["joints"][joint]["recordings"]]
    return largest.index(max(largest)), names.index(joint)


def _basis(content: dict[str, Any]) -> str:
    return f" On {', '.join(content['data'])}, which are not the run's own recordings." if content["data"] else ""


def _places(content: dict[str, Any]) -> Markup:
    """The worst places, one sentence each; a click shows the joint's curves."""
    return html(
        '{% if places %}<ol class="places">{% for place in places %}<li><a href="#failure" '
        'data-joint="{{ place.joint }}">{{ place.sentence }}</a></li>{% endfor %}</ol>{% endif %}',
        places=content["worst_places"],
    )


def _by_joint(content: dict[str, Any]) -> Markup:
    parts = [part for part in ("train", "validation") if part in content["rmse"]]
    joints = content["joints"]
    types = [own for joint in joints.values() for own in types_of(joint)]
    factor, unit = position_unit([joint["rmse"].get(part) for joint in joints.values() for part in parts], ["hinge"])
    rows = []
    for (name, joint), own in zip(joints.items(), types, strict=True):
        share = 100 * joint["share_above_floor"]
        label = joint_label(name, own, types, unit)
        rows.append(
            [
                html('<a href="#failure" data-joint="{{ name }}"><b>{{ label }}</b></a>', name=name, label=label),
                *(three_figures(factor * joint["rmse"][part]) for part in parts),
                three_figures(factor * joint["noise_floor"]),
                html(
                    '<span class="share"><div><i style="width:{{ share }}%"></i></div>{{ share }} %</span>',
                    share=f"{share:.0f}",
                ),
                joint["sentence"].removeprefix(f"{name}: ").removeprefix(f"{name} "),
            ]
        )
    unit, words = units_for(unit, types), {"train": "training", "validation": "validation"}
    head = ["joint", *(f"{words[part]} [{unit}]" for part in parts), f"noise [{unit}]", "error² above noise", "where"]
    return table(head, rows, "by-joint")
