"""What users import: the names of the three packages, one line each, and how a name goes."""

import importlib
import re
import subprocess
import sys
import warnings

import api
import pytest
from places import ROOT

from pace_actuators.public_names import _warned, deprecated, homes_of

ADAPTERS = ("pace_actuators.mjlab", "pace_actuators.isaaclab")
TAUGHT = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "docs").glob("*.ipynb")])
IMPORT = re.compile(r"^\s*\"?(?:from (pace_[\w.]+) import|import (pace_[\w.]+))", re.MULTILINE)


def test_each_public_name_has_one_line_in_the_docs():
    assert (ROOT / "docs" / "api.md").read_text(encoding="utf-8") == api.page(), (
        "run: python docs/site/api.py > docs/api.md"
    )


@pytest.mark.parametrize("package", api.PACKAGES)
def test_each_public_name_is_there_and_documented(package):
    lines = api.lines_of(package)
    assert not [name for name, line in lines.items() if not line]
    homes = homes_of(ROOT / package / "__init__.py")
    assert set(homes) - set(lines) == set()


@pytest.mark.parametrize("page", [*TAUGHT, *(ROOT / "docs" / "examples").glob("*.py")], ids=lambda p: p.name)
def test_the_docs_import_from_the_packages_alone(page):
    found = {one or other for one, other in IMPORT.findall(page.read_text(encoding="utf-8"))}
    assert found <= {*api.PACKAGES, *ADAPTERS}


@pytest.mark.slow
def test_importing_what_is_public_loads_torch_only_when_it_is_used():
    code = "import pace_optim, sys; assert 'torch' not in sys.modules; pace_optim.fit; sys.modules['torch']"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_an_unknown_name_says_what_was_meant():
    import pace_optim

    with pytest.raises(AttributeError, match=r"no attribute 'CMAESOptimiser'; did you mean CMAESOptimizer\?"):
        pace_optim.CMAESOptimiser  # noqa: B018
    assert not hasattr(pace_optim, "__wrapped__")


def test_a_renamed_name_works_and_warns_once(tmp_path, monkeypatch):
    (tmp_path / "old_house").mkdir()
    (tmp_path / "old_house" / "__init__.py").write_text(
        "from typing import TYPE_CHECKING\n"
        "from pace_actuators.public_names import public_names\n"
        "if TYPE_CHECKING:\n    from math import sqrt\n"
        "__all__ = ['sqrt']\n"
        "__getattr__ = public_names(__file__, renamed={'root': ('sqrt', '0.5')})\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    house = importlib.import_module("old_house")
    with pytest.warns(DeprecationWarning, match=r"old_house\.root is deprecated .* in 0\.5: write old_house\.sqrt"):
        assert house.root(4) == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert house.root(9) == 3


def test_a_deprecation_names_the_line_of_the_user():
    _warned.discard("old")
    with pytest.warns(DeprecationWarning, match=r"old is deprecated and will be removed in 0\.4: write new") as found:
        deprecated("old", "new", "0.4", stacklevel=1)
    assert found[0].filename == __file__


def test_no_public_name_shares_its_name_with_a_module():
    for package in api.PACKAGES:
        homes = homes_of(ROOT / package / "__init__.py")
        modules = {path.stem for path in (ROOT / package).iterdir()}
        assert {name for name in modules & set(homes) if homes[name] != package} == set()
