"""Command lines, run in this process: starting another one takes seconds."""

import contextlib
import io
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT


def run_script(name: str, *arguments, cwd: Path | None = None) -> subprocess.CompletedProcess:
    """What ``scripts/<name>.py`` prints, and its exit code; in the present folder, or another."""
    words = [f"scripts/{name}.py", *map(str, arguments)]
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.chdir(cwd or Path.cwd())
        patch.setattr(sys, "argv", words)
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(ROOT / words[0]), run_name="__main__")
    return subprocess.CompletedProcess(words, int(ended.value.code or 0), out.getvalue(), err.getvalue())
