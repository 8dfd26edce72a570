"""Robot models and sample recordings, one folder per robot; installed as `pace_assets`."""

from pathlib import Path

ASSETS_DIR = Path(__file__).parent
"""The folder that holds `<robot>/`, in a checkout and in an installed wheel alike."""
