"""The tutorials work when typed: their blocks of bash and Python run, in order, in one shell."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pace_actuators.effects.__main__ import page as page_of_effects

ROOT = Path(__file__).parents[1]
FENCE = re.compile(r"^```(bash|python)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\((?!https?:|mailto:)([^)#\s]*)(#[^)\s]*)?\)")
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "benchmarks").glob("*.md")])


def blocks(page: Path, language: str | None = None) -> list[tuple[str, str]]:
    found = FENCE.findall(page.read_text(encoding="utf-8"))
    return [(kind, text) for kind, text in found if language in (None, kind)]


def type_in(page: Path, home: Path, start: Path) -> str:
    """Run all blocks of a page in one shell, as a reader who starts in the checkout would."""
    script = ["set -eo pipefail"]
    for i, (kind, text) in enumerate(blocks(page)):
        if any(not (ROOT / path).exists() for path in re.findall(r"scripts/\w+\.py", text)):
            continue  # not there yet
        script.append(f"echo '>>> block {i}'")
        if kind == "bash":
            script.append(text)
        else:
            (home / f"block_{i}.py").write_text(text, encoding="utf-8")
            script.append(f"python - < {home / f'block_{i}.py'}")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    run = subprocess.run(
        ["bash", "-c", "\n".join(script)],
        cwd=start,
        env={**os.environ, "HOME": str(home), "PATH": path, "PYTHONUTF8": "1"},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert run.returncode == 0, f"{page.name}:\n{run.stdout[-3000:]}\n{run.stderr[-3000:]}"
    return run.stdout


@pytest.mark.slow
def test_the_tutorial_for_an_own_robot_works_when_typed(tmp_path):
    printed = type_in(ROOT / "docs" / "your_own_robot.md", tmp_path, ROOT)
    assert "replay: " in printed
    assert list(tmp_path.glob("my_arm/logs/pace/my_arm/*/result.json"))


@pytest.mark.slow
def test_the_tutorial_for_an_own_objective_works_when_typed(tmp_path):
    type_in(ROOT / "docs" / "your_own_objective.md", tmp_path, ROOT)


@pytest.mark.slow
def test_the_tutorial_for_an_own_effect_works_when_typed(tmp_path):
    printed = type_in(ROOT / "docs" / "your_own_effect.md", tmp_path, ROOT)
    assert "mrad without the cable" in printed


def test_the_page_of_effects_is_that_of_the_registry():
    assert (ROOT / "docs" / "effects.md").read_text(encoding="utf-8") == page_of_effects(), (
        "Write it anew: python -m pace_actuators.effects > docs/effects.md"
    )


SHOWN = [ROOT / "README.md", ROOT / "docs" / "training.md"]
"""Pages whose code runs and whose commands exist; they take too long to be typed."""


@pytest.mark.parametrize("page", SHOWN, ids=lambda page: page.name)
def test_the_code_runs(page, tmp_path):
    for i, (_, text) in enumerate(blocks(page, "python")):
        run = subprocess.run(
            [sys.executable, "-"], input=text, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
        )
        assert run.returncode == 0, f"block {i}:\n{run.stderr}"


@pytest.mark.parametrize("page", SHOWN, ids=lambda page: page.name)
def test_the_commands_exist_with_these_options(page):
    scripts = [line for _, text in blocks(page, "bash") for line in text.splitlines() if "scripts/" in line]
    assert scripts
    for line in scripts:
        words = line.split("#")[0].split()
        script = next(word for word in words if word.startswith("scripts/"))
        shown = subprocess.run(
            [sys.executable, ROOT / script, "--help"], capture_output=True, text=True, timeout=60, check=True
        )
        for option in (word for word in words if word.startswith("--")):
            assert option in shown.stdout, f"{script} has no {option}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        linked = (page.parent / target).resolve() if target else page
        assert linked.exists(), f"{page.name} links to {target}"
        if anchor and linked.suffix == ".md":
            headings = re.findall(r"^#+ (.*)$", linked.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor[1:] in slugs, f"{page.name} links to {target}{anchor}; {linked.name} has {sorted(slugs)}"
