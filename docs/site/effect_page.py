"""One effect in words, for its page of the documentation."""

from __future__ import annotations

from pace_actuators.effects.effect import Effect, EffectParameter
from pace_actuators.text import capitalised


def effect_page(effect: type[Effect], picture: str | None = None) -> str:
    """A page in Markdown: what it is, what a person sees, its parameters, its likes, how to add it.

    Args:
        picture: Path of a picture of the error that it leaves, from the page.
    """
    parts = [f"# {effect.name}\n\n{_sentence(effect.looks)}\n"]
    if picture:
        parts.append(f"\n![The error that {effect.name} leaves after a base fit]({picture})\n")
    parts.append(
        f"\n## Equation\n\n```text\n{effect.equation}\n```\n\nStage: {effect.stage}. Source: {effect.source}.\n"
    )
    parts += [f"\nPart to check: {effect.part}.\n"] if effect.part else []
    parts.append("\n## Parameters\n\n| parameter | meaning | unit | bounds | null |\n|---|---|---|---|---|\n")
    parts += [_row(parameter) for parameter in effect.parameters]
    likes = [like for like in (*effect.twins, effect.absorbed_by) if like]
    if likes or effect.separates:
        parts.append("\n## What is like it\n\n")
        parts += [f"Acts like {' and '.join(f'`{like}`' for like in likes)}.\n" if likes else ""]
        parts += [f"Separated by recording: {effect.separates}.\n" if effect.separates else ""]
    parts.append(
        f"\n## Add it\n\n```text\npace fit --task TASK --data FILE --effects {effect.name}\n```\n"
        "\nAll effects: [effects.md](../effects.md).\n"
    )
    return "".join(parts)


def _row(p: EffectParameter) -> str:
    bounds = f"{p.lower:g} to {p.upper:g}" + (", log" if p.scale == "log" else "")
    return f"| `{p.name}` | {p.meaning} | {p.unit} | {bounds} | {'none' if p.null is None else f'{p.null:g}'} |\n"


def _sentence(text: str) -> str:
    return f"{capitalised(text)}." if text else ""
