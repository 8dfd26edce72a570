"""Coulomb friction that turns within a step, where the speed passes zero.

MuJoCo's friction acts against the speed at the end of a step: where a joint turns back, it turns a part of the step too
early. That makes an error of the first order in the step, always to the same side. With v and v₊ the speed before and
after MuJoCo's step of length h, f the friction in it, and 1/w the inertia that the joint feels (``dof_invweight0``),

    p = v₊ - v - h w f        what all else pushes
    v₊' = turned(v, p, h w F)
    Δ = M⁻¹ (v₊' - v₊) / w    the impulse by which the frictions differ, passed on to all joints

A free step has no more constraints than frictions. Where a contact, a limit or an equality acts, nothing is changed.
"""

from __future__ import annotations

import torch

NOTABLE = 1e-6
"""Of what friction can take from a speed in a step: a smaller change of it is rounding."""

SOURCE = f"""
static double turned(double speed, double pushed, double stop) {{
  const double onward = speed + pushed - copysign(stop, speed);
  if (onward * speed > 0.0) return onward;
  const double from_rest = pushed - fmin(fmax(pushed, -stop), stop), passed = onward - speed;
  return (passed == 0.0 ? 1.0 : onward / passed) * from_rest;
}}
typedef void (*Solve)(const mjModel*, mjData*, mjtNum*, const mjtNum*, int);
typedef void (*Drift)(const mjModel*, mjtNum*, const mjtNum*, mjtNum);
static void turn_friction(const mjModel* m, mjData* d, const double* before, double* room, Solve solve, Drift drift) {{
  const int n = m->nv;
  const double h = m->opt.timestep;
  double *impulse = room, *change = room + n;
  int rows = 0, notable = 0;
  for (int i = 0; i < n; ++i) {{
    const double most = m->dof_frictionloss[i], w = m->dof_invweight0[i], stop = h * w * most;
    impulse[i] = 0.0;
    if (most <= 0.0) continue;
    ++rows;
    if (w <= 0.0) continue;
    const double pushed = d->qvel[i] - before[i] - h * w * d->qfrc_constraint[i];
    const double step = turned(before[i], pushed, stop) - d->qvel[i];
    if (fabs(step) <= {NOTABLE} * stop) continue;
    impulse[i] = step / w;
    notable = 1;
  }}
  if (!notable || d->nf != rows || d->nefc != rows) return;
  solve(m, d, change, impulse, 1);
  for (int i = 0; i < n; ++i) d->qvel[i] += change[i];
  drift(m, d->qpos, change, h);
}}
"""
"""The same in C, after MuJoCo's step: ``before`` are the speeds before it, ``room`` has 2 nv numbers."""


def turned(speed: torch.Tensor, pushed: torch.Tensor, stop: torch.Tensor) -> torch.Tensor:
    """Speed after a step under a constant push and Coulomb friction, which turns where the speed passes zero.

    Args:
        speed: Before the step.
        pushed: What the push alone adds to it.
        stop: What friction alone can take from it.
    """
    onward = speed + pushed - torch.copysign(stop, speed)
    from_rest = pushed - torch.clamp(pushed, -stop, stop)
    left = (onward / (onward - speed)).nan_to_num_(nan=1.0)  # part of the step after the speed has passed zero
    return torch.where(onward * speed > 0, onward, left * from_rest)


def impulses(
    before: torch.Tensor,
    after: torch.Tensor,
    force: torch.Tensor,
    most: torch.Tensor,
    weight: torch.Tensor,
    step: float,
) -> torch.Tensor:
    """By what friction differs over a step, (num_envs, nv) [N m s]; zero where it does not.

    Args:
        before: Speeds before MuJoCo's step, (num_envs, nv).
        after: Speeds after it.
        force: Its friction.
        most: Coulomb friction F.
        weight: ``dof_invweight0``.
        step: h [s].
    """
    stop = step * weight * most
    change = turned(before, after - before - step * weight * force, stop) - after
    return torch.where(change.abs() > NOTABLE * stop, change / weight, 0.0) * (most > 0.0)
