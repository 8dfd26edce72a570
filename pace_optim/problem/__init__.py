"""One identification problem: parameters, environments, rollouts and their residuals.

Names mean the same here, in ``estimate`` and in ``joints``: ``x`` is a vector of normalised parameters, (size,), and
``physical`` one of physical parameters, or m of them. ``where`` says which samples count, (T, R) bool: T control steps,
K of them with samples, of R recordings. ``control_dt`` and ``dt`` are in seconds. ``say`` and ``progress`` show how far
something is. Of n single joints, ``x`` and ``physical`` are (n, P).
"""
