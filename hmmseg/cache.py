"""Files kept between runs in the user's cache folder: a convenience, without which everything is recomputed.

A file holds a digest, then its content; whatever else is found there (cut short, garbled, of somebody else)
counts as nothing, is said once and replaced. Values are kept as arrays and JSON, never as code.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import hashlib
import importlib
import io
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # NumPy takes long to import, and light commands need none
    import numpy as np

MAGIC = b"hmmseg cache 1\n"
OWN = ("hmmseg", "estimation", "simgap", "hmmseg_cli")  # packages whose dataclasses are read back
_said: set[Path] = set()


class CacheWarning(UserWarning):
    """A file of the cache was unreadable."""


def cache_folder() -> Path | None:
    """The user's cache folder of this project, which may be yet to be made; None where there is no home."""
    base = os.environ.get("XDG_CACHE_HOME") or ""
    if os.path.isabs(base):  # others are to be ignored, by the specification of these variables
        return Path(base) / "hmmseg"
    try:
        return Path.home() / ".cache" / "hmmseg"
    except RuntimeError:
        return None


def write_whole(path: Path, content: bytes) -> None:
    """Write a file atomically, so that no reader sees half of it; OSError where it fails."""
    handle, beside = tempfile.mkstemp(dir=path.parent, prefix=".hmmseg-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(beside, path)
    except BaseException:
        Path(beside).unlink(missing_ok=True)
        raise


def keep(path: Path | None, content: bytes) -> None:
    """Keep bytes under a path of the cache; where they cannot be written they are not kept."""
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, MAGIC + hashlib.sha256(content).digest() + content)
    except OSError:
        return


def kept(path: Path | None) -> bytes | None:
    """The bytes kept under a path; None where there are none, or not as they were written."""
    if path is None:
        return None
    try:
        found = path.read_bytes()
    except OSError:
        return None
    start = len(MAGIC) + hashlib.sha256().digest_size
    content = found[start:]
    if found[:start] == MAGIC + hashlib.sha256(content).digest():
        return content
    _damaged(path)
    return None


def _damaged(path: Path) -> None:
    """Say so once for a folder, and take the file away."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
    if path.parent not in _said:
        _said.add(path.parent)
        warnings.warn(f"{path}: not as it was written; recomputed", CacheWarning, stacklevel=4)


def keep_value(path: Path | None, value: Any) -> None:
    """Keep a value of numbers, texts, arrays, containers and this project's dataclasses of these.

    TypeError for any other.
    """
    import numpy as np

    arrays: dict[str, np.ndarray] = {}
    tree = _flat(value, arrays, {})
    text = np.frombuffer(json.dumps(tree).encode(), np.uint8)
    file = io.BytesIO()
    np.savez(file, tree=text, **arrays)  # type: ignore[arg-type]
    keep(path, file.getvalue())


def kept_value(path: Path | None) -> Any:
    """The value kept under a path; None where there is none, or not as it was written."""
    import numpy as np

    content = kept(path)
    if content is None or path is None:
        return None
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return _built(json.loads(file["tree"].tobytes()), file, {})
    except Exception:  # whole, and yet nothing that this code writes
        _damaged(path)
        return None


def _flat(value: Any, arrays: dict[str, np.ndarray], seen: dict[int, str]) -> Any:
    """JSON of a value, its arrays put aside under names; one array met twice is kept once."""
    import numpy as np

    kind: Any = type(value)
    if value is None or kind in (bool, int, float, str):
        return value
    if isinstance(value, slice):
        return {"slice": [value.start, value.stop, value.step]}
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biufcUS":
        if id(value) not in seen:
            seen[id(value)] = f"a{len(arrays)}"
            arrays[seen[id(value)]] = np.asarray(value)
        return {"array": seen[id(value)], "scalar": isinstance(value, np.generic)}
    if isinstance(value, list | tuple | set | frozenset) and kind.__module__ == "builtins":
        return {kind.__name__: [_flat(v, arrays, seen) for v in value]}
    name = f"{kind.__module__}:{kind.__qualname__}"
    if isinstance(value, Mapping) and not dataclasses.is_dataclass(value):
        return {"dict": [[_flat(k, arrays, seen), _flat(v, arrays, seen)] for k, v in value.items()]}
    if kind.__module__.partition(".")[0] in OWN:
        if isinstance(value, enum.Enum):
            return {"enum": name, "value": _flat(value.value, arrays, seen)}
        if isinstance(value, tuple):  # named
            return {"named": name, "values": [_flat(v, arrays, seen) for v in value]}
        if dataclasses.is_dataclass(value):
            fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
            return {"made": name, "fields": {k: _flat(v, arrays, seen) for k, v in fields.items()}}
    raise TypeError(f"{name} cannot be kept")


def _built(tree: Any, arrays: Mapping[str, np.ndarray], seen: dict[str, np.ndarray]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        found = seen.setdefault(tree["array"], arrays[tree["array"]])
        return found[()] if tree["scalar"] else found
    if "dict" in tree:
        return {_built(k, arrays, seen): _built(v, arrays, seen) for k, v in tree["dict"]}
    for kind in (list, tuple, set, frozenset):
        if kind.__name__ in tree:
            return kind(_built(v, arrays, seen) for v in tree[kind.__name__])
    if "slice" in tree:
        return slice(*tree["slice"])
    if "enum" in tree:
        return _own(tree["enum"], enum.Enum)(_built(tree["value"], arrays, seen))
    if "named" in tree:
        return _own(tree["named"], tuple)(*(_built(v, arrays, seen) for v in tree["values"]))
    cls = _own(tree["made"], object)
    if {f.name for f in dataclasses.fields(cls)} != tree["fields"].keys():
        raise ValueError(f"{cls} has other fields")
    made = object.__new__(cls)
    for name, value in tree["fields"].items():
        object.__setattr__(made, name, _built(value, arrays, seen))
    return made


def _own(name: str, base: type) -> Any:
    """A class of this project by its name; nothing else is ever made from a file."""
    module, _, path = name.partition(":")
    if module.partition(".")[0] not in OWN:
        raise ValueError(f"{module} is not of this project")
    found: Any = sys.modules.get(module) or importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ValueError(f"{name} is no class of this kind")
    return found
