"""How the result was made, so that it can be made again."""

from __future__ import annotations

import shlex
from typing import Any

from pace_actuators.text import count_in_short, duration
from pace_optim.terminal.cli import command

from ..markup import Section, html
from ..run_data import RunData


def making(run: RunData) -> Section:
    """Settings, effort and why it stopped."""
    result = run.result
    physics, control = 1e3 * result.physics_dt, 1e3 * result.control_dt
    facts = {
        "Task": result.task,
        "Effects added": ", ".join(result.effects) or "none",
        "Delay mode": f"{result.delay_mode} ({_DELAY_MODES.get(result.delay_mode, '')})",
        "Time steps": f"physics {physics:g} ms, control {control:g} ms",
        "Optimizer": result.optimizer,
        "Generations": str(result.generations),
        "Refinement": f"{len(run.history.refine_best)} iterations" if run.history else "–",
        "Simulated steps": count_in_short(result.simulated_steps),
        "Time": duration(result.wall_time_s),
        "Speed": f"{count_in_short(result.simulated_steps / result.wall_time_s)} steps/s"
        if result.wall_time_s
        else "–",
        "Seed": str(result.seed),
        "Stopped because": "; ".join(result.stop_reasons),
        "Folder": str(run.folder),
    }
    text = html(
        '<dl class="facts">{% for name, value in facts.items() %}<div><dt>{{ name }}</dt><dd>{{ value }}</dd></div>'
        "{% endfor %}</dl>{% if command %}<p>The same fit again:</p><pre>{{ command }}</pre>{% endif %}",
        facts=facts,
        command=_command(run.settings),
    )
    return Section(id="making", title="How it was made", html=text)


_DELAY_MODES = {
    "command": "the targets are delayed, the feedback is not",
    "effort": "the whole torque is delayed, feedback included",
}

_WITHOUT_FLAG = ("start", "check_consistency")
"""Settings that no flag of the same name makes."""


def _command(settings: dict[str, Any]) -> str:
    """The command line of these settings; what was left to the robot's configuration is left out."""
    if "task" not in settings:
        return ""
    words = ["python", *command("fit").split()]
    words = words if words[1].endswith(".py") else words[1:]
    flags = {name: value for name, value in settings.items() if name not in _WITHOUT_FLAG}
    flags["no_consistency"] = settings.get("check_consistency") is False
    for name, value in flags.items():
        if value is None or value is False or value == []:
            continue
        words.append(f"--{name}")
        if isinstance(value, list):
            words += [str(entry) for entry in value]
        elif value is not True:
            words.append(str(value))
    return shlex.join(words)
