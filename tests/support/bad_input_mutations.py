"""What can be wrong with a file or an option, by kinds; each mutation is drawn from a seeded generator."""

from __future__ import annotations

import copy
import hashlib
import json
import os
import pickle
import random
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

ESCAPE = "\x1b[31mred\x1b[0m\a\u202e"
LINES = "elbow\nrun: forged\nwarning: forged\r\u2028error: forged"
"""A name that would begin lines of its own."""
CODE = 'x"""\nopen("forged", "w")\n"""'
"""A name that would be code in a docstring."""
WRONG_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1e308, -1e308, 10**400, 3.5, "", "x", "\0", ESCAPE, "\ud800", "é→×", "../../../etc", [], {},
    LINES, CODE, "'+open('forged','w')+'", [None], {"a": None}, [[]], ["x"], {"all": "x"}, "trap:Effect", "trap:Task",
)  # fmt: skip
WRONG_NUMBERS = (float("nan"), float("inf"), -float("inf"))


class Trap:
    """Pickled, it says when it is loaded."""

    def __init__(self, marker: Path):
        self.marker = str(marker)

    def __reduce__(self) -> tuple:
        return os.system, (f"echo unpickled >> {self.marker}",)


def mutate_tree(tree: Any, rng: random.Random) -> tuple[Any, str]:
    """One place of a nested structure removed, renamed, replaced or wrapped; what was done, in words."""
    tree = copy.deepcopy(tree)
    places = list(_places(tree))
    if not places:
        return rng.choice(WRONG_VALUES), "another value"
    depth = rng.choice((1, 1, 2, 3, 9))  # the keys at the top are the ones that matter most
    holder, key, path = rng.choice([p for p in places if len(p[2]) <= depth])
    where = "/".join(map(str, path))
    kind = rng.choice(("remove", "replace", "replace", "replace", "rename", "wrap", "nan"))
    if kind == "remove":
        del holder[key]
    elif kind == "rename" and isinstance(holder, dict):
        holder[f"{key}_"] = holder.pop(key)
    elif kind == "wrap":
        holder[key] = [holder[key]]
    elif kind == "nan":
        holder[key] = rng.choice(WRONG_NUMBERS)
    else:
        holder[key] = rng.choice(WRONG_VALUES)
        kind = f"replace by {holder[key]!r:.30}"
    return tree, f"{where}: {kind}"


def _places(tree: Any, path: tuple = ()) -> Any:
    if isinstance(tree, dict | list):
        for key in list(tree) if isinstance(tree, dict) else range(min(len(tree), 4)):
            here = (*path, key)
            yield tree, key, here
            yield from _places(tree[key], here)


def mutate_array(array: np.ndarray, rng: random.Random) -> tuple[Any, str]:
    """Another shape, type or value."""
    array = np.atleast_1d(array)
    kinds: dict[str, Callable[[], Any]] = {
        "scalar": lambda: np.array(1.0),
        "no samples": lambda: array[:0],
        "one sample": lambda: array[:1],
        "fewer samples": lambda: array[:-3],
        "one more axis": lambda: array[None],
        "flat": lambda: array.reshape(-1),
        "text": lambda: np.array("x"),
        "whole numbers": lambda: np.nan_to_num(array).astype(np.int64) if array.dtype.kind in "fiub" else array[:0],
        "complex": lambda: array.astype(complex) if array.dtype.kind in "fiub" else np.array(1j),
        "nan": lambda: np.full(array.shape, np.nan),
        "1e160": lambda: np.full(array.shape, 1e160),
        "single nan": lambda: _with_nan(array),
        "backwards": lambda: array[::-1].copy() if array.ndim else array,
        "dates": lambda: np.array(["2020-01-01"], dtype="datetime64[s]"),
    }
    kind = rng.choice(list(kinds))
    return kinds[kind](), kind


def _with_nan(array: np.ndarray) -> np.ndarray:
    result = np.array(array, dtype=float) if array.dtype.kind in "fiub" else np.zeros(3)
    if result.size:
        result.reshape(-1)[result.size // 2] = np.nan
    return result


def mutate_bytes(path: Path, rng: random.Random, marker: Path) -> str:
    """Damage that no format is spared."""
    data = path.read_bytes()
    kinds: dict[str, Callable[[], Any]] = {
        "empty": lambda: path.write_bytes(b""),
        "truncated": lambda: path.write_bytes(data[: rng.randrange(len(data))]),
        "last byte gone": lambda: path.write_bytes(data[:-1]),
        "bits flipped": lambda: path.write_bytes(_flip(data, rng)),
        "noise": lambda: path.write_bytes(rng.randbytes(500)),
        "a picture": lambda: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(200)),
        "undecodable": lambda: path.write_bytes(b"\xff\xfe\x80" + data),
        "nested brackets": lambda: path.write_bytes(b"[" * 200_000),
        "nested objects": lambda: path.write_bytes(b'{"version":' * 60_000),
        "null": lambda: path.write_bytes(b"null"),
        "a list": lambda: path.write_bytes(b"[1, 2]"),
        "an empty object": lambda: path.write_bytes(b"{}"),
        "a string": lambda: path.write_bytes(b'"x"'),
        "a long number": lambda: path.write_bytes(b"1" * 6000),
        "another archive": lambda: _archive(path),
        "a pickle": lambda: path.write_bytes(pickle.dumps({"version": 1, "task": Trap(marker)})),
        "a saved trap": lambda: torch.save({"model": Trap(marker), "time": Trap(marker)}, path),
        "gone": lambda: path.unlink(),
        "a folder": lambda: (path.unlink(), path.mkdir()),
        "a loop of links": lambda: (path.unlink(), path.symlink_to(path.name)),
        "endless zeros": lambda: (path.unlink(), path.symlink_to("/dev/zero")),
        "a pipe": lambda: (path.unlink(), os.mkfifo(path)),
    }
    kind = rng.choice(list(kinds))
    kinds[kind]()
    return kind


def _flip(data: bytes, rng: random.Random) -> bytes:
    result = bytearray(data)
    for _ in range(1 + len(data) // 500):
        result[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(result)


def _archive(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.txt", "foreign")


def mutate_file(path: Path, rng: random.Random, marker: Path) -> str:
    """Damage a file, most often in the way of its own format; returns what was done."""
    if rng.random() < 0.35:
        return mutate_bytes(path, rng, marker)
    suffix = path.suffix
    if suffix == ".json":
        tree = json.loads(path.read_text())
        if "environment" in tree and rng.random() < 0.15:
            return _forge(path, tree, rng)
        tree, what = mutate_tree(tree, rng)
        path.write_text(json.dumps(tree))
        return what
    if suffix == ".pt":
        return _mutate_tensors(path, rng, marker)
    if suffix == ".npz":
        return _mutate_npz(path, rng)
    if suffix == ".parquet":
        if rng.random() < 0.5:
            path.write_bytes(path.with_name("rows.bin").read_bytes())
            return "3e8 rows"
        return mutate_bytes(path, rng, marker)
    if suffix == ".mjb":
        return mutate_bytes(path, rng, marker)
    if suffix == ".xml" and rng.random() < 0.15:
        return _oversize(path, rng)
    return _mutate_text(path, rng)


def _oversize(path: Path, rng: random.Random) -> str:
    """A model that takes too long, or too much memory."""
    kinds = {
        "replicate": ("<body name=", '<replicate count="100000000"><geom size="0.1"/></replicate><body name='),
        "nuserdata": ("<worldbody>", '<size nuserdata="2000000000"/><worldbody>'),
        "memory": ("<worldbody>", '<size memory="500G"/><worldbody>'),
    }
    kind = rng.choice(list(kinds))
    path.write_text(path.read_text().replace(*kinds[kind], 1))
    return kind


FORGED = "a forged record"


def _forge(path: Path, tree: dict[str, Any], rng: random.Random) -> str:
    """A record that fits code which nobody named: the file's own folder brings the code and its digest along."""
    code = path.parent / "helper.py"
    code.write_bytes((_folder_of_trap(path) / "trap.py").read_bytes())
    name = rng.choice(("helper", str(code), "trap"))
    file = str(code) if rng.random() < 0.5 else os.path.relpath(code, _folder_of_trap(path))
    record = {"file": file, "sha256": hashlib.sha256(code.read_bytes()).hexdigest()}
    tree["environment"] = {**tree["environment"], "module": name, "code": {name: record}}
    where = tree.get("settings", tree)
    where["effects"] = [f"{name}:Effect"]
    if rng.random() < 0.5:
        where["task"] = tree["environment"]["task"] = f"{name}:Task"
    path.write_text(json.dumps(tree))
    store = _folder_of_trap(path) / "~" / ".local" / "state" / "pace" / "named_code.txt"  # where HOME is not set
    store.parent.mkdir(parents=True, mode=0o700)
    store.write_text(f"{record['sha256']}\n")
    return f"{FORGED} of {name}"


def _folder_of_trap(path: Path) -> Path:
    return next(folder for folder in path.parents if (folder / "trap.py").exists())


def _mutate_tensors(path: Path, rng: random.Random, marker: Path) -> str:
    content = torch.load(path, weights_only=False)
    kind = rng.choice(("tree", "tree", "tensor", "tensor", "strided", "trap", "bare"))
    if kind == "bare":
        torch.save(torch.zeros(3), path)
        return "a bare tensor"
    if isinstance(content, torch.Tensor):
        changed, what = mutate_array(content.numpy(), rng)
        torch.save(torch.from_numpy(np.ascontiguousarray(changed)) if changed.dtype.kind in "fiubc" else "x", path)
        return what
    if kind == "tree":
        tree, what = mutate_tree(content, rng)
        torch.save(tree, path)
        return what
    tensors = [place for place in _places(content) if isinstance(place[0][place[1]], torch.Tensor)]
    holder, key, where = rng.choice(tensors)
    what = kind
    if kind == "trap":
        holder[key] = Trap(marker)
    elif kind == "strided":
        holder[key] = torch.zeros(1, dtype=torch.float64).expand(10**6, 10**6)
    else:
        changed, what = mutate_array(holder[key].numpy(), rng)
        holder[key] = torch.from_numpy(np.ascontiguousarray(changed)) if changed.dtype.kind in "fiubc" else "x"
    torch.save(content, path)
    return f"{'/'.join(map(str, where))}: {what}"


def _mutate_npz(path: Path, rng: random.Random) -> str:
    with np.load(path, allow_pickle=False) as archive:
        content = dict(archive)
    key = rng.choice(list(content))
    kind = rng.choice(("remove", "change", "change", "change", "rename", "objects", "bomb"))
    if kind == "remove":
        del content[key]
    elif kind == "rename":
        content[f"{key}_{ESCAPE}"] = content.pop(key)
    elif kind == "objects":
        content[key] = np.array([{}], dtype=object)
    elif kind == "bomb":
        return _bomb(path, key)
    else:
        content[key], kind = mutate_array(content[key], rng)
    np.savez(path, **content)
    return f"{key}: {kind}"


def _bomb(path: Path, key: str) -> str:
    """An array that says that it has 8 TB."""
    with zipfile.ZipFile(path, "a", compression=zipfile.ZIP_DEFLATED) as archive, archive.open(f"{key}.npy", "w") as f:
        np.lib.format.write_array_header_1_0(f, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 1)})
        f.write(bytes(10**6))
    return f"{key}: an array of 8 TB"


def _mutate_text(path: Path, rng: random.Random) -> str:
    """CSV or MJCF: a word replaced, a line removed, repeated or cut."""
    lines = path.read_text().splitlines(keepends=True)
    row = rng.choice((0, rng.randrange(len(lines))))
    kind = rng.choice(("remove", "repeat", "cut", "word", "word", "word"))
    if kind == "remove":
        del lines[row]
    elif kind == "repeat":
        lines.insert(row, lines[row])
    elif kind == "cut":
        lines[row] = lines[row][: len(lines[row]) // 2] + "\n"
    else:
        marks = ',"=<>/ \n'
        starts = [i for i in range(1, len(lines[row])) if lines[row][i - 1] in marks and lines[row][i] not in marks]
        start = rng.choice(starts or [0])
        end = next((i for i in range(start, len(lines[row])) if lines[row][i] in marks), len(lines[row]))
        word = rng.choice(
            (
                "",
                "nan",
                "inf",
                "-1",
                "1e400",
                "x",
                ESCAPE,
                "1e160",
                "0",
                "é",
                "1;2",
                "\0",
                "elbow&#10;run: forged&#10;warning: forged",
                f'"{LINES}"',
                CODE.replace('"', "&quot;"),
            )
        )
        lines[row] = lines[row][:start] + word + lines[row][end:]
        kind = f"a word by {word!r}"
    path.write_text("".join(lines))
    return f"line {row}: {kind}"


WRONG_WORDS = (
    "", "nan", "inf", "-1", "0", "1e99", "-1e99", "99999999999999999999", "1000000000", "0.3", "abc", ESCAPE, "\udcff",
    "é→×", "/dev/null", "/dev/full", "/proc/self/mem", ".", "..", "/", "runs", "loop", "pipe.npz", "none.npz",
    "a" * 5000, LINES, CODE,
    "trap:Effect", "trap:Task", "@", "/@shared", "(", "[", "=", "a=b", "friction/elbow=nan", "arm.xml", "a.npz",
    "a.npz/x.npz", "closed/x.npz", "a.npz\n", "--", "-", "$(touch executed)", "None", "pace_envs:Arm-v0", "os:x",
)  # fmt: skip
"""What can be wrong with an option's value."""
