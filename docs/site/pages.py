"""Pages of the site that lie elsewhere, or are made: README, benchmarks, commands, reference, a page for each effect.

MkDocs calls :func:`on_files` and :func:`on_page_markdown` (mkdocs.yml, ``hooks``).
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
import posixpath
import re
import sys
from importlib import import_module
from pathlib import Path
from unittest import mock

from effect_page import effect_page
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

from pace_actuators.effects import available_effects, get_effect
from pace_actuators.effects.effect import Effect
from pace_optim.commands import verbs

ROOT = Path(__file__).parents[2]
ELSEWHERE = {"README.md": "index.md"}
"""Pages outside docs/, and where the site has them; others keep their path."""
PUBLIC = ("pace_optim", "pace_envs", "pace_envs/managers", "pace_envs/mdp", "pace_actuators", "pace_actuators/effects")
"""Folders whose exports the reference shows."""
_LINK = re.compile(r"(!?)\[([^\]\[]*(?:\[[^\]]*\][^\]\[]*)*)\]\((?!https?:|mailto:|#)([^)\s#]+)(#[^)\s]*)?\)")

_CODE = re.compile(r"`[^`\n]+`")
"""GitHub needs ``\\|`` in a table's code; here it is not needed, and its backslash would show."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that do not lie in docs/."""
    for path in [*ROOT.glob("*.md"), *(ROOT / "benchmarks").glob("*.md")]:
        name = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, ELSEWHERE.get(name, name), content=path.read_text("utf-8")))
    for name, text in {**effect_pages(), "commands.md": commands(), "reference.md": reference()}.items():
        made = File.generated(config, name, content=text)
        if name.startswith("effects/") and name != "effects/index.md":
            made.inclusion = InclusionLevel.NOT_IN_NAV  # the gallery leads there
        files.append(made)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links of the checkout into links of the site; what the site does not have becomes plain text."""
    back = {site: source for source, site in ELSEWHERE.items()}
    uri = page.file.src_uri
    source = back.get(uri, uri)
    outside = (ROOT / source).is_file()
    folder = posixpath.dirname(source if outside else f"docs/{source}")

    def link(match: re.Match[str]) -> str:
        mark, text, target, anchor = match.groups()
        path = posixpath.normpath(posixpath.join(folder, target))
        wanted = ELSEWHERE.get(path, path.removeprefix("docs/"))
        if files.get_file_from_path(wanted) is None:
            return text if not mark else f"`{target}`"
        return f"{mark}[{text}]({posixpath.relpath(wanted, posixpath.dirname(uri) or '.')}{anchor or ''})"

    return _CODE.sub(lambda code: code[0].replace("\\|", "|"), _LINK.sub(link, markdown))


def effect_pages() -> dict[str, str]:
    """One page for each effect that comes with the package, and the gallery of all."""
    known = [get_effect(name) for name in available_effects()]
    known = [effect for effect in known if effect.__module__.startswith("pace_actuators.")]
    pages = {f"effects/{effect.name}.md": effect_page(effect, _picture(effect)) for effect in known}
    rows = [_card(effect) for effect in known if _picture(effect)]
    head = (
        "# Gallery\n\nWhat each effect leaves in the data after the base parameters are fitted: one drive that swings "
        "a pendulum, recorded by an independent simulator that has the effect. Find the picture "
        "that looks like yours.\n"
    )
    others = [f"[{effect.name}]({effect.name}.md)" for effect in known if not _picture(effect)]
    tail = f"\n## Without a picture\n\n{', '.join(others)}\n" if others else ""
    pages["effects/index.md"] = head + "\n".join(rows) + tail
    return pages


def _picture(effect: type[Effect]) -> str | None:
    name = f"images/effects/{effect.name}.png"
    return f"../{name}" if (ROOT / "docs" / name).is_file() else None


def _card(effect: type[Effect]) -> str:
    seen = f"{effect.looks[:1].upper()}{effect.looks[1:]}."
    return (
        f"\n## {effect.name}\n\n{seen} [Equation and parameters]({effect.name}.md)\n"
        f"\n![Error that {effect.name} leaves](../images/effects/{effect.name}.png)\n"
    )


def commands() -> str:
    """The commands of ``pace``, as ``--help`` prints them."""
    names = {module: {"import_log": "import"}.get(module, module).replace("_", "-") for module in verbs()}
    text = ["# Command line\n\n`pace VERB --help` prints the same.\n\n| command | |\n|---|---|\n"]
    text += [f"| [`pace {name}`](#pace-{name}) | {verbs()[module]} |\n" for module, name in names.items()]
    for module, name in names.items():
        text.append(f"\n## pace {name}\n\n```text\n{_help(module, name).strip()}\n```\n")
    return "".join(text)


def _help(module: str, name: str) -> str:
    main, out = import_module(f"pace_optim.commands.{module}").main, io.StringIO()
    words, width = (
        mock.patch.object(sys, "argv", [f"pace {name}", "--help"]),
        mock.patch.dict(os.environ, COLUMNS="96"),
    )
    with words, width, contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main()
    return out.getvalue()


def reference() -> str:
    """The public names: what the ``__init__`` of each public package exports."""
    text = ["# Reference\n\nWhat the packages export, from the docstrings.\n"]
    for init in (ROOT / name / "__init__.py" for name in PUBLIC):
        names = [name for name in _exported(init) if f"{init.parent.name}/{name}" not in PUBLIC]
        package = init.parent.relative_to(ROOT).as_posix().replace("/", ".")
        if names:
            members = "".join(f"        - {name}\n" for name in names)
            text.append(f"\n## {package}\n\n::: {package}\n    options:\n      show_root_heading: false\n")
            text.append(f"      heading_level: 3\n      members:\n{members}")
    return "".join(text)


def _exported(init: Path) -> list[str]:
    for node in ast.parse(init.read_text("utf-8")).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            value = ast.literal_eval(node.value) if isinstance(node.value, ast.List | ast.Tuple) else []
            return [name for name in value if not name.startswith("_")]
    return []
