"""Where the models and sample recordings lie: in the installed package, or beside the code in a checkout."""

from pathlib import Path

try:
    from pace_assets import ASSETS_DIR as _ASSETS
except ModuleNotFoundError:  # a checkout on the path that was not installed
    _ASSETS = Path(__file__).parents[1] / "assets"

ASSETS_DIR = _ASSETS
"""Folder of the shipped robots: ``ASSETS_DIR / "go2" / "go2.xml"``."""
