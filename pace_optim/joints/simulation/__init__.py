"""Each joint simulated alone along the motion of the whole robot: a fast stand-in for small changes of the drives.

The rigid body of joint j, moved as in a reference simulation, is one inertia and one torque in time:

    M_j(t) q̈_j = τ_j - friction + f_j(t) + K_j(t) (q_j - q_j,ref(t))

M, f and K come from MuJoCo along the reference; the drive is the same ``PaceDCMotor``. What one joint's change does
to the motion of the others is left out: what the twins suggest is confirmed with the whole robot. Where joints have no
neighbours, the measured motion serves as the reference.
"""

from pace_optim.joints.simulation.path import ReferencePath, measured_path, reference_path
from pace_optim.joints.simulation.problem import twin_problem

__all__ = ["ReferencePath", "measured_path", "reference_path", "twin_problem"]
