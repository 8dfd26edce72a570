"""The user's code, found by name: a module is imported if the user names it, or if it fits a record.

A name in a file alone imports nothing. A record, in a run's ``settings.json`` and ``result.json``, has the path and the
SHA-256 of each file of the code. The bytes that were compared are the ones that run: neither another file of that name
nor a stale byte code can take their place. The code must also have been named on this machine before
(:func:`is_trusted`), because a foreign folder can bring both code and its digest. Digests of what was named are kept in
``$XDG_STATE_HOME/pace`` (``~/.local/state/pace``), if that folder is the user's alone; else code is named each time.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from pace_actuators.files import OwnFolder, file_at, refuse

_FILE = "named_code.txt"


def trust(digests: Iterable[str]) -> None:
    """Remember code that was named here; where nothing can be kept, it must be named each time.

    Args:
        digests: SHA-256 of its files.
    """
    if (folder := _folder()) is None:
        return
    with contextlib.suppress(OSError), folder.alone():
        kept = _kept(folder)
        if new := set(digests) - kept:
            folder.write(_FILE, "".join(f"{digest}\n" for digest in sorted(kept | new)).encode())


def is_trusted(digest: str) -> bool:
    """Whether code of this SHA-256 has been named here before."""
    folder = _folder()
    return folder is not None and digest in _kept(folder)


def _kept(folder: OwnFolder) -> set[str]:
    text = (folder.read(_FILE) or b"").decode("ascii", errors="replace")
    return set(re.findall(r"^[0-9a-f]{64}$", text, re.MULTILINE))


def _folder() -> OwnFolder | None:
    """Where they are kept: outside of every folder of runs."""
    return OwnFolder.below("XDG_STATE_HOME", ".local/state", "pace")


CodeRecord = Mapping[str, Mapping[str, str]]
"""``{module: {"file": path, "sha256": digest}}``, each file of a user's code."""

_OURS = ("pace_actuators", "pace_envs", "pace_optim", "pace_assets")
_INSTALLED = ("site-packages", "dist-packages")


def split_reference(text: str) -> tuple[str, str]:
    """``module:Name`` or ``path/to/file.py:Name`` in its two parts; the first is empty where there is only a name."""
    module, _, name = text.rpartition(":")
    return module, name


def absolute_reference(text: str) -> str:
    """The same reference, which means the same from any folder: a path is made absolute."""
    module, name = split_reference(text)
    return f"{Path(module).resolve()}:{name}" if is_path(module) else text


def is_path(module: str) -> bool:
    """Whether a module is named by its file."""
    return module.endswith(".py")


def loaded_module(module: str) -> ModuleType | None:
    """A module that has been imported before, by its name or its file."""
    if not is_path(module):
        return sys.modules.get(module)
    file = Path(module).resolve()
    own = file.stat() if file.exists() else None
    modules = [m for m in list(sys.modules.values()) if isinstance(m, ModuleType)]  # Cython puts other objects there
    others = (m for m in modules if m.__name__ != "__main__" and (own is None or _is_at(m, own)))
    return next((m for m in others if source_file(m) == file), None)


def _is_at(module: ModuleType, own: os.stat_result) -> bool:
    """Whether a module's file is this one: to resolve the paths of thousands takes a tenth of a second."""
    try:
        return os.path.samestat(os.stat(module.__file__), own)  # type: ignore[arg-type]
    except (AttributeError, TypeError, OSError, ValueError):
        return False


def import_named(module: str) -> ModuleType:
    """Import a module that the user names, as ``package.module`` or as a file; it may lie in the present folder."""
    recorded = [finder for finder in sys.meta_path if isinstance(finder, _RecordedCode)]
    for finder in recorded:  # what the user names comes before what records name
        sys.meta_path.remove(finder)
    try:
        found = _import_file(Path(module).resolve()) if is_path(module) else _import_name(module)
        trust(entry["sha256"] for entry in code_of([module]).values())
        return found
    except (ImportError, SyntaxError, OSError) as error:
        raise ValueError(
            f"the module {module!r} cannot be imported ({_one_line(error)}). Correct its name, put its folder on "
            "PYTHONPATH, or name its file."
        ) from None
    finally:
        sys.meta_path[:0] = recorded


def import_reference(text: str, what: str) -> str:
    """Import the module of what the user names, and return the text, good from any folder; a name alone stays.

    Args:
        text: ``module:Name``, ``path/to/file.py:Name``, or a name.
        what: What was named, for messages.
    """
    if not (module := split_reference(text)[0]):
        return text
    try:
        import_named(module)
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from None
    return absolute_reference(text)


def import_recorded(module: str, code: CodeRecord, where: str, hint: str) -> ModuleType:
    """Import a module that a file names, if its code is what the file's record says.

    Args:
        where: The file that names it, for messages.
        hint: What the user types to name it himself.
    """
    name = next((n for n, entry in code.items() if entry["file"] == module), module)
    known = loaded_module(module)
    if known is not None and (name not in code or source_file(known) == Path(code[name]["file"])):
        return known
    if name not in code:
        raise ValueError(
            f"{where} names code, {module}, and has no record of it: it is not imported by itself. If you trust it, "
            f"name it: {hint}."
        )
    for each, entry in code.items():
        if (other := sys.modules.get(each)) is not None and source_file(other) != Path(entry["file"]):
            _forget(each)
    finder = _RecordedCode(code, where, hint)
    sys.meta_path.insert(0, finder)
    try:
        return import_module(name)
    except BaseException as error:
        sys.meta_path.remove(finder)
        if not isinstance(error, ImportError):
            raise
        raise ValueError(
            f"{where}: the code {module} cannot be imported again ({_one_line(error)}). Name it: {hint}."
        ) from None


def code_of(modules: Sequence[str]) -> dict[str, dict[str, str]]:
    """The record of modules and of all that they import from beside them; packages that were installed are left out."""
    record: dict[str, dict[str, str]] = {}
    waiting = [name for module in modules for name in _with_parents(module)]
    roots = {root for module in modules if (root := _root(module)) is not None}
    while waiting:
        name = waiting.pop()
        file = _file_of(name, roots)
        if name in record or file is None or name.partition(".")[0] in _OURS or not _is_own(file, name, modules, roots):
            continue
        source = file.read_bytes()
        record[name] = {"file": str(file), "sha256": digest_of(source)}
        waiting += [each for found in _imports(source, name, file) for each in _with_parents(found)]
    return dict(sorted(record.items()))


def checked_record(content: Mapping[str, Any], source: object, cure: str) -> CodeRecord:
    """The record of the code in a file's ``environment``."""
    code = content.get("code", {})
    if not isinstance(code, Mapping) or not all(
        isinstance(entry, Mapping) and all(isinstance(entry.get(key), str) for key in ("file", "sha256"))
        for entry in code.values()
    ):
        refuse(source, "environment.code is no record of files and digests", cure)
    return code


def source_file(module: ModuleType) -> Path | None:
    """Where a module's source lies; ``None`` if it has none."""
    file = getattr(module, "__file__", None)
    return Path(file).resolve() if isinstance(file, str) and file.endswith(".py") else None


def digest_of(content: bytes) -> str:
    """SHA-256."""
    return hashlib.sha256(content).hexdigest()


def _import_file(file: Path) -> ModuleType:
    if not file.is_file():
        raise ImportError(f"there is no file {file}")
    if (known := loaded_module(str(file))) is not None:
        return known
    name = file.stem
    if (other := sys.modules.get(name)) is not None:
        if _is_installed(name, other):
            name = f"{name}_{digest_of(str(file).encode())[:8]}"
        else:
            _forget(name)
    spec = spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ImportError(f"{file} is no Python file")
    module = module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(file.parent))  # as `python file.py` does
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    finally:
        sys.path.remove(str(file.parent))
        _search(file.parent)
    return module


def _import_name(name: str) -> ModuleType:
    if not all(part.isidentifier() for part in name.split(".")):
        raise ImportError("it is no module's name")
    top = name.partition(".")[0]
    spec, here = PathFinder.find_spec(top), str(Path.cwd())
    if spec is None and (spec := PathFinder.find_spec(top, [here])) is not None:
        _search(Path(here))
    known = sys.modules.get(top)
    if (
        known is not None
        and spec is not None
        and spec.origin is not None
        and source_file(known)
        not in (
            None,
            Path(spec.origin).resolve(),
        )
    ):
        _forget(top)
    return import_module(name)


def _search(folder: Path) -> None:
    """Let modules be found in a folder, after all others."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


def _is_installed(name: str, module: ModuleType) -> bool:
    file = source_file(module)
    return file is None or name in (*sys.stdlib_module_names, *_OURS) or any(part in _INSTALLED for part in file.parts)


def _forget(name: str) -> None:
    """Let a name stand for another module of that name, in another folder."""
    for each in [each for each in sys.modules if each == name or each.startswith(f"{name}.")]:
        del sys.modules[each]


def _verified(entry: Mapping[str, str], where: str, hint: str) -> bytes:
    file = Path(entry["file"])
    try:
        content = file_at(file, "").read_bytes()
    except (OSError, ValueError):
        raise ValueError(f"{where} was made with {file}, which has gone. Put it back, or name it: {hint}.") from None
    if digest_of(content) != entry["sha256"]:
        raise ValueError(
            f"{file} has changed since {where} was made with it, so it is not imported by itself. Put it back, or name "
            f"it: {hint}."
        )
    if not is_trusted(entry["sha256"]):
        raise ValueError(
            f"{where} names code, {file}, that was never named on this machine, so it is not imported. "
            f"If you trust it, name it: {hint}."
        )
    return content


class _RecordedCode(MetaPathFinder):
    """Finds the modules of a record, each compared when it is imported, and no other."""

    def __init__(self, code: CodeRecord, where: str, hint: str):
        self._code, self._where, self._hint = code, where, hint

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name in self._code:
            file = Path(self._code[name]["file"])
            package = file.name == "__init__.py"
            source = _verified(self._code[name], self._where, self._hint)
            code = compile(source, str(file), "exec", dont_inherit=True)
            spec = ModuleSpec(name, _Compiled(code), origin=str(file), is_package=package)
            spec.has_location = True
            return spec
        if any(each.startswith(f"{name}.") for each in self._code):  # a package without a file
            return ModuleSpec(name, None, is_package=True)
        return None


class _Compiled(Loader):
    def __init__(self, code: CodeType):
        self._code = code

    def exec_module(self, module: ModuleType) -> None:
        exec(self._code, module.__dict__)


def _root(module: str) -> Path | None:
    """The folder from which a module is named."""
    known = loaded_module(module)
    file = None if known is None else source_file(known)
    if known is None or file is None:
        return None
    depth = known.__name__.count(".") + (file.name == "__init__.py")
    return file.parents[depth]


def _with_parents(module: str) -> list[str]:
    known = loaded_module(module) if is_path(module) else None
    words = (known.__name__ if known is not None else module).split(".")
    return [".".join(words[: i + 1]) for i in range(len(words))]


def _file_of(name: str, roots: set[Path]) -> Path | None:
    known = sys.modules.get(name)
    if known is not None:
        return source_file(known)
    for root in roots:  # imported only when it is needed
        for file in (
            root.joinpath(*name.split(".")).with_suffix(".py"),
            root.joinpath(*name.split("."), "__init__.py"),
        ):
            if file.is_file():
                return file.resolve()
    return None


def _is_own(file: Path, name: str, modules: Sequence[str], roots: set[Path]) -> bool:
    if any(part in _INSTALLED for part in file.parts):
        return name.partition(".")[0] in {module.partition(".")[0] for module in modules}
    return any(file.is_relative_to(root) for root in roots)


def _imports(source: bytes, name: str, file: Path) -> Iterator[str]:
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            words = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*(word for word in words if word), *([node.module] if node.module else [])])
            if base:
                yield base
            yield from (f"{base}.{alias.name}" if base else alias.name for alias in node.names if alias.name != "*")


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
