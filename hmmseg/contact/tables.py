"""A decomposition as a table for people and as the document of `decompose`."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from hmmseg.contact.decompose import height_equations
from hmmseg.contact.decomposition import Decomposition, Evidence, Property
from hmmseg.contact.identifiability import FRICTION, FRICTION_ON, HEIGHT, WEIGHT, WIDTH, Unknown
from hmmseg.contact.notation import cell, equation
from hmmseg.io.task import BlockTask


def decomposition_table(found: Decomposition) -> Table:
    """The paper's Table 1; in parentheses what the balance gives beyond it."""
    columns = [WEIGHT, WIDTH, HEIGHT, FRICTION]
    if any(name.startswith(FRICTION_ON) for entries in found.properties.values() for name in entries):
        columns.append(FRICTION_ON)
    if not found.properties:
        columns = []
    heads = {FRICTION: "Friction of fingers", FRICTION_ON: "Friction on support"}
    caption = "Parentheses: derivable, though not in the paper's table. >=: a lower bound."
    table = Table(caption=caption if columns else None, show_lines=bool(columns))
    for head in ("", "Subtask", "State"):
        table.add_column(head, no_wrap=True)
    for column in columns:
        table.add_column(heads.get(column, column.capitalize()))
    for subtask in found.subtasks:
        cells = {column: "" for column in columns}
        for entry, evidence in found.reveals(subtask.index):
            column = FRICTION_ON if entry.name.startswith(FRICTION_ON) else entry.name
            cells[column] = cell(found, subtask.index, entry, evidence)
        table.add_row(str(subtask.index + 1), subtask.label, subtask.state, *cells.values())
    return table


def reasons(found: Decomposition) -> dict[str, str]:
    """Why a property cannot be revealed, by `object.property`."""
    entries = (entry for entries in found.properties.values() for entry in entries.values())
    return {f"{entry.object}.{entry.name}": entry.reason for entry in entries if entry.reason is not None}


def decomposition_document(found: Decomposition) -> dict[str, Any]:
    """The body of `decompose`'s JSON document."""
    task = found.task
    document: dict[str, Any] = {
        "subtasks": [
            {
                "index": subtask.index,
                "subtask": subtask.name,
                "object": subtask.object,
                "state": subtask.state,
                "move": None if subtask.move is None else subtask.move + 1,
                "support": subtask.support,
                "constraints": subtask.constraints,
                "properties": [
                    {"property": f"{entry.object}.{entry.name}",
                     "signals": evidence.signals(subtask.index),
                     "with": [other for other in evidence.subtasks if other != subtask.index],
                     **_terms(evidence),
                     "in_paper": found.in_paper(subtask.index, entry)}
                    for entry, evidence in found.reveals(subtask.index)
                ],
            }
            for subtask in found.subtasks
        ],
        "minimal": [subtask.index for subtask in found.minimal()],
        "equation": equation(found),
        "properties": {
            name: {key: _property(entry) for key, entry in entries.items()}
            for name, entries in found.properties.items()
        },
        "reasons": reasons(found),
        "notes": found.notes,
    }  # fmt: skip
    if isinstance(task, BlockTask):
        document["height_equations"] = [
            {"move": index + 1, "rise": rise} for index, rise in height_equations(task)
        ]
        document["repeat"] = task.repeat
    return document


def _property(entry: Property) -> dict[str, Any] | None:
    if entry.kind is None:
        return None
    ways = [{"subtasks": way.subtasks, "signals": way.signals(), **_terms(way)} for way in entry.evidence]
    return {"kind": entry.kind, "evidence": ways}


def _terms(evidence: Evidence) -> dict[str, Any]:
    return {"kind": "bound" if evidence.bound else "value",
            "given": [_key(unknown) for unknown in evidence.given],
            "condition": evidence.condition}  # fmt: skip


def _key(unknown: Unknown) -> str:
    name, owner = unknown
    return f"{owner}.{name}"
