"""Options that several commands share, each written once."""

from __future__ import annotations

import argparse
import math
from typing import Any

_TASK = "registered environment, module:Name, FILE.py:Name, or a model file"


def number(text: str) -> float:
    """Type of options that hold a number.

    Raises:
        argparse.ArgumentTypeError: If it is not a number, or not finite.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return value


def add_several(parser: argparse._ActionsContainer, name: str, metavar: str, text: str, **more: Any) -> None:
    """An option that takes one value or more."""
    parser.add_argument(name, nargs="+", default=[], metavar=metavar, help=text, **more)


def add_device_option(parser: argparse.ArgumentParser, needs: str = "pace-mujoco[gpu]") -> None:
    """Where a command simulates, and what a GPU needs."""
    parser.add_argument(
        "--device", metavar="DEVICE", help=f"cpu (default), or a GPU: cuda:0, cuda:1, ...; needs {needs}"
    )


def add_paces_options(parser: argparse.ArgumentParser) -> None:
    """Options of PACE's data collection that change nothing here."""
    group = parser.add_argument_group("accepted for PACE's command lines")
    group.add_argument("--num_envs", type=int, default=1, metavar="N", help="one environment a trajectory is simulated")
    group.add_argument("--device", default="cpu", help="recordings are made on the processor")
    group.add_argument("--headless", action="store_true", help="nothing is shown")


def drop_paces_options(options: dict[str, Any]) -> None:
    """Leave out what :func:`add_paces_options` added."""
    for name in ("num_envs", "device", "headless"):
        del options[name]


def add_control_option(parser: argparse._ActionsContainer) -> None:
    """Of every command that makes a robot of a model file; runs keep it."""
    parser.add_argument(
        "--control_dt",
        type=number,
        metavar="S",
        help="of a model file: time between two commands (default: as logged, at most 0.0025)",
    )


def add_common_options(parser: argparse.ArgumentParser, *, run: bool = False, required: bool = False) -> None:
    """Options of every command that has to do with a robot.

    Args:
        run: Whether the command works on runs, which know their robot.
        required: Whether there is no way without ``--task``.
    """
    default = "default: the run's own" if run else "pace list-envs lists them"
    parser.add_argument("--task", required=required, help=f"{_TASK} ({default})")
    imports = "import these modules or files of yours first: code that a run names and has no record of"
    add_several(parser, "--import", "MODULE", imports, dest="imports")


def take_common_options(options: dict[str, Any]) -> dict[str, Any]:
    """Import what the user named by these options; returns them without those that have had their effect.

    ``effects``, if the command has it, may name code of the user's own too.
    """
    from pace_actuators.effects import import_effect
    from pace_actuators.own_code import import_named
    from pace_envs.task_source import use_task

    options = dict(options)
    for module in options.pop("imports"):
        try:
            import_named(module)
        except ValueError as error:
            raise ValueError(f"--import {module}: {error}") from None
    if options.get("task") is not None:
        options["task"] = use_task(options["task"])
    if options.get("effects"):
        options["effects"] = [import_effect(text) for text in options["effects"]]
    return options


def add_overwrite_option(parser: argparse._ActionsContainer) -> None:
    """Of every command that writes where the user says; ``refuse_taken`` checks it."""
    parser.add_argument("--overwrite", action="store_true", help="replace files that exist")


def add_rate_option(parser: argparse.ArgumentParser) -> None:
    """Of commands that read logs for the first time; a column map says it too ([time] rate)."""
    parser.add_argument("--rate", type=number, metavar="HZ", help="rows per second of logs that have no column of time")


def add_facts_option(parser: argparse._ActionsContainer) -> None:
    """Of commands that read logs for the first time."""
    parser.add_argument(
        "--facts",
        metavar="FILE",
        help="JSON file of gains, limits and loads for all logs; what a log's own JSON states is kept",
    )


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Options of every command that reads recordings."""
    parser.add_argument(
        "--columns",
        metavar="MAP",
        help="column map of logs (.toml: joints, units, signs, gear ratios); guessed and printed without it",
    )
    parser.add_argument(
        "--strict", action="store_true", help="refuse all recordings where one cannot be used (default: set it aside)"
    )
