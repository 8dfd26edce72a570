"""A result as text for a terminal."""

from __future__ import annotations

from pace_optim.run.result import FitResult


def summary(result: FitResult) -> str:
    """The table of parameters with error bars, the errors and the warnings."""
    names = [name for name, values in result.parameters.items() if set(values) != {"all"}]
    width = max(len(joint) for joint in [*result.joint_names, "joint"])
    columns = [f"{name} [{result.units[name]}]" for name in names]
    lines = ["  ".join(["joint".ljust(width), *(c.rjust(26) for c in columns), "train / validation [mrad]".rjust(26)])]
    for joint in result.joint_names:
        cells = [_value(result, name, joint).rjust(26) for name in names]
        lines.append("  ".join([joint.ljust(width), *cells, _errors(result, joint).rjust(26)]))
    lines.append("")
    for name, values in result.parameters.items():
        if set(values) == {"all"}:
            text = f"{name}: {_value(result, name, 'all')} {result.units[name]}"
            if name == "delay":
                text += f" = {1e3 * result.delay_s:.3f} ms, delay mode {result.delay_mode}"
            lines.append(text)
    lines.append(
        f"error, all joints: {_errors(result, 'all')} mrad (train / validation); score {result.score:.3e} rad²"
    )
    lines.append(
        f"{result.simulated_steps / 1e6:.2f} M simulated steps in {result.wall_time_s:.1f} s; "
        f"stopped: {'; '.join(result.stop_reasons)}"
    )
    lines += [f"note: {note}" for note in result.notes]
    lines += [f"warning: {warning}" for warning in result.warnings]
    return "\n".join(lines)


def _value(result: FitResult, name: str, key: str) -> str:
    std = result.std[name][key]
    label = f"{name}/{key}"
    mark = " (at bound)" if label in result.at_bound else " (prior)" if label in result.undetermined else ""
    error = "" if std is None else " ± ?" if result.std_means_nothing else f" ± {std:.1g}"
    return f"{result.parameters[name][key]:.5g}{error}{mark}"


def _errors(result: FitResult, key: str) -> str:
    parts = [result.rmse[which].get(key) for which in ("train", "validation")]
    return " / ".join("-" if part is None else f"{1e3 * part:.4g}" for part in parts)
