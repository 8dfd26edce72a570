"""Which joint of the robot a log's name means: prefixes, slashes, case and words such as `joint` do not matter."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from .words import joint_words, words


def match(label: str, names: Sequence[str]) -> tuple[str, float] | None:
    """The joint that a label means and how surely (0 to 1); None where it means none, or more than one equally."""
    scored = sorted(((_likeness(label, name), name) for name in names), reverse=True)
    if not scored or scored[0][0] == 0.0 or (len(scored) > 1 and scored[0][0] == scored[1][0]):
        return None
    return scored[0][1], scored[0][0]


def _likeness(label: str, name: str) -> float:
    if label == name:
        return 1.0
    if label.casefold() == name.casefold() or words(label) == words(name):
        return 0.99
    one, other = joint_words(label), joint_words(name)
    if "".join(one) == "".join(other):
        return 0.95
    if set(other) <= set(one):
        return 0.9 - 0.01 * len(set(one) - set(other))
    if set(one) <= set(other) and not all(word.isdigit() for word in one):
        return 0.8 - 0.01 * len(set(other) - set(one))
    return 0.0


def only_numbers(labels: Iterable[str]) -> bool:
    """Whether labels identify joints by numbers alone."""
    return all(all(word.isdigit() for word in joint_words(label)) for label in labels)
