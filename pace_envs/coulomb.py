"""Coulomb friction that turns within a step, where the speed passes zero.

MuJoCo's friction acts against the speed at the end of a step: where a joint turns back, it turns a part of the step too
early. That makes an error of the first order in the step, always to the same side. With v and v₊ the speed before and
after MuJoCo's step of length h, f the friction in it, and w = (M⁻¹)ᵢᵢ,

    p = v₊ - v - h w f        what all else pushes
    v₊' = turned(v, p, h w F)
    v₊ += M⁻¹ eᵢ (v₊' - v₊) / w,  f += (v₊' - v₊) / (h w)

joint after joint until none changes: a joint that turns pushes those that stick, and their friction holds against it
(projected Gauss-Seidel; Stewart and Trinkle, Int. J. Numer. Methods Eng. 39, 1996, solve the same for a whole step).

Joints that stick creep a little in MuJoCo's step. Where none turns, one pass over all joints at once, with the w of the
model's posture (``dof_invweight0``), ends that; a GPU takes this pass alone.

A free step has no more constraints than frictions. Where a contact, a limit or an equality acts, nothing is changed.

Soft friction (``soft_friction``) is MuJoCo's own constraint, which the step has solved: a + b' v + R' f = 0 within ± F.
It changes only where hard friction of another joint turns, and settles with that:

    f += clip(f - (a + b' v + R' f) / (w + R'), ± F) - f
"""

from __future__ import annotations

import mujoco
import torch

NOTABLE = 1e-6
"""Of what friction can take from a speed in a step: a smaller change of it is rounding."""
TURNS = 1e-2
"""The same from which on a joint turns; what creeps changes by less."""
SWEEPS = 50
"""Over all joints, at most; a few settle them."""

SOURCE = f"""
static double turned(double speed, double pushed, double stop) {{
  const double onward = speed + pushed - copysign(stop, speed);
  if (onward * speed > 0.0) return onward;
  const double from_rest = pushed - fmin(fmax(pushed, -stop), stop), passed = onward - speed;
  return (passed == 0.0 ? 1.0 : onward / passed) * from_rest;
}}
typedef void (*Solve)(const mjModel*, mjData*, mjtNum*, const mjtNum*, int);
typedef void (*Drift)(const mjModel*, mjtNum*, const mjtNum*, mjtNum);
static double off(double before, double speed, double force, double w, double h, double most) {{
  const double stop = h * w * most, step = turned(before, speed - before - h * w * force, stop) - speed;
  return fabs(step) > {NOTABLE} * stop ? step : 0.0;
}}
static double yielding(const mjModel* m, int i, double before, double speed, double force, double w) {{
  const double impedance = m->dof_solimp[{mujoco.mjNIMP} * i], h = m->opt.timestep, most = m->dof_frictionloss[i];
  const double rate = 2.0 / (impedance * m->dof_solref[{mujoco.mjNREF} * i]);
  const double soft = (1.0 - impedance) / impedance * m->dof_invweight0[i];
  const double wanted = force - ((speed - before) / h + rate * before + soft * force) / (w + soft);
  const double step = h * w * (fmin(fmax(wanted, -most), most) - force);
  return fabs(step) > {NOTABLE} * h * w * most ? step : 0.0;
}}
static void settle(
    const mjModel* m, mjData* d, const double* before, double* change, const double* soft, Solve solve) {{
  const int n = m->nv;
  const double h = m->opt.timestep, *most = m->dof_frictionloss;
  double* inverse = (double*)calloc(2 * (n + 1) * n, sizeof(double));
  double *unit = inverse + n * n, *speed = unit + n * n, *force = speed + n;
  for (int i = 0; i < n; ++i) unit[i * n + i] = 1.0;
  solve(m, d, inverse, unit, n);
  memcpy(speed, d->qvel, n * sizeof(double));
  memcpy(force, d->qfrc_constraint, n * sizeof(double));
  for (int sweep = 0, turns = 1; turns && sweep < {SWEEPS}; ++sweep) {{
    turns = 0;
    for (int i = 0; i < n; ++i) {{
      const double *row = inverse + i * n, w = row[i];
      const double step = most[i] <= 0.0 ? 0.0
          : soft && soft[i] > 0.0 ? yielding(m, i, before[i], speed[i], force[i], w)
          : off(before[i], speed[i], force[i], w, h, most[i]);
      if (step == 0.0) continue;
      turns = 1;
      force[i] += step / (h * w);
      for (int j = 0; j < n; ++j) speed[j] += row[j] * (step / w);
    }}
  }}
  for (int i = 0; i < n; ++i) change[i] = speed[i] - d->qvel[i];
  free(inverse);
}}
static void turn_friction(const mjModel* m, mjData* d, const double* before, double* room, const double* soft,
                          Solve solve, Drift drift) {{
  const int n = m->nv;
  const double h = m->opt.timestep, *most = m->dof_frictionloss;
  double *impulse = room, *change = room + n;
  int rows = 0, creeps = 0, turns = 0;
  for (int i = 0; i < n; ++i) {{
    const double w = m->dof_invweight0[i];
    rows += most[i] > 0.0;
    const double force = d->qfrc_constraint[i], f = most[i];
    const int is_hard = f > 0.0 && w > 0.0 && !(soft && soft[i] > 0.0);
    const double step = is_hard ? off(before[i], d->qvel[i], force, w, h, f) : 0.0;
    impulse[i] = step == 0.0 ? 0.0 : step / w;
    creeps |= step != 0.0;
    turns |= fabs(step) > {TURNS} * h * w * most[i];
  }}
  if (!creeps || d->nf != rows || d->nefc != rows) return;
  if (turns)
    settle(m, d, before, change, soft, solve);
  else
    solve(m, d, change, impulse, 1);
  for (int i = 0; i < n; ++i) d->qvel[i] += change[i];
  drift(m, d->qpos, change, h);
}}
"""
"""The same in C, after MuJoCo's step: ``before`` are the speeds before it, ``room`` has 2 nv numbers, ``soft`` are the
time constants of soft frictions, 0 where they are hard, or none."""


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
    soft: tuple[torch.Tensor, torch.Tensor] | None = None,
) -> torch.Tensor:
    """By what the friction of each joint alone differs over a step, (num_envs, nv) [N m s]; zero where it does not.

    Args:
        before: Speeds before MuJoCo's step, (num_envs, nv).
        after: Speeds after it.
        force: Its friction.
        most: Coulomb friction F.
        weight: Each joint's w.
        step: h [s].
        soft: b' and R' of soft friction, where R' is above 0; ``None``: all is hard.
    """
    stop = step * weight * most
    change = turned(before, after - before - step * weight * force, stop) - after
    if soft is not None:
        rate, softness = soft
        left = (after - before) / step + rate * before + softness * force
        wanted = torch.clamp(force - left / (weight + softness), -most, most)
        change = torch.where(softness > 0, step * weight * (wanted - force), change)
    return torch.where((change.abs() > NOTABLE * stop) & (most > 0.0), change / weight, 0.0)


def settled(
    before: torch.Tensor,
    after: torch.Tensor,
    force: torch.Tensor,
    most: torch.Tensor,
    inverse: torch.Tensor,
    step: float,
    soft: tuple[torch.Tensor, torch.Tensor] | None = None,
) -> torch.Tensor:
    """Speeds after a step in which the frictions of all joints have turned, (num_envs, nv).

    Args:
        before: As for :func:`impulses`.
        after: As for it.
        force: As for it.
        most: As for it.
        inverse: M⁻¹, (num_envs, nv, nv).
        step: h [s].
        soft: As for it, (num_envs, nv) each.
    """
    speed, force, turns = after.clone(), force.clone(), True
    for _ in range(SWEEPS):
        if not turns:
            break
        turns = False
        for i in range(speed.shape[1]):
            own = None if soft is None else (soft[0][:, i], soft[1][:, i])
            impulse = impulses(before[:, i], speed[:, i], force[:, i], most[:, i], inverse[:, i, i], step, own)
            if bool(impulse.any()):
                turns = True
                force[:, i] += impulse / step
                speed += inverse[:, i] * impulse[:, None]
    return speed
