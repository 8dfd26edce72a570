"""Options that several commands share, each written once."""

from __future__ import annotations

import argparse

_TASK = "registered environment, module:Name, or FILE.py:Name"


def add_common_options(parser: argparse.ArgumentParser, *, run: bool = False, required: bool = False) -> None:
    """Options of every command that has to do with a robot.

    Args:
        parser: The command's parser.
        run: Whether the command works on runs, which know their robot.
        required: Whether there is no way without ``--task``.
    """
    default = "default: the run's own" if run else "pace list-envs lists them"
    parser.add_argument("--task", required=required, help=f"{_TASK} ({default})")
