"""How names, numbers and units are written."""

import pytest

from pace_actuators.text import conjoined, listed, plural


@pytest.mark.parametrize(
    ("names", "most", "text"),
    [
        ([], 40, "none"),
        (["a"], 40, "a"),
        (["a", "b"], 40, "a, b"),
        (("a", "b", "c"), 3, "a, b, c"),
        ((str(i) for i in range(5)), 3, "0, 1, 2 and 2 more"),
    ],
)
def test_names_are_listed_and_the_rest_counted(names, most, text):
    assert listed(names, most) == text


def test_names_are_conjoined_as_in_a_sentence():
    assert [conjoined("abc"[:n]) for n in (1, 2, 3)] == ["a", "a and b", "a, b and c"]


def test_one_thing_is_singular():
    assert plural(1, "joint") == "1 joint" and plural(0, "joint") == "0 joints"
