"""What a decomposition holds: subtasks in order, and what reveals each property of each object."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

from hmmseg.contact.identifiability import FRICTION, FRICTION_ON, HEIGHT, WEIGHT, WIDTH, Source, Unknown
from hmmseg.contact.states import ABOVE_GROUND, FREE, SLIDING
from hmmseg.io.task import AnyTask
from hmmseg.tables import Tabled


def labelled(subtask: str, obj: str | None) -> str:
    """A subtask with its object, as `carry block1`; by its name alone where it has none."""
    return subtask if obj is None else f"{subtask} {obj}"


@dataclass(frozen=True)
class Subtask:
    """One step of a task: its name, contact state and manipulated object.

    `move` is the 0-based index in `task.performed` of the move it belongs to (None in a plain
    ordered task); a pregrasp belongs to the first move, a release to the move it ends. `support`
    is what the held object touches besides the fingers, None while free or lifted; `constraints`
    are the active contacts of the hand and the held object.
    """

    index: int
    name: str
    object: str | None
    state: str
    move: int | None
    support: str | None = None
    constraints: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """As the interface names it, as `carry block1`."""
        return labelled(self.name, self.object)


@dataclass(frozen=True)
class Evidence:
    """One way to learn a property: the signals of the subtasks that are needed together.

    `bound`: it gives a lower bound only (a friction coefficient without slip). `given` are
    properties, determined elsewhere, that it takes as known. `condition`, where not None, says
    what the recording must show besides.
    """

    sources: tuple[Source, ...]
    bound: bool = False
    given: tuple[Unknown, ...] = ()
    condition: str | None = None

    @property
    def subtasks(self) -> tuple[int, ...]:
        """Indices of the subtasks needed, in order."""
        return tuple(sorted({source.subtask for source in self.sources}))

    def signals(self, subtask: int | None = None) -> tuple[str, ...]:
        """Names of the signals needed, of one subtask or of all."""
        wanted = (s.signal for s in self.sources if subtask in (None, s.subtask))
        return tuple(sorted(set(wanted)))


@dataclass(frozen=True)
class Property:
    """A property of an object: every way to learn it, or the reason why there is none.

    Any one of `evidence` is enough by itself, the strongest first. `name` is weight, width, height,
    friction (of the fingers on the object) or friction_on_SUPPORT.
    """

    object: str
    name: str
    evidence: tuple[Evidence, ...]
    reason: str | None = None

    @property
    def kind(self) -> str | None:
        """ "value", "bound" where only a lower bound can be had, None where nothing can."""
        if not self.evidence:
            return None
        return "bound" if all(evidence.bound for evidence in self.evidence) else "value"


@dataclass(frozen=True, repr=False)
class Decomposition(Tabled):
    """A task's subtasks in order, and for each object's properties what reveals them."""

    task: AnyTask
    subtasks: tuple[Subtask, ...]
    properties: dict[str, dict[str, Property]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def reveals(self, index: int) -> list[tuple[Property, Evidence]]:
        """All that subtask `index` helps to reveal, by its first evidence for each property."""
        found = []
        for entry in (entry for entries in self.properties.values() for entry in entries.values()):
            evidence = next((e for e in entry.evidence if index in e.subtasks), None)
            if evidence is not None:
                found.append((entry, evidence))
        return sorted(found, key=lambda pair: _rank(pair[0].name))

    def in_paper(self, index: int, entry: Property) -> bool:
        """Whether the paper's Table 1 would list the property for this subtask.

        It reads weight and width only while an object is held above the ground, and speaks of
        friction with a support only in sliding contact (its Sections 2.1 and 3.2).
        """
        state = self.subtasks[index].state
        if entry.name in (WEIGHT, WIDTH):
            return state == ABOVE_GROUND
        return state == SLIDING or not entry.name.startswith(FRICTION_ON)

    def minimal(self, wanted: Collection[str] | None = None) -> tuple[Subtask, ...]:
        """The minimal sequence: subtasks that reveal a wanted property name (None: any).

        Free motions stay where a move reveals something, as they delimit it in time.
        """
        if not self.properties:
            return self.subtasks
        revealed = {s.index: [entry.name for entry, _ in self.reveals(s.index)] for s in self.subtasks}
        useful = {
            i for i, names in revealed.items() if names and (wanted is None or set(names) & set(wanted))
        }
        moves = {self.subtasks[index].move for index in useful}
        delimiting = {s.index for s in self.subtasks if s.state == FREE and s.move in moves}
        first = {0} if moves else set()  # delimits whichever move is the first to stay
        return tuple(s for s in self.subtasks if s.index in useful | delimiting | first)

    def to_json(self) -> dict[str, Any]:
        """The body of `decompose`'s JSON document."""
        from hmmseg.contact.tables import decomposition_document

        return decomposition_document(self)

    def tables(self) -> list[Any]:
        """The subtasks and what each reveals."""
        from hmmseg.contact.tables import decomposition_table

        return [decomposition_table(self)]


def _rank(name: str) -> int:
    order = (WEIGHT, WIDTH, HEIGHT, FRICTION)
    return order.index(name) if name in order else len(order)
