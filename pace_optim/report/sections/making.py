"""How the result was made, so that it can be made again."""

from __future__ import annotations

from pace_actuators.text import count_in_short, duration
from pace_optim.run.settings import command_line

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
        command=command_line(run.settings) if "task" in run.settings else "",
    )
    return Section(id="making", title="How it was made", html=text)


_DELAY_MODES = {
    "command": "the targets are delayed, the feedback is not",
    "effort": "the whole torque is delayed, feedback included",
}
