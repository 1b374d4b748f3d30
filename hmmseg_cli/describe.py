"""`hmmseg decompose`, `effects`, `doctor`: what a task reveals, what may cause a gap, what is installed."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import sys
import tempfile
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rich.table import Table

import hmmseg
from hmmseg.cache import cache_folder
from hmmseg.contact.decompose import decompose as decompose_task
from hmmseg.io.task import read_task
from hmmseg.tables import listed
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output

if TYPE_CHECKING:
    from simgap.effects.base import HandEffect


def decompose(
    task: opt.TaskArgument, json: opt.Json = None, seed: opt.UnusedSeed = 0, quiet: opt.Quiet = False
) -> None:
    """Subtasks, contact states, and the properties and signals each can reveal."""
    with Output("decompose", json=json, seed=seed, quiet=quiet) as out:
        found = decompose_task(read_task(task))
        out.print(*in_words(found), *found.tables(), found.equation())
        for note in (*found.notes, *(f"{key}: {reason}" for key, reason in found.reasons.items())):
            out.print(note)
        out.finish({"task": str(task), **found.to_json()})


def in_words(found: Any) -> list[str]:
    """For each object, which subtasks reveal which property."""
    lines = []
    for name, known in found.properties.items():
        parts = []
        for prop, entry in known.items():
            seen = dict.fromkeys(found.subtasks[k].label for one in entry.evidence[:1] for k in one.subtasks)
            if seen:
                parts.append(f"{prop.replace('_', ' ')} in {' and '.join(seen)}")
        lines.append(f"{name}: {'; '.join(parts) or 'nothing is revealed'}.")
    return lines


def effects(json: opt.Json = None, seed: opt.UnusedSeed = 0, quiet: opt.Quiet = False) -> None:
    """The candidate effects, their parameters, priors and signatures."""
    with Output("effects", json=json, seed=seed, quiet=quiet) as out:
        from simgap.effects import catalogue

        rows = [description(effect) for effect in catalogue().values()]
        heads = ("effect", "acts on", "says", "shows in", "parameters (prior sd)")
        keys = ("name", "acts_on", "says", "signature")
        cells = [[*(row[k] for k in keys), ", ".join(map(prior, row["parameters"]))] for row in rows]
        out.print(listed("candidate effects", heads, cells, wraps=True))
        out.finish({"effects": rows})


def description(effect: HandEffect) -> dict[str, Any]:
    """An effect as JSON: priors are normal in the parameter, or in its logarithm."""
    parameters = [
        {"name": p.name, "unit": p.unit, "starts": list(p.starts) or [p.nominal],
         "prior": {"kind": "log-normal" if p.log else "normal", "centre": p.nominal, "sd": p.sd,
                   "low": p.low, "high": p.high}}
        for p in effect.parameters.values() if not p.hidden
    ]  # fmt: skip
    return {
        "name": effect.name, "acts_on": effect.acts_on, "says": effect.says, "signature": effect.shows,
        "mistaken_for": list(effect.mistaken_for), "chosen": effect.chosen, "parameters": parameters,
    }  # fmt: skip


def prior(parameter: Mapping[str, Any]) -> str:
    """A parameter with its prior's standard deviation."""
    kind, sd = parameter["prior"]["kind"], parameter["prior"]["sd"]
    return f"{parameter['name']} ({sd:g} {parameter['unit'] if kind == 'normal' else 'in ln'})"


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
    names = dict[str, str | None]()
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
