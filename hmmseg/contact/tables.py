"""A decomposition as a table, as the JSON document of `decompose`, and in the paper's notation (Table 1)."""

from __future__ import annotations

import re
from typing import Any

from rich.table import Table

from hmmseg.contact.decompose import (
    FREE,
    FRICTION,
    FRICTION_ON,
    HEIGHT,
    WEIGHT,
    WIDTH,
    Decomposition,
    Evidence,
    Property,
    height_equations,
)
from hmmseg.io.task import BlockTask


def cell(found: Decomposition, index: int, entry: Property, evidence: Evidence) -> str:
    """Signals of subtask `index` that reveal a property; parentheses mark what goes beyond the paper."""
    partners = [str(other + 1) for other in evidence.subtasks if other != index]
    signals = " and ".join(evidence.signals(index)).replace("horizontal forces and", "horizontal and")
    text = (">= " if evidence.bound else "") + signals
    if entry.object != found.subtasks[index].object:
        text = f"{entry.object}: {text}"
    if partners:
        text += f", with {', '.join(partners)}"
    if evidence.condition:
        text += f"; {evidence.condition}"
    return text if found.in_paper(index, entry) else f"({text})"


def equation(found: Decomposition) -> str:
    """The decomposition in the notation of the paper's equation 1: subtask = (state, {properties})."""
    label = _labels(found)
    parts = []
    for subtask in found.subtasks:
        revealed = [
            entry for entry, _ in found.reveals(subtask.index) if found.in_paper(subtask.index, entry)
        ]
        names = [f"{entry.name.replace('_', ' ')} {label[entry.object]}" for entry in revealed]
        subject = (
            subtask.name if subtask.object is None else f"{subtask.name.capitalize()} {label[subtask.object]}"
        )
        state = subtask.state
        if subtask.object is not None and state != FREE:
            state += f" {label[subtask.object]}"
        parts.append(f"{subject} = ({state}, {{{', '.join(names) or '∅'}}})")
    return "T = { " + ",\n      ".join(parts) + " }"


def _labels(found: Decomposition) -> dict[str, str]:
    """Objects by number if their names differ only by it (block1: 1), otherwise by name."""
    numbered = {name: re.fullmatch(r"(.*?)(\d+)", name) for name in found.properties}
    if len({match[1] for match in numbered.values() if match}) == 1 and all(numbered.values()):
        return {name: match[2] for name, match in numbered.items() if match}
    return {name: name for name in numbered}


def decomposition_table(found: Decomposition) -> Table:
    """The paper's Table 1; in parentheses, what the balance gives beyond it."""
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
            "given": [f"{owner}.{name}" for name, owner in evidence.given],
            "condition": evidence.condition}  # fmt: skip
