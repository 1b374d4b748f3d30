"""Task decomposition: from objects and moves to subtasks and the properties each can reveal.

The task is cut at each anticipated change of the active constraint set (states.py); the
quasistatic balance of each contact state then says what that subtask, alone or with another of
the same move, determines (identifiability.py). What no pair determines is sought in all moves
together, as the heights in a tower of three are.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

from hmmseg.contact.decomposition import Decomposition, Evidence, Property, Subtask
from hmmseg.contact.identifiability import (
    FRICTION,
    FRICTION_ON,
    HEIGHT,
    PROPERTIES,
    X_FORCES,
    Y_FORCES,
    Equation,
    Source,
    Unknown,
    balance,
    determined,
    is_property,
)
from hmmseg.contact.states import (
    ABOVE_GROUND,
    FREE,
    ON_GROUND,
    SLIDING,
    ContactState,
    contact_states,
)
from hmmseg.io.task import AnyTask, BlockTask, SequenceTask

VARYING_LOAD = "the vertical force must vary while the object slides"


def subtasks(task: AnyTask) -> tuple[Subtask, ...]:
    """The ordered subtasks of a task."""
    if isinstance(task, SequenceTask):
        return tuple(Subtask(i, name, None, name, None) for i, name in enumerate(task.sequence))
    return _named(list(contact_states(task)))


def _named(states: list[ContactState]) -> tuple[Subtask, ...]:
    named, held = [], False
    for index, state in enumerate(states):
        names = {FREE: "release" if index else "pregrasp", ON_GROUND: "place" if held else "pickup",
                 SLIDING: "slide", ABOVE_GROUND: "carry"}  # fmt: skip
        support = None if state.support is None else state.support.surface
        contacts = tuple(sorted(str(contact) for contact in state.contacts))
        named.append(Subtask(index, names[state.name], state.object, state.name, state.move,
                             support, contacts))  # fmt: skip
        held = state.held
    return tuple(named)


def height_equations(task: BlockTask) -> list[tuple[int, dict[str, int]]]:
    """For each performed move, how far its object's bottom rises, as a sum of object heights.

    Entries are (0-based index of the move, {object: coefficient}): bottom height at place minus
    bottom height at pickup; the paper's height of the block beneath (its Table 3) is the case of
    a single coefficient. A slide rises by nothing: {}.
    """
    states = list(contact_states(task))
    equations = []
    for index in range(len(task.performed)):
        start, _, end = (state for state in states if state.held and state.move == index)
        rise = {name: (name in end.beneath) - (name in start.beneath) for name in task.objects}
        equations.append((index, {name: value for name, value in rise.items() if value}))
    return equations


def decompose(task: AnyTask) -> Decomposition:
    """Subtasks of a task and what each object's properties can be learned from."""
    if isinstance(task, SequenceTask):
        note = "a plain ordered task has no block physics: no properties"
        return Decomposition(task, subtasks(task), notes=(note,))
    states = list(contact_states(task))
    learned = _learn(states)
    properties: dict[str, dict[str, Property]] = {}
    for name in task.objects:
        rubbed = [key for key, owner in learned if owner == name and key.startswith(FRICTION_ON)]
        properties[name] = {}
        for key in (*PROPERTIES, FRICTION, *sorted(set(rubbed))):
            evidence = tuple(sorted(learned.get((key, name), ()), key=_strength))
            reason = None if evidence else _reason(task, states, name, key)
            properties[name][key] = Property(name, key, evidence, reason)
    notes = ()
    if task.repeat == "unknown":
        notes = ("the moves repeat as often as the recording shows; one round is decomposed",)
    return Decomposition(task, _named(states), properties, notes)


def _strength(evidence: Evidence) -> tuple[bool, bool, tuple[int, ...]]:
    return evidence.bound, evidence.condition is not None, evidence.subtasks


def _learn(states: list[ContactState]) -> dict[Unknown, list[Evidence]]:
    """Every way to learn each property, from the contact states in order."""
    learned: dict[Unknown, list[Evidence]] = {}
    moves: dict[object, list[list[int]]] = {}  # moves alike in all contacts determine alike
    for _, group in itertools.groupby((i for i, s in enumerate(states) if s.held), lambda i: states[i].move):
        indices = list(group)
        moves.setdefault(tuple((states[i].contacts, states[i].beneath) for i in indices), []).append(indices)
    for alike in moves.values():
        _learn_within(states, alike, learned)
    equations = [e for alike in moves.values() for i in alike[0] for e in balance(i, states[i])]
    for unknown, row in determined(equations).items():
        if unknown[0] in PROPERTIES:
            learned.setdefault(unknown, [_evidence(row)])
    for alike in moves.values():
        for indices in alike:
            for index in indices:
                _learn_friction(index, states[index], learned)
    return learned


def _learn_within(states: list[ContactState], alike: list[list[int]],
                  learned: dict[Unknown, list[Evidence]]) -> None:  # fmt: skip
    """What one subtask of a move determines alone, and what only two of them do together."""
    first, alone = alike[0], set()
    for size in (1, 2):
        for subset in itertools.combinations(first, size):
            rows = determined(e for i in subset for e in balance(i, states[i]))
            for unknown in filter(is_property, rows):
                if size == 1:
                    alone.add(unknown)
                elif unknown in alone:
                    continue
                for indices in alike:
                    moved = dict(zip(first, indices, strict=True))
                    learned.setdefault(unknown, []).append(_evidence(rows[unknown], moved))


def _learn_friction(index: int, state: ContactState, learned: dict[Unknown, list[Evidence]]) -> None:
    """Coefficients of the contacts of one state: known where the contact's forces are known.

    A fingertip's forces are measured; a support's follow from the balance once the weight is
    given. Slip determines the coefficient, sticking bounds it from below.
    """
    forces = (Source(index, X_FORCES), Source(index, Y_FORCES))
    learned.setdefault((FRICTION, state.object), []).append(Evidence(forces, bound=True))
    if state.support is None:
        return
    friction = (FRICTION_ON + state.support.surface, state.object)
    target = friction if state.support.slips else ("load", str(index), "0")
    equations = balance(index, state)
    known = {unknown for equation in equations for unknown in equation.unknowns
             if any(way.condition is None for way in learned.get(unknown, ()))} - {friction}  # fmt: skip
    if target in determined(equations, known):
        given = tuple(u for u in known if target not in determined(equations, known - {u}))
        learned.setdefault(friction, []).append(Evidence(forces, not state.support.slips, given))
        return
    for unknown, row in determined(balance(index, state, loads=3), known).items():
        if is_property(unknown):
            learned.setdefault(unknown, []).append(_evidence(row, condition=VARYING_LOAD))


def _evidence(row: Equation, moved: dict[int, int] | None = None, condition: str | None = None) -> Evidence:
    sources = {((moved or {}).get(source.subtask, source.subtask), source.signal) for source in row.sources}
    return Evidence(tuple(Source(*source) for source in sorted(sources)), condition=condition)


def _reason(task: BlockTask, states: Iterable[ContactState], name: str, key: str) -> str:
    """Why nothing reveals a property, in plain words."""
    if key == HEIGHT:
        rises = {str(i + 1): rise for i, rise in height_equations(task) if name in rise}
        if not rises:
            return f"no recorded move changes the height at which something rests by {name}'s height"
        move, rise = next(iter(rises.items()))
        others = ", ".join(sorted(set(rise) - {name}))
        return f"move {move} changes heights by {name}'s only together with the height of {others}"
    if not any(state.held and state.object == name for state in states):
        return f"no recorded move grips {name}"
    return f"no recorded move lifts {name} clear of its support"
