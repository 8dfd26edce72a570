"""Writing files whole or not at all: :mod:`pace_actuators.files` does it."""

from pace_actuators.files import write_atomically, write_json, write_tensors

__all__ = ["write_atomically", "write_json", "write_tensors"]
