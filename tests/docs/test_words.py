"""Pages, messages and docstrings read once: short sentences, none of the old habits, codes with a cure.

A failure names the sentence or phrase and what to write. The limits are those that the texts reach; lower them when the
texts get better. ``PYTHONPATH=tests/support python tests/docs/test_words.py`` prints the counts.
"""

import ast
import inspect
import random
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from places import ROOT

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "benchmarks").glob("*.md")])
PACKAGES = ("pace_actuators", "pace_envs", "pace_optim")
MEAN, LONG, LONG_SHARE = 16.0, 30, 0.05
"""Words per sentence on average; words of a long sentence; share of long sentences."""
DOCSTRING_MEAN, DOCSTRING_LONG_SHARE = 13.0, 0.03
"""The same of the docstrings of a room."""
CHANGELOG_WORDS = 25
"""Words of a changelog entry, at most."""
HABITS = {
    r"(?<![.])\b(?:told|tells?|telling)\b(?!\()": "'the file states', 'the fit finds', 'separate', 'print'",
    r"\bof (?:one's|its|your|their|our|his|my) own\b": "'your', 'custom', 'separate'",
    r"\b(?:whoever|whichever|nobody|somebody|anybody)\b": "make 'you', 'the fit' or 'the file' the subject",
    r"\bwhat of\b": "name the part",
    r"\b(?:is|are) none\b": "say what is true in its place",
    r"\b(?:is|are) said\b": "'the message states'",
    r"\bin place of what\b": "'instead of'",
}
_FENCE = re.compile(r"^ *```.*?^ *```\s*$", re.DOTALL | re.MULTILINE)
_CODE = re.compile(r"`[^`]+`")
_DOCSTRING = re.compile(r"^ *r?\"\"\"(.*?)\"\"\"", re.DOTALL | re.MULTILINE)
_COMMENT = re.compile(r"(?:^ *|  )# (?!noqa|type:|fmt:)(.+)$", re.MULTILINE)
_NAME_IN_CODE = re.compile(r"``.+?``|:\w+:`[^`]+`|`[^`]+`", re.DOTALL)
_SECTION = re.compile(r"(?:Args|Returns|Raises|Attributes|Yields):")
_ARGUMENT = re.compile(r"    (?=\S)[^:]*: ")
_LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
_ITEM = re.compile(r"(?:[-*]|\d+\.)\s+")
_END = re.compile(r"(?<=[.!?])[\"')*]*\s+(?=[A-Z*\"'(“\[−\d])|(?<=:)\s+(?=[A-Z][a-z])")


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def text_of(path: Path) -> str:
    """A page without its code."""
    return _CODE.sub("CODE", _FENCE.sub("\n\n", path.read_text(encoding="utf-8")))


def sentences(text: str) -> list[str]:
    """Sentences of paragraphs and list items; headings, tables, pictures and indented equations are none."""
    parts: list[str] = []
    begun = False
    for line in text.splitlines():
        words = line.strip()
        item = _ITEM.match(words)
        if not words or words.startswith(("|", "#", "![")) or (line.startswith("    ") and not begun and not item):
            begun = False
        elif item or not begun:
            parts.append(words[item.end() :] if item else words)
            begun = True
        else:
            parts[-1] += f" {words}"
    plain = [_LINK.sub(r"\1", part).replace("**", "") for part in parts]
    return [each for part in plain for each in _END.split(part) if words_of(each) > 1]


def prose_of(docstring: str) -> str:
    """A docstring without its code; each argument is a list item."""
    lines, in_section = [], False
    for line in _NAME_IN_CODE.sub("CODE", inspect.cleandoc(docstring)).splitlines():
        in_section = bool(_SECTION.fullmatch(line)) or (in_section and (not line or line.startswith(" ")))
        if not in_section:
            lines.append(line)
        elif not _SECTION.fullmatch(line):
            lines.append(_ARGUMENT.sub("- ", line, count=1).strip())
        else:
            lines.append("")
    return "\n".join(lines)


def words_of(sentence: str) -> int:
    return len(re.findall(r"\S*\w\S*", sentence))


def mean_and_long(found: list[str]) -> tuple[float, list[str]]:
    """Words per sentence, and the sentences over the limit, the longest first."""
    long = sorted((each for each in found if words_of(each) > LONG), key=words_of, reverse=True)
    return sum(map(words_of, found)) / max(len(found), 1), long


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_sentences_are_short(page):
    found = sentences(text_of(page))
    mean, long = mean_and_long(found)
    assert mean <= MEAN, f"{name_of(page)}: {mean:.1f} words a sentence, at most {MEAN:g}. Make two sentences of one."
    assert len(long) <= max(LONG_SHARE * len(found), 1), (
        f"{name_of(page)}: {len(long)} of {len(found)} sentences have more than {LONG} words. Cut the first of them in "
        f"two: {long[0]}"
    )


def habits(text: str) -> list[str]:
    """What is written in a way that is read twice, with what to write."""
    lowered = re.sub(r"\s+", " ", text)
    return [
        f"'{found.group()}' in '…{lowered[max(0, found.start() - 30) : found.end() + 30]}…': write {cure}"
        for habit, cure in HABITS.items()
        for found in re.finditer(habit, lowered, re.IGNORECASE)
    ]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_pages_have_none_of_the_habits(page):
    found = habits(text_of(page))
    assert not found, f"{name_of(page)}: " + "; ".join(found[:5])


def test_a_changelog_entry_is_one_line():
    entries = re.findall(r"^- (.*(?:\n  .*)*)$", text_of(ROOT / "CHANGELOG.md"), re.MULTILINE)
    assert entries
    for entry in entries:
        count = words_of(entry)
        assert count <= CHANGELOG_WORDS, f"{count} words, at most {CHANGELOG_WORDS}; details go to the commit: {entry}"


def literals(tree: ast.AST) -> Iterator[str]:
    """Strings of several words that are no docstrings: messages, help, report."""
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        text = getattr(node, "value", None) if isinstance(node, ast.Constant) and id(node) not in docstrings else None
        if isinstance(text, str) and " " in text.strip():
            yield text


@cache
def modules() -> dict[Path, str]:
    return {path: path.read_text("utf-8") for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py"))}


@pytest.mark.slow
def test_messages_have_none_of_the_habits():
    words = re.compile(r"\"[^\"\n]*(?:" + "|".join(HABITS) + ")", re.IGNORECASE)
    found = [
        f"{name_of(path)}: {each}"
        for path, source in modules().items()
        if words.search(_DOCSTRING.sub("", source))  # parsing is slow
        for text in literals(ast.parse(source))
        for each in habits(text)
    ]
    assert not found, "\n".join(found)


def test_each_code_of_a_warning_has_a_section_with_its_cure():
    used = {code for source in modules().values() for code in re.findall(r"\[(W\d+)\]", source)}
    page = (ROOT / "docs" / "faq.md").read_text("utf-8")
    sections = dict(re.findall(r"^### (W\d+): .*\n((?:(?!^#).*\n)*)", page, re.MULTILINE))
    assert used == set(sections), (
        f"without a section: {used - set(sections)}; without a warning: {set(sections) - used}"
    )
    for code, text in sections.items():
        assert "**Meaning.**" in text and "**Cure.**" in text, f"{code} needs a meaning and a cure"


@cache
def docstrings(path: Path) -> list[str]:
    """Docstrings of modules, classes, functions and fields, without their code."""
    return [prose_of(text) for text in _DOCSTRING.findall(modules()[path])]


def rooms() -> dict[str, list[Path]]:
    """Modules by package and first folder."""
    found: dict[str, list[Path]] = {}
    for path in modules():
        found.setdefault("/".join(path.relative_to(ROOT).parent.parts[:2]), []).append(path)
    return found


def test_docstrings_and_comments_have_none_of_the_habits():
    found = [
        f"{name_of(path)}: {each}"
        for path, source in modules().items()
        for text in [*docstrings(path), *(_NAME_IN_CODE.sub("CODE", each) for each in _COMMENT.findall(source))]
        for each in habits(text)
    ]
    assert not found, "\n".join(found)


def test_sentences_of_docstrings_are_short():
    for room, paths in rooms().items():
        found = [each for path in paths for text in docstrings(path) for each in sentences(text)]
        mean, long = mean_and_long(found)
        assert mean <= DOCSTRING_MEAN, f"{room}: {mean:.1f} words a sentence, at most {DOCSTRING_MEAN:g}"
        assert len(long) <= max(DOCSTRING_LONG_SHARE * len(found), 1), (
            f"{room}: {len(long)} of {len(found)} sentences have more than {LONG} words. Cut this one in two: {long[0]}"
        )


def main() -> None:
    """Print words per sentence, the share of long sentences and the habits of everything that is read."""
    chosen = random.Random(11).sample(sorted(modules()), 20)
    texts = {name_of(page): [text_of(page)] for page in PAGES}
    texts["messages"] = [text for source in modules().values() for text in literals(ast.parse(source))]
    texts["docstrings of 20 modules"] = [text for path in chosen for text in docstrings(path)]
    texts |= {
        f"docstrings of {room}": [t for path in paths for t in docstrings(path)] for room, paths in rooms().items()
    }
    print(f"{'':40s} sentences  words  over {LONG}  habits")
    for name, parts in texts.items():
        found = [each for part in parts for each in sentences(part) if name != "messages" or words_of(each) > 3]
        mean, long = mean_and_long(found)
        share = 100 * len(long) / max(len(found), 1)
        print(f"{name:40s} {len(found):9d} {mean:6.1f} {share:6.1f} % {sum(len(habits(p)) for p in parts):7d}")


if __name__ == "__main__":
    main()
