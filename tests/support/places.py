"""Where things are."""

from pathlib import Path

SUPPORT = Path(__file__).parent
ROOT = SUPPORT.parents[1]
"""The checkout."""
SHARED = ROOT.parent / "shared"
"""Cases, robots and measurements beside it; tests that need them skip without."""
