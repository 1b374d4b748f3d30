"""`hmmseg doctor`: versions and folders of the installation, for bug reports."""

import importlib.metadata
import os
import platform
import re
import sys
import tempfile
from typing import Any

from rich.table import Table

import hmmseg
from hmmseg.cache import cache_folder
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output


def doctor(json: opt.Json = None, quiet: opt.Quiet = False) -> None:
    """Versions, extras, caches and JAX's device of this installation, for a report of a fault."""
    with Output("doctor", json=json, quiet=quiet) as out:
        found = examined()
        table = Table(show_header=False, box=None)
        for name, value in found.items():
            lines = [f"{k} {v}" for k, v in value.items()] if isinstance(value, dict) else [str(value)]
            table.add_row(name, "\n".join(lines))
        out.print(table)
        out.finish(found)


def examined() -> dict[str, Any]:
    """Contents of a bug report, by name; None for what is not installed."""
    import jax

    folder = cache_folder()
    programs = os.environ.get("JAX_COMPILATION_CACHE_DIR") or (folder and folder / "programs")
    return {
        "hmmseg": f"{hmmseg.__version__} in {os.path.dirname(hmmseg.__file__)}",
        "python": f"{platform.python_version()} ({sys.executable})",
        "system": f"{platform.platform()}, {os.cpu_count()} processors",
        "device": ", ".join(str(device) for device in jax.devices()),
        "cache": {str(path): _state(path) for path in (folder, programs, tempfile.gettempdir()) if path},
        "packages": _versions(),
    }


def _state(path: Any) -> str:
    """Whether a folder exists and can be written to, and how many files it holds."""
    if not os.path.isdir(path):
        return "not there"
    count = sum(len(files) for _, _, files in os.walk(path))
    return f"{count} files" + ("" if os.access(path, os.W_OK) else ", cannot be written to")


def _versions() -> dict[str, str | None]:
    """Version of each required or optional package."""
    names = {}
    for wanted in importlib.metadata.requires("hmmseg") or ():
        name, _, extra = wanted.partition(";")
        name = re.split(r"[^\w.-]", name.strip(), maxsplit=1)[0]
        if re.search(r"extra == .(dev|docs|bench)", extra) is None and name != "hmmseg":
            names[name] = None
    for name in names:
        try:
            names[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return names
