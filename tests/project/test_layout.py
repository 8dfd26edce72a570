"""Tests follow the tree."""

from collections import Counter

from places import ROOT

TESTS = ROOT / "tests"
ELSEWHERE = {"project"}
"""Folders of tests of no folder: the checkout as a whole."""


def test_each_folder_of_tests_is_that_of_what_it_tests():
    folders = {path.parent.relative_to(TESTS).as_posix() for path in TESTS.rglob("test_*.py")}
    assert {folder for folder in folders - ELSEWHERE if folder == "." or not (ROOT / folder).is_dir()} == set()


def test_each_file_of_tests_is_found_by_its_name():
    """And no other file takes its place where it is imported: the folders of ``pythonpath`` in pyproject.toml."""
    names = Counter(path.name for path in TESTS.rglob("*.py"))
    names.update(path.name for folder in ("benchmarks", "docs/site") for path in (ROOT / folder).glob("*.py"))
    assert [name for name, count in names.items() if count > 1] == []
