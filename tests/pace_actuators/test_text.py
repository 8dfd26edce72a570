"""How names, numbers and units are written."""

import pytest

from pace_actuators.text import conjoined, in_short, listed, plural


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


@pytest.mark.parametrize(
    ("names", "short", "pattern"),
    [
        (["lbr_iiwa_joint_1", "lbr_iiwa_joint_2"], ["1", "2"], "lbr_iiwa_joint_…"),
        (["arm_left_2_joint", "arm_left_wrist_joint"], ["2", "wrist"], "arm_left_…_joint"),
        (["hip_joint", "knee_joint"], ["hip_joint", "knee_joint"], ""),  # little is shared
        (["robot_arm", "robot_arm_2"], ["robot_arm", "robot_arm_2"], ""),  # nothing would be left of the first
        (["LF_HAA", "LF_HFE"], ["LF_HAA", "LF_HFE"], ""),
        (["only_one_long_name"], ["only_one_long_name"], ""),
    ],
)
def test_names_of_a_table_leave_out_what_all_share(names, short, pattern):
    assert in_short(names) == (short, pattern)
    if pattern:
        assert [pattern.replace("…", each) for each in short] == names
