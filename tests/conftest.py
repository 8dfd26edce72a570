"""What holds for all tests: nothing is remembered of the code that they name."""

import atexit
import os
import shutil
import tempfile

if "PACE_TEST_STATE" not in os.environ:  # processes that tests start share it
    os.environ["PACE_TEST_STATE"] = os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="pace-state-")
    atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)
