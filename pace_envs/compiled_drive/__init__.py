"""Drives as compiled programs: the product's own drive, traced once (:mod:`pace_envs.compiler`), around a simulation.

- one joint over a recording, a thread for each joint (``one_joint``, ``joint_source``);
- a robot's drives around MuJoCo's step (``robot_source``, ``robot_kernel``).

Both write a drive's program by ``drive_code``.
"""
