"""What MuJoCo warns of: unasked, it would print it and write it to MUJOCO_LOG.TXT in the user's present folder."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import mujoco


def keep_quiet() -> None:
    """Let warnings go nowhere, unless the program that uses this one has said where: states and errors say it all."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_ignore)


@contextlib.contextmanager
def collected() -> Iterator[list[str]]:
    """The warnings of a block; afterwards they go where they went before."""
    before, said = mujoco.get_mju_user_warning(), list[str]()
    mujoco.set_mju_user_warning(said.append)
    try:
        yield said
    finally:
        mujoco.set_mju_user_warning(before or _ignore)


def _ignore(message: str) -> None:
    """Nothing."""
