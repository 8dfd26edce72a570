"""Motions that make a robot's parameters visible: signals, and the joint commands made from them.

>>> trajectories = make_excitation("chirp", cfg.sim2real, control_dt=0.0025)
>>> trajectories[0].time, trajectories[0].des_dof_pos

A new excitation is one small file in this folder (or anywhere else that is imported):

    @register_excitation("sine", "one slow sine", duration=10.0)
    def sine(motion: Motion) -> list[Trajectory]:
        return [motion.trajectory("sine", np.sin(2 * np.pi * 0.2 * motion.time))]
"""

from importlib import import_module
from pkgutil import iter_modules

from .registry import Excitation, excitation_named, excitations, make_excitation, register_excitation
from .trajectory import Motion, Trajectory, write_command_csv

__all__ = [
    "Excitation",
    "Motion",
    "Trajectory",
    "excitation_named",
    "excitations",
    "make_excitation",
    "register_excitation",
    "write_command_csv",
]

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")  # each file registers its excitation
