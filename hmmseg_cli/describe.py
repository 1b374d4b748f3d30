"""`hmmseg decompose` and `hmmseg effects`: what a task reveals, and what may cause a sim-to-real gap."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

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
