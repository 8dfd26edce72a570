"""The documentation builds as a site: no broken link, no missing reference, nothing loaded from elsewhere."""

import os
import re
import subprocess
import sys

import pytest
from effect_page import effect_page
from places import ROOT

from pace_actuators.effects import available_effects, get_effect
from pace_optim.data_collection.plant import EFFECTS

LOADED = re.compile(r"<(?:script|img|iframe|link)\b[^>]*?\b(?:src|href)=[\"']?(https?:)?//[^\s\"'>]+")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("mkdocs", reason="mkdocs is not installed: pip install 'pace-mujoco[dev]'")
    folder = tmp_path_factory.mktemp("site")
    run = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-3000:]
    return folder


@pytest.mark.slow
def test_the_site_builds_strictly_and_loads_nothing_from_elsewhere(site):
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        text = page.read_text("utf-8")
        found = [match.group(0) for match in LOADED.finditer(text) if 'rel="canonical"' not in match.group(0)]
        assert not found, f"{page.relative_to(site)} loads {found[0]}"


@pytest.mark.slow
def test_the_site_has_a_page_for_each_effect_and_the_reference(site):
    for name in available_effects():
        if get_effect(name).__module__.startswith("pace_actuators."):
            assert name in (site / "effects" / f"{name}.html").read_text("utf-8")
    gallery = (site / "effects" / "index.html").read_text("utf-8")
    assert gallery.count("images/effects/") == len(drawn_effects())
    assert "|dq*/dt| &lt;= v_max" in (site / "effects.html").read_text("utf-8")  # no backslash of GitHub's tables
    reference = (site / "reference.html").read_text("utf-8")
    for name in ("PaceDCMotor", "ManagerBasedRLEnv", "Recording", "load_problem"):
        assert f">{name}<" in reference or f"{name}</" in reference, f"the reference has no {name}"


def test_an_effect_s_page_says_what_it_is():
    page = effect_page(get_effect("stribeck_friction"), "../images/effects/stribeck_friction.png")
    for words in ("# stribeck_friction", "F_s exp", "rad/s", "--effects stribeck_friction", "stribeck_friction.png"):
        assert words in page


def drawn_effects() -> list[str]:
    """Effects of a name and a law that the independent simulator can hide in a recording."""
    return [name for name in available_effects() if name in EFFECTS and not get_effect(name).free_form]


def test_every_effect_that_can_be_recorded_has_a_picture():
    """``python docs/site/effect_pictures.py`` draws those that are missing."""
    pictures = {path.stem for path in (ROOT / "docs" / "images" / "effects").glob("*.png")}
    assert len(drawn_effects()) > 25 and pictures == set(drawn_effects())
