"""How names, numbers and units are written where people read them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from itertools import takewhile
from typing import Any

from pace_actuators.joint_units import JointType, units_for

_POSITIONS = ((1e-4, 1e3, "mrad"), (1e-7, 1e6, "µrad"), (0.0, 1e9, "nrad"))
_MOST_DECIMALS = 6
SHOWN = 3
"""Sentences of a kind that are shown in full; the others are folded."""
_MARKS = "_/-. :"
"""At which a name may be cut."""
_SHARED = 8
"""Letters that names must share to be shortened."""
_CODE = re.compile(r"\[(W\d+)\]")


def listed(names: Iterable[object], most: int = 40) -> str:
    """Names of a message: "a, b, c"; more than ``most`` are counted: "a, b, c and 2 more"."""
    texts = [str(name) for name in names]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more or "none"


def in_short(names: Sequence[str]) -> tuple[list[str], str]:
    """Names of a table without a long beginning and end that all share, and what was left out: "arm_left_…_joint".

    Returns:
        The names, and the pattern; "" if they share less than eight letters.
    """
    if len(names) < 2:
        return list(names), ""
    first = _beginning(names)
    begin = first[: max(first.rfind(mark) for mark in _MARKS) + 1]
    rests = [name[len(begin) :] for name in names]
    last = _beginning([rest[::-1] for rest in rests])[::-1]
    end = last[min((last.find(mark) for mark in _MARKS if mark in last), default=len(last)) :]
    short = [rest[: len(rest) - len(end)] for rest in rests]
    if len(begin) + len(end) < _SHARED or not all(short):
        return list(names), ""
    return short, f"{begin}…{end}"


def _beginning(names: Sequence[str]) -> str:
    """The letters with which all names begin."""
    return "".join(letters[0] for letters in takewhile(lambda each: len(set(each)) == 1, zip(*names, strict=False)))


def aligned(columns: Sequence[Sequence[str]]) -> list[str]:
    """The rows of a table on a terminal: the first column to the left, the others to the right."""
    width = [max(map(len, column)) for column in columns]
    rows = zip(*columns, strict=True)
    return [
        "  ".join([row[0].ljust(width[0]), *(cell.rjust(w) for cell, w in zip(row[1:], width[1:], strict=True))])
        for row in rows
    ]


def with_table(text: str) -> list[str]:
    """The lines of a message with a table below it; a line break in a name stays one, as no table line begins there."""
    return re.split(r"\n(?=  )", text)


def conjoined(names: Iterable[object]) -> str:
    """Names in a sentence: "a, b and c"."""
    *first, last = [str(name) for name in names]
    return f"{', '.join(first)} and {last}" if first else last


def shortened(sentences: Sequence[str], kind: str) -> list[str]:
    """The first three sentences, then one line with the number of the others and their codes.

    Args:
        sentences: The most important first.
        kind: What one of them is: "warning".
    """
    shown, rest = list(sentences[:SHOWN]), sentences[SHOWN:]
    if not rest:
        return shown
    codes = dict.fromkeys(code for sentence in rest for code in _CODE.findall(sentence))
    which = f" ({', '.join(codes)})" if codes else ""
    return [*shown, f"{plural(len(rest), f'more {kind}')}{which} in report.html"]


def percent(share: float) -> str:
    """A share as "61 %", "99.7 %" or "0.4 %": what is not all is never 100 %, and what is something is never 0 %."""
    whole = 100 * share
    if 0 < abs(whole) < 0.1:
        return "below 0.1 %"
    if 99.95 <= whole < 100:
        return "over 99.9 %"
    return f"{whole:.1f} %" if 99.5 <= whole < 100 else f"{whole:.0f} %" if abs(whole) >= 0.5 else f"{whole:.1g} %"


def plural(count: int, noun: str) -> str:
    """A count of things: "1 joint", "3 joints"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def capitalised(text: str) -> str:
    """A text that begins with a capital, the rest as it is."""
    return text[:1].upper() + text[1:]


def spoken(name: str) -> str:
    """A parameter's name in a sentence: ``payload.mass`` becomes "payload mass", ``torque_gain.gain`` "torque gain"."""
    effect, _, parameter = name.replace("_", " ").partition(".")
    return f"{effect} {parameter}".strip() if effect.split()[-1:] != [parameter] else effect


def in_words(name: str) -> str:
    """A parameter's name as a heading: ``viscous_friction`` becomes "Viscous friction"."""
    return capitalised(spoken(name))


def pretty_unit(unit: str) -> str:
    """``kg m^2`` becomes "kg m²"."""
    return unit.replace("^2", "²").replace("^3", "³")


def three_figures(value: float) -> str:
    """A number of a table, as 0.120, 12.0 or 120."""
    return f"{value:#.3g}".rstrip(".")


def value_and_error(value: float, std: float | None) -> tuple[str, str]:
    """A value to the digits that its standard deviation leaves, and the standard deviation to two digits."""
    if std is None or std <= 0:
        return f"{value:.4g}", "–"
    decimals = 1 - math.floor(math.log10(std))
    if decimals > _MOST_DECIMALS:
        return f"{value:.{_MOST_DECIMALS}g}", f"{std:.1e}"
    decimals = max(0, decimals)
    return f"{value:.{decimals}f}", f"{std:.{decimals}f}"


def position_unit(values: Iterable[float | None], joint_types: Iterable[JointType]) -> tuple[float, str]:
    """A factor and a unit in which the largest of some positions reads well; mrad or mm unless all are tiny.

    Args:
        values: Positions or errors of them [rad], of slides [m].
        joint_types: Of the joints that they belong to.
    """
    largest = max((abs(value) for value in values if value is not None and math.isfinite(value)), default=1.0)
    factor, unit = next((factor, unit) for least, factor, unit in _POSITIONS if largest >= least)
    return factor, units_for(unit, joint_types)


def position_text(value: float | None, joint_types: Iterable[JointType]) -> str:
    """A position [rad, of slides m] in words: "6.8 mrad", of joints of both types "6.8 mrad or mm"."""
    if value is None:
        return "–"
    factor, unit = position_unit([value], joint_types)
    return f"{factor * value:.3g} {unit}"


def size_text(size: dict[str, Any]) -> str:
    """A value of ``diagnosis.json`` with its error bar and unit, or as a factor of what was stated."""
    factor, std = size["factor"], size["std"]
    value = size["value"] if factor is None else factor
    text = f"{value:.4g}" if std is None else f"{value:.4g} ± {std:.1g}"
    if factor is not None:
        text += " times what was stated"
    elif size["unit"] != "1":
        text += f" {size['unit']}"
    return text + (", at its bound" if size["at_bound"] else "")


def sizes_by_joints(sizes: Sequence[dict[str, Any]]) -> dict[tuple[str, str, str], list[str]]:
    """Effect, parameter and value of ``diagnosis.json``'s sizes, with the joints that have this value."""
    found: dict[tuple[str, str, str], list[str]] = {}
    for size in sizes:
        found.setdefault((size["effect"], size["parameter"], size_text(size)), []).append(size["joint"])
    return found


def count_in_short(count: float) -> str:
    """A count with a suffix: "3.49 M"."""
    for size, suffix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if count >= size:
            return f"{count / size:.3g} {suffix}"
    return f"{count:.0f}"


def short_duration(seconds: float | None) -> str:
    """A time of milliseconds to seconds in words: "20 ms", "1.17 s"."""
    seconds = seconds or 0.0
    return f"{1e3 * seconds:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"


def duration(seconds: float) -> str:
    """A time in words: "2 h 15 min", "3 min 20 s", "8.8 s"."""
    if seconds < 60:
        return f"{seconds:.3g} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
