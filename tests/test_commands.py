"""``pace VERB``: the commands of the scripts, from an installed package."""

import subprocess
import sys
from pathlib import Path

import pytest
from command_lines import run_script

from pace_optim import commands

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(path.stem for path in (ROOT / "scripts").glob("*.py"))


def pace(capfd, monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["pace", *words])
    try:
        status = commands.main()
    except SystemExit as end:
        status = end.code
    return int(status or 0), *capfd.readouterr()


def test_every_script_is_a_verb_and_every_verb_a_script():
    assert list(commands.verbs()) == SCRIPTS


def test_help_lists_the_verbs_with_what_they_do(capfd, monkeypatch):
    status, out, _ = pace(capfd, monkeypatch, "--help")
    assert status == 0
    for verb, what in commands.verbs().items():
        assert f"  {commands._SPELT.get(verb, verb).replace('_', '-')} " in out and what in out and what


def test_the_version_is_the_packages(capfd, monkeypatch):
    assert pace(capfd, monkeypatch, "--version")[1].startswith("pace-mujoco ")


@pytest.mark.parametrize("verb", ["list-envs", "list_envs"])
def test_a_verb_may_have_a_dash_or_an_underscore(verb, capfd, monkeypatch):
    status, out, _ = pace(capfd, monkeypatch, verb)
    assert (status, out) == (0, run_script("list_envs").stdout)


def test_a_misspelt_verb_is_one_line(capfd, monkeypatch):
    status, out, err = pace(capfd, monkeypatch, "diagnos")
    assert (status, out) == (2, "")
    assert err == "error: there is no command 'diagnos'; did you mean diagnose? See pace --help.\n"


def test_messages_name_the_command_as_it_was_called(capfd, monkeypatch):
    status, _, err = pace(capfd, monkeypatch, "fit")
    assert status == 2 and "pace list-envs" in err and "scripts/" not in err
    assert "example:\n  pace fit --task" in pace(capfd, monkeypatch, "fit", "--help")[1]
    assert "scripts/list_envs.py" in run_script("fit").stderr


def test_help_and_version_load_nothing_heavy():
    code = (
        "import sys; sys.argv = ['pace', '--help']\n"
        "from pace_optim.commands import main; main()\n"
        "sys.exit(str({'torch', 'mujoco', 'numpy'} & set(sys.modules)) if 'torch' in sys.modules else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
