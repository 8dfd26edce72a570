"""What the results of hidden_effects.py say."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Line = Mapping[str, Any]


def named(line: Line) -> list[str]:
    """What the diagnosis added, without the joints that it named."""
    return [effect.partition("@")[0] for effect in line.get("added", [])]


def declared(line: Line) -> set[str]:
    """What was added, and what the diagnosis says it cannot tell from that."""
    found = set(named(line))
    for entry in line.get("ranking", []):
        if entry["effect"].partition("@")[0] in found:
            found |= {other.partition("@")[0] for other in entry.get("confounded_with", [])}
    return found


def top_1(line: Line) -> bool:
    """Whether the true effects, and no others, were added; of one effect, whether it was added first."""
    found, truth = named(line), list(line["effects"])
    return found[:1] == truth if len(truth) == 1 else set(found) == set(truth)


def in_declared_set(line: Line) -> bool:
    """Whether every true effect was added, or is named as indistinguishable from what was or from a base parameter."""
    return set(line["effects"]) <= declared(line) | set(line.get("absorbed", []))


def expected(line: Line) -> bool:
    """Whether the verdict is the right one."""
    if line["group"] == "clean":
        return line["verdict"] == "nothing_missing"
    if line["group"] == "outside":
        return line["verdict"] == "unknown"
    return line["verdict"] == "effect" or set(line["effects"]) <= set(line.get("absorbed", []))


def make_table(lines: Sequence[Line]) -> str:
    """All tables, as text."""
    broken = [line for line in lines if "error" in line]
    done = [line for line in lines if "rmse" in line]  # not those that were left out by their ratio
    judged = [line for line in done if "verdict" in line]
    parts = [f"{len(lines)} cases, {len(broken)} with an error"]
    parts += [f"  {line['case']}: {line['error'][:150]}" for line in broken]
    groups = sorted({line["group"] for line in done})
    if judged:
        parts += ["", _summary(judged, groups), "", _confusion(judged), "", _false_alarms(judged)]
    if covered := _coverage(judged):
        parts += ["", covered]
    if besides := [line for line in judged if line.get("alone")]:
        parts += ["", _backgrounds(besides)]
    if done:
        parts += ["", _errors(done, groups), "", _times(done)]
    return "\n".join(parts)


def _summary(lines: Sequence[Line], groups: Sequence[str]) -> str:
    rows = [("group", "cases", "verdict right", "top 1", "in declared set", "missed", "unknown")]
    for group in groups:
        of = [line for line in lines if line["group"] == group]
        if not of:
            continue
        has_effect = group not in ("clean", "outside")
        rows.append(
            (
                group,
                str(len(of)),
                _share(expected(line) for line in of),
                _share(top_1(line) for line in of) if has_effect else "",
                _share(in_declared_set(line) for line in of) if has_effect else "",
                _share(line["verdict"] == "nothing_missing" for line in of),
                _share(line["verdict"] == "unknown" for line in of),
            )
        )
    return _aligned(rows)


def _confusion(lines: Sequence[Line]) -> str:
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for line in lines:
        truth = " + ".join(line["effects"]) or line["group"]
        truth = truth if line["group"] in ("effects", "clean", "outside", "pairs") else f"{truth} ({line['group']})"
        counts[truth][" + ".join(named(line)) or line["verdict"]] += 1
    rows = [("hidden", "named")]
    for truth in sorted(counts):
        rows.append((truth, ", ".join(f"{name} {count}" for name, count in counts[truth].most_common())))
    return _aligned(rows)


def _false_alarms(lines: Sequence[Line]) -> str:
    clean = [line for line in lines if line["group"] == "clean"]
    extra = [line for line in lines if line["effects"] and set(named(line)) - declared(line) - set(line["effects"])]
    more = [line for line in lines if line["group"] == "effects" and len(named(line)) > 1]
    wrong = [line for line in lines if line["group"] == "outside" and named(line)]
    return (
        f"false alarms: {sum(bool(named(line)) for line in clean)} of {len(clean)} clean cases, "
        f"{len(wrong)} outside cases given a name, {len(more)} single effects with a second one added, "
        f"{len(extra)} cases with an effect beside the declared set"
    )


def _coverage(lines: Sequence[Line]) -> str:
    """How often the error bars of single effects that were named hold the truth."""
    own = [size for line in lines if line["group"] == "effects" for size in line.get("sizes", [])]
    off = [abs(each["value"] - each["true"]) / each["std"] for each in own if each["true"] is not None and each["std"]]
    if not off:
        return ""
    return f"sizes of single effects: {_share(o < 2 for o in off)} within two error bars, median {np.median(off):.2g}"


def _backgrounds(lines: Sequence[Line]) -> str:
    """How large an effect must be beside many small ones to be named."""
    rows = [("error of the effect / of the background", "cases", "named first", "in declared set", "unknown")]
    for low, high in ((3.0, np.inf), (1.0, 3.0), (0.0, 1.0)):
        of = [line for line in lines if low <= _excess(line) < high]
        rows.append(
            (
                f"{low:g} or more" if np.isinf(high) else f"{low:g} to {high:g}",
                str(len(of)),
                _share(named(line)[:1] == line["effects"] for line in of),
                _share(in_declared_set(line) for line in of),
                _share(line["verdict"] == "unknown" for line in of),
            )
        )
    return _aligned(rows)


def _excess(line: Line) -> float:
    """How many times the background's error the effect's is."""
    return float(line["alone"]["effects"] / max(line["alone"]["background"], 1e-9))


def _errors(lines: Sequence[Line], groups: Sequence[str]) -> str:
    rows = [("validation RMSE [mrad], medians", "before", "after", "true effect known", "after / known", "size")]
    for group in groups:
        of = [line for line in lines if line["group"] == group]
        known = [line for line in of if line["rmse"]["truth"]]
        ratio = [line["rmse"]["after"] / line["rmse"]["truth"] for line in known]
        rows.append(
            (
                group,
                _median([line["rmse"]["before"] * 1e3 for line in of]),
                _median([line["rmse"]["after"] * 1e3 for line in of]),
                _median([line["rmse"]["truth"] * 1e3 for line in known]),
                _median(ratio),
                _median([line["size"] * 1e3 for line in of]),
            )
        )
    return _aligned(rows)


def _times(lines: Sequence[Line]) -> str:
    parts = ("recordings", "diagnosis", "true_fit")
    return "seconds a case, medians: " + ", ".join(
        f"{part} {_median([line['seconds'][part] for line in lines])}" for part in parts
    )


def _share(values: Any) -> str:
    values = list(values)
    return f"{sum(values)}/{len(values)}"


def _median(values: Sequence[float]) -> str:
    return f"{np.median(values):.3g}" if len(values) else "-"


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows)
