"""A result as text for a terminal."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path

from pace_actuators.drive_result import ALL
from pace_actuators.joint_units import JOINT_TYPES, JointType, units_for
from pace_actuators.text import aligned, conjoined, in_short, percent, shortened, with_table
from pace_optim.run.result import FitResult
from pace_optim.terminal.cli import command

ABOVE_NOISE = 1.5
"""Times the noise above which an error has causes beside it."""
_NEARLY_ALL = 0.9
"""Part of the squared error that a few joints hold where the others need no look."""
_FEW = 6
"""Values of an effect that a line shows; curves have more."""


def summary(result: FitResult) -> list[str]:
    """The table of parameters with error bars, the errors and the three first warnings, a line each."""
    lines: list[str] = []
    for joint_type in JOINT_TYPES:
        joints = [joint for joint in result.joint_names if result.joint_type(joint) == joint_type]
        base = [name for name in result.joint_parameters if "." not in name]
        lines += _table(result, base, joints, joint_type)
    lines += _effects(result)
    lines += _links(result)
    for name, values in result.parameters.items():
        if set(values) == {ALL}:
            lines.append(f"{name}: {_value(result, name, 'all')} {result.unit_of(name, 'all')}")
            if name == "delay":
                lines[-1] = _delay(result)
    if result.step_error:
        rate = " and the assumed loop rate" if result.assumes_loop_rate else ""
        step = f"the physics step of {1e3 * result.physics_dt:g} ms"
        lines.append(f"±: one standard deviation, which includes noise, {step}{rate}")
    lines.append(f"{error_line(result)}; {units_for(f'score {result.score:.3e} rad²', result.joint_types)}")
    if result.times_noise and not result.std_means_nothing:
        said = above_noise(result) or f"{result.times_noise:.3g} times the measurement noise"
        lines.append(f"training error: {said}")
    if few := few_joints(result):
        lines.append(few)
    if result.torque_noise:
        lines.append(f"error of torques: {', '.join(_torque_errors(result))} (train / validation)")
    if result.objective:
        parts = " / ".join("-" if part is None else f"{part:.4g}" for part in result.objective.values())
        lines.append(f"objective {result.optimizer}: {parts} (train / validation)")
    lines.append(
        f"{result.simulated_steps / 1e6:.2f} M simulated steps in {result.wall_time_s:.1f} s; "
        f"stopped: {'; '.join(result.stop_reasons)}"
    )
    lines += [f"note: {finding}" for finding in result.findings]
    for warning in shortened(result.warnings, "warning"):
        lines += with_table(f"warning: {warning}")
    return lines + ["meaning and cure of each code: docs/faq.md"] * any("[W" in warning for warning in result.warnings)


def above_noise(result: FitResult) -> str:
    """How far above the noise a fit has ended, and why; empty near the noise."""
    times = result.times_noise or 0.0
    return f"{times:.3g} times the measurement noise: {why_above_noise(result)}" if times >= ABOVE_NOISE else ""


def why_above_noise(result: FitResult) -> str:
    """What an error above the noise shows."""
    return "the fit was interrupted" if "interrupted" in result.stop_reasons else "something is missing"


def few_joints(result: FitResult) -> str:
    """Which few joints hold nearly all of an error above the noise, in training or held out; else ""."""
    train, held_out = result.rmse["train"], result.rmse.get("validation", {})
    errors = {joint: max(error or 0.0, held_out.get(joint) or 0.0) for joint, error in train.items()}
    return carried_by(errors) if (result.times_noise or 0.0) >= ABOVE_NOISE else ""


def carried_by(errors: Mapping[str, float | None]) -> str:
    """Which few joints hold nearly all of the squared error, in a sentence; "" where many do.

    Args:
        errors: RMSE by joint.
    """
    squares = {joint: error**2 for joint, error in errors.items() if joint != ALL and error is not None}
    order, total = sorted(squares, key=squares.__getitem__, reverse=True), sum(squares.values())
    for count in range(1, len(order) // 3 + 1):
        share = sum(squares[joint] for joint in order[:count]) / total if total else 0.0
        if share >= _NEARLY_ALL:
            first = [joint for joint in squares if joint in order[:count]]
            return f"{conjoined(first)} hold{'s' if count == 1 else ''} {percent(share)} of the squared error."
    return ""


def error_line(result: FitResult, of: str = "error, all joints") -> str:
    """RMSE of all joints in training and validation, under a name."""
    return units_for(f"{of}: {errors_of(result, ALL)} mrad (train / validation)", result.joint_types)


def next_lines(result: FitResult, folder: Path, *, diagnosed: bool = False) -> list[str]:
    """The commands that come after a fit, by how far its error is above the noise; none if the noise is unknown.

    A fit, or its checks, that was interrupted is resumed first.

    Args:
        diagnosed: Whether that is the end of a diagnosis.
    """
    run = shlex.quote(str(folder))
    if result.is_interrupted:
        return [f"next: {command('fit')} --resume {run}"]
    if result.times_noise is None and not diagnosed:
        return []
    fmt, ending = ("cfg", "drives.py") if result.effects else ("mjcf", "identified.xml")  # MJCF has few effects
    file = shlex.quote(f"{result.robot_name}_{ending}")
    export = f"next: {command('export')} {run} --format {fmt} --output {file}"
    if diagnosed:
        return [*(f"next: {command(verb)} {run}" for verb in ("compare", "replay")), export]
    return [export] if (result.times_noise or 0.0) < ABOVE_NOISE else [f"next: {command('diagnose')} {run}"]


def _torque_errors(result: FitResult) -> list[str]:
    """Errors of torques that the fit follows, joint by joint."""
    train, validation = (result.torque_rmse[part] for part in ("train", "validation"))
    return [
        f"{joint} {value:.2g} / {f'{validation[joint]:.2g}' if joint in validation else '-'} "
        f"{units_for('N m', [result.joint_type(joint)])}"
        for joint, value in train.items()
    ]


def _table(result: FitResult, names: list[str], joints: list[str], joint_type: JointType) -> list[str]:
    """The joints of one type, a line each, under a head with their units."""
    if not joints:
        return []
    names = [name for name in names if set(joints) & set(result.parameters[name])]
    unit = {name: next(result.unit_of(name, j) for j in joints if j in result.parameters[name]) for name in names}
    columns = [[f"{name} [{unit[name]}]", *(_value(result, name, joint) for joint in joints)] for name in names]
    head = units_for("train / validation [mrad]", [joint_type])
    columns.append([head, *(errors_of(result, joint) for joint in joints)])
    names_shown, pattern = in_short(joints)
    return [*aligned([[f"joint {pattern}".strip(), *names_shown], *columns]), ""]


def _effects(result: FitResult) -> list[str]:
    """The effects of joints, a line for each joint that has one."""
    rows: dict[tuple[str, str], list[str]] = {}
    for name in result.joint_parameters:
        effect, _, parameter = name.partition(".")
        for joint in result.parameters[name] if parameter else ():
            text = f"{parameter} {_value(result, name, joint)} {result.unit_of(name, joint)}".removesuffix(" 1")
            rows.setdefault((effect, joint), []).append(text)
    if not rows:
        return []
    short, pattern = in_short(result.joint_names)
    shown = dict(zip(result.joint_names, short, strict=True))
    table = [("effect", f"joint {pattern}".strip(), "values")]
    for (effect, joint), own in rows.items():
        values = ", ".join(own) if len(own) <= _FEW else f"{len(own)} values: see the report"
        table.append((effect, shown.get(joint, joint), values))
    first, second = (max(len(row[i]) for row in table) for i in (0, 1))
    return [*(f"{effect:<{first}}  {joint:<{second}}  {values}" for effect, joint, values in table), ""]


def _links(result: FitResult) -> list[str]:
    """The inertial parameters of links, a line each, beside what the model file states."""
    if not result.link_parameters:
        return []
    width = max(len(link) for link in [*result.links, "link"])
    lines = ["  ".join(["link".ljust(width), "parameter".ljust(14), "file".rjust(12), "found".rjust(26)])]
    for link in result.links:
        for name in result.link_parameters:
            if link in result.parameters[name]:
                title = f"{name.removeprefix('link_')} [{result.unit_of(name, link)}]".ljust(14)
                file = f"{result.file_values[name][link]:.4g}".rjust(12)
                lines.append("  ".join([link.ljust(width), title, file, _value(result, name, link).rjust(26)]))
    return [*lines, ""]


def _delay(result: FitResult) -> str:
    """The delay in ms and in control steps."""
    step, mode = 1e3 * result.control_dt, f"delay mode {result.delay_mode}"
    steps = f"{result.parameters['delay'][ALL]:.4g} control steps of {step:g} ms"
    return f"delay: {_value(result, 'delay', ALL, step)} ms ({steps}), {mode}"


def _value(result: FitResult, name: str, key: str, factor: float = 1.0) -> str:
    if key not in result.parameters[name]:  # an effect that other joints have
        return "-"
    std = result.std[name][key]
    label = f"{name}/{key}"
    mark = " (at bound)" if label in result.at_bound else " (prior)" if label in result.undetermined else ""
    means_nothing = result.std_means_nothing and result.has_error_bar(name, key)
    error = " ± ?" if means_nothing else "" if std is None else f" ± {factor * std:.1g}"
    return f"{factor * result.parameters[name][key]:.4g}{error}{mark}"


def errors_of(result: FitResult, key: str) -> str:
    """RMSE of a joint, or of ``"all"``, in training and validation [mrad or mm], as "0.12 / 0.15"."""
    parts = [result.rmse[which].get(key) for which in ("train", "validation")]
    return " / ".join("-" if part is None else f"{1e3 * part:.4g}" for part in parts)
