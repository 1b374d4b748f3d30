"""A decomposition as the paper prints it: the cells of its Table 1 and its equation 1."""

from __future__ import annotations

import re

from hmmseg.contact.decomposition import Decomposition, Evidence, Property
from hmmseg.contact.states import FREE


def cell(found: Decomposition, index: int, entry: Property, evidence: Evidence) -> str:
    """Signals that subtask `index` gives towards a property; in parentheses what goes beyond the paper."""
    partners = [str(other + 1) for other in evidence.subtasks if other != index]
    text = (">= " if evidence.bound else "") + _signals(evidence.signals(index))
    if entry.object != found.subtasks[index].object:
        text = f"{entry.object}: {text}"
    if partners:
        text += f", with {', '.join(partners)}"
    if evidence.condition:
        text += f"; {evidence.condition}"
    return text if found.in_paper(index, entry) else f"({text})"


def _signals(names: tuple[str, ...]) -> str:
    both = names == ("horizontal forces", "vertical forces")
    return "horizontal and vertical forces" if both else " and ".join(names)


def equation(found: Decomposition) -> str:
    """The decomposition as the paper's equation 1 writes it: subtask = (state, {properties})."""
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
    """Objects by their number alone where all are named alike (block1: 1), else by name."""
    numbered = {name: re.fullmatch(r"(.*?)(\d+)", name) for name in found.properties}
    if len({match[1] for match in numbered.values() if match}) == 1 and all(numbered.values()):
        return {name: match[2] for name, match in numbered.items() if match}
    return {name: name for name in numbered}
