"""Write the page that lists the effects: ``python -m pace_actuators.effects > docs/effects.md``."""

from __future__ import annotations

from pace_actuators.effects.effect import Effect, EffectParameter
from pace_actuators.effects.registry import available_effects, get_effect

_HEAD = """\
# Physical effects

What a drive can have beyond the base model of armature, viscous friction, Coulomb friction, encoder bias and delay.
`scripts/fit.py --effects NAME` identifies an effect beside the base parameters; on some joints only with
`NAME@JOINTS` (a regular expression), with one value for all joints with `NAME@shared`, for some with
`NAME@JOINTS@shared`; `@wide` at the end widens its bounds as far as physics allows. At its null value an effect
vanishes exactly. A parameter without a null value shapes the effect; it matters only where the effect acts.

Effects act where the drive's path has them, whatever the order in which they are named: command, measurement,
controller, drive, friction, transmission; `model` changes the rigid body, `recording` only what the log shows. Within
the drive the torque that is asked is limited first (`effort_limit`, `torque_limit`), then the current follows
(`drive_bandwidth`), then torque comes of it (`torque_gain`, `torque_ripple`), and the supply limits what is left
(`torque_speed_limit`, the torque-speed line). Of `joint_elasticity` and `backlash`, give a joint one: a backlash has an
elasticity of its own, and a joint with both has one gap with the two springs in series behind it. Friction then acts
on the motor, other torques on the link.

The last six, `torque_over_…` and `friction_over_…`, are curves of any form: straight from knot to knot, at `center +
reach · knot`, and constant beyond the last. They say what is missing and not why: `scripts/diagnose.py` does not look
for them, but holds them against the effects that it found, and takes one where none of them explains the error.

This page is made by `python -m pace_actuators.effects > docs/effects.md`. An effect of your own:
[your_own_effect.md](your_own_effect.md).

## Equations

| effect | stage | equation | source |
|---|---|---|---|
"""
_PARAMETERS = """
## Parameters

Results call them `<effect>.<parameter>`.

| effect | parameter | meaning | unit | bounds | null |
|---|---|---|---|---|---|
"""
_LOOKS = """
## What a person sees, and what separates an effect from its likes

| effect | seen in the data | separated by recording |
|---|---|---|
"""
_TWINS = """
## Which cannot be told apart

With one load, one gain and no absolute reference of the position, these act alike by construction. An error that one of
them removes, the other removes as well:

| effect | acts like | what separates them |
|---|---|---|
"""
_PARTLY = """
Others are alike in part, the more so the narrower the recording: `com_offset` and the encoder bias (an absolute
reference separates them), `drive_bandwidth` and `joint_elasticity` (a known added mass), `parallel_spring` and a gain
or a payload (a wide range of motion), `encoder_scale` and `payload` (a known added mass), `torque_speed_limit` and
`quadratic_friction` (a large, fast motion), `backlash` and `joint_elasticity` (several amplitudes), and the three
frictions that do not stick, `presliding_friction`, `creeping_friction` and `soft_friction` (a staircase that holds each
of its steps longer). Of these give a joint one: each takes Coulomb friction over from the simulator. `soft_friction` is
no physics of a drive but that of MuJoCo's solver: it is for recordings that were made in MuJoCo.

Not to be found by any smooth model, but a quality of the recording: a delay that jitters, dropped commands, coarse
quantisation. They raise the noise.
"""


def page() -> str:
    """The page, of all effects that come with the package."""
    effects = [get_effect(name) for name in available_effects()]
    effects = [effect for effect in effects if effect.__module__.startswith("pace_actuators.")]
    effects.sort(key=lambda effect: effect.free_form)
    parts = [_HEAD, *(_row(f"`{e.name}`", e.stage, f"`{e.equation}`", e.source) for e in effects)]
    parts += [_PARAMETERS, *(_parameter(e, p) for e in effects for p in e.parameters if not _is_told(e, p))]
    parts += [_LOOKS, *(_row(f"`{e.name}`", e.looks, e.separates) for e in effects)]
    twins = [
        _row(f"`{e.name}`", ", ".join(f"`{like}`" for like in (*e.twins, e.absorbed_by) if like), e.separates)
        for e in effects
        if e.twins or e.absorbed_by
    ]
    return "".join([*parts, _TWINS, *twins, _PARTLY])


def _parameter(effect: type[Effect], p: EffectParameter) -> str:
    bounds = f"{p.lower:g} to {p.upper:g}" + (", log" if p.scale == "log" else "")
    null = "none" if p.null is None else f"{p.null:g}"
    name, meaning = f"`{p.name}`", p.meaning
    if effect.free_form and p is effect.parameters[0]:
        last = sum(q.null is not None for q in effect.parameters) - 1
        name, meaning = f"`{p.name}` … `effort_{last}`", "f at each knot"
    return _row(f"`{effect.name}`", name, meaning, p.unit, bounds, null)


def _is_told(effect: type[Effect], p: EffectParameter) -> bool:
    """Whether the row of a curve's first value tells of it too."""
    return effect.free_form and p.null is not None and p is not effect.parameters[0]


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


if __name__ == "__main__":
    print(page(), end="")
