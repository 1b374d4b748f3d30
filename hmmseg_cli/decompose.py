"""`hmmseg decompose`: a task's subtasks, and the properties and signals each can reveal."""

from __future__ import annotations

from typing import Any

from hmmseg_cli import options as opt
from hmmseg_cli.console import Output


def decompose(
    task: opt.TaskArgument, json: opt.Json = None, seed: opt.UnusedSeed = 0, quiet: opt.Quiet = False
) -> None:
    """Subtasks, contact states, and the properties and signals each can reveal."""
    from hmmseg.contact.decompose import decompose as decompose_task
    from hmmseg.io.task import read_task

    with Output("decompose", json=json, seed=seed, quiet=quiet) as out:
        found = decompose_task(read_task(task))
        out.print(*in_words(found), *found.tables(), found.equation())
        for note in (*found.notes, *(f"{key}: {reason}" for key, reason in found.reasons.items())):
            out.print(note)
        out.finish({"task": str(task), **found.to_json()})


def in_words(found: Any) -> list[str]:
    """Of every object, which subtasks reveal what."""
    lines = []
    for name, known in found.properties.items():
        parts = []
        for prop, entry in known.items():
            seen = dict.fromkeys(found.subtasks[k].label for one in entry.evidence[:1] for k in one.subtasks)
            if seen:
                parts.append(f"{prop.replace('_', ' ')} in {' and '.join(seen)}")
        lines.append(f"{name}: {'; '.join(parts) or 'nothing is revealed'}.")
    return lines
