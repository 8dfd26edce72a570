"""Docstrings as the reference shows them: roles of reStructuredText become code."""

import re

import griffe

_SESSION = re.compile(r"^((?:>>> .*\n?)(?:.+\n?)*)$", re.MULTILINE)
"""An example as typed at Python's prompt, up to the next empty line."""
_ROLE = re.compile(r":(?:class|func|meth|mod|attr|data|exc):`~?([^`]+)`")


class Roles(griffe.Extension):
    """``:class:`~pace_envs.Scene``` reads ``Scene`` where a tilde asks for it, the whole name elsewhere."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Change an object's docstring as it is read."""
        if obj.docstring is not None:
            text = _ROLE.sub(_code, obj.docstring.value).replace("``", "`")
            obj.docstring.value = _SESSION.sub(r"```python\n\1\n```", text)


def _code(match: re.Match[str]) -> str:
    name = match.group(1)
    return f"`{name.rsplit('.', 1)[-1] if '~' in match.group(0) else name}`"
