"""Write the page that lists the effects: ``python docs/site/effect_list.py > docs/effects.md``."""

from __future__ import annotations

from pace_actuators.effects.effect import Effect, EffectParameter
from pace_actuators.effects.registry import available_effects, get_effect

_HEAD = """\
# Physical effects

Effects extend the base model of armature, viscous friction, Coulomb friction, encoder bias and delay.
`pace fit --effects NAME` identifies an effect beside the base parameters.

| form | meaning |
|---|---|
| `NAME` | on all joints, each with its values |
| `NAME@JOINTS` | on some joints (a regular expression) |
| `NAME@shared` | one value for all joints |
| `NAME@JOINTS@shared` | one value for some joints |
| `…@wide` | bounds as wide as physics allows |

A positive torque turns the joint towards larger positions.

At its null value an effect vanishes exactly. A parameter without a null value shapes the effect, and matters only where
the effect acts.

The order of the names does not matter: effects act along the drive's path. The stages are command, measurement,
controller, drive, friction and transmission. `model` changes the rigid body. `recording` only changes the log.

Within the drive, effects act in this order:

1. The requested torque is limited (`effort_limit`, `torque_limit`).
2. The current follows (`drive_bandwidth`).
3. Torque comes from the current (`torque_gain`, `torque_fade`, `supply_sag`, `torque_ripple`).
4. The supply limits the result (`torque_speed_limit`, the torque-speed line).

Give a joint either `joint_elasticity` or `backlash`: a backlash includes an elasticity. A joint with both has one gap,
and behind it the two springs in series. Friction then acts on the motor, other torques on the link.

Bounds of stiffness, damping and inertia in a transmission or a mount are those of a joint with kp = 85 N m/rad. On
other joints they are multiplied by kp / 85. Those of `presliding_friction` scale too.

`thermal_friction`, `thermal_torque` and `supply_voltage` follow the motor's temperature and the supply's voltage.
[Log them](logs.md#temperature-and-voltage). Without a log, the temperature is 25 °C and the voltage `nominal`.

The last fourteen, `torque_over_…`, `friction_over_…`, `gain_over_…` and `inertia_over_position`, are free-form curves.
Bounds of torques follow the drive. Curves are straight from knot to knot, at `center + reach · knot`, and constant
beyond the last knot. They show what is missing, not why. `pace diagnose` compares them with the effects that it found,
and takes a curve if no effect explains the error. `result.json` (`curves`) and the report list their knots.

`python docs/site/effect_list.py > docs/effects.md` makes this page. [Your own effect](your_own_effect.md) adds one.

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
## What you see, and what separates an effect from similar ones

| effect | seen in the data | part to check | separated by recording |
|---|---|---|---|
"""
_TWINS = """
## Which effects are confounded

With one load, one gain and no absolute reference of the position, these effects act alike by construction. If one of
them removes an error, so does the other:

| effect | acts like | separated by |
|---|---|---|
"""
_PARTLY = """
Others are similar in part, especially in narrow recordings:

| similar | separated by |
|---|---|
| `com_offset` and the encoder bias | an absolute reference |
| `drive_bandwidth` and `joint_elasticity` | a known added mass |
| `parallel_spring` and a gain or a payload | a wide range of motion |
| `encoder_scale` and `payload` | a known added mass |
| `torque_speed_limit` and `quadratic_friction` | a large, fast motion |
| `backlash` and `joint_elasticity` | several amplitudes |
| `presliding_friction`, `creeping_friction` and `soft_friction` | a staircase that holds each step longer |

Give a joint only one of the last three: each replaces the simulator's Coulomb friction. `soft_friction` is not the
physics of a drive but of MuJoCo's solver, alike on all joints. Use it for recordings from MuJoCo.

No effect finds commands that jitter or are lost, or coarse quantisation. Where a log stamps its commands by a separate
clock (`des_time`), the fit holds each command from its own stamp, and reports jitter and losses. Elsewhere they raise
the noise.
"""


def page() -> str:
    """The page, of all effects that come with the package."""
    effects = [get_effect(name) for name in available_effects()]
    effects = [effect for effect in effects if effect.__module__.startswith("pace_actuators.")]
    effects.sort(key=lambda effect: effect.free_form)
    parts = [_HEAD, *(_row(f"`{e.name}`", e.stage, f"`{e.equation}`", e.source) for e in effects)]
    parts += [_PARAMETERS, *(_parameter(e, p) for e in effects for p in e.parameters if not _is_told(e, p))]
    parts += [_LOOKS, *(_row(f"`{e.name}`", e.looks, e.part or "–", e.separates) for e in effects)]
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
        name, meaning = f"`{p.name}` … `{p.name[:-1]}{last}`", "f at each knot"
    return _row(f"`{effect.name}`", name, meaning, p.unit, bounds, null)


def _is_told(effect: type[Effect], p: EffectParameter) -> bool:
    """Whether the row of a curve's first value describes it too."""
    return effect.free_form and p.null is not None and p is not effect.parameters[0]


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


if __name__ == "__main__":
    print(page(), end="")
