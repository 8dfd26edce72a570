"""Where the models and sample recordings lie: in the installed package, or beside the code in a checkout."""

from pathlib import Path

try:
    from pace_assets import ASSETS_DIR
except ModuleNotFoundError:  # a checkout on the path that was not installed
    ASSETS_DIR = Path(__file__).parents[1] / "assets"

__all__ = ["ASSETS_DIR"]
