"""A generator of bad input, a short run of it: no traceback, no hang, no execution, nothing half-written."""

import os
import re

import pytest
from places import SUPPORT

TRIALS = 60
"""They take some 25 s of a processor, a folder to damage and all imports included."""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="trials are forked processes")
def test_bad_input_of_every_kind_is_one_line(warm, tmp_path):
    words = ("--trials", str(TRIALS), "--seed", "11", "--quick")
    done = warm.run(SUPPORT / "bad_input.py", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert re.search(rf"^\| all \| {TRIALS} \|( 0 \|)+$", done.stdout, re.MULTILINE), done.stdout
