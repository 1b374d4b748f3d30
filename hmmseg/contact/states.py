"""Contact states of a block task: its moves as a sequence of active constraint sets.

The constraints that matter are those of the hand and of the object it manipulates: finger on
object, object on its support. A task is cut at each anticipated change of that set.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from hmmseg.io.task import GROUND, BlockTask, Move

FREE = "free-motion"
ON_GROUND = "hold-on-ground"
SLIDING = "sliding-on-ground"
ABOVE_GROUND = "hold-above-ground"
FINGERS = ("finger1", "finger2")


@dataclass(frozen=True)
class Contact:
    """One active constraint: `body` touches `surface`; `slips` where it moves along it."""

    body: str
    surface: str
    slips: bool = False

    def __str__(self) -> str:
        return f"{self.body}-{self.surface}" + (" (slipping)" if self.slips else "")


@dataclass(frozen=True)
class ContactState:
    """The active constraints of the hand and the manipulated object between two changes.

    `beneath` are the objects from the manipulated object's support down to the ground (empty
    where it stands on the ground, or is not held). `move` is the 0-based index of the move.
    """

    object: str
    contacts: frozenset[Contact]
    beneath: tuple[str, ...]
    move: int

    @property
    def held(self) -> bool:
        """Whether the fingers are on the object."""
        return any(contact.body in FINGERS for contact in self.contacts)

    @property
    def support(self) -> Contact | None:
        """The contact of the held object with what it stands on, None while free or lifted."""
        return next((contact for contact in self.contacts if contact.body == self.object), None)

    @property
    def name(self) -> str:
        """The contact state's name; the paper calls every support the ground."""
        if not self.held:
            return FREE
        if self.support is None:
            return ABOVE_GROUND
        return SLIDING if self.support.slips else ON_GROUND


def stack(support: dict[str, str], name: str) -> tuple[str, ...]:
    """Objects from what `name` stands on down to the ground, nearest first."""
    beneath, below = [], support[name]
    while below != GROUND:
        beneath.append(below)
        below = support[below]
    return tuple(beneath)


def contact_states(task: BlockTask) -> Iterator[ContactState]:
    """The task's contact states in order, one between every two changes of the constraint set.

    The hand closes on the object, breaks or slips its support contact, restores one at the
    destination, and opens; each is a set of contacts made and lost.
    """
    support = dict(task.initial)
    yield ContactState(task.performed[0].object, frozenset(), (), 0)
    for index, move in enumerate(task.performed):
        active: frozenset[Contact] = frozenset()
        for made, lost in _changes(move, support[move.object]):
            active = (active - lost) | made
            if Contact(move.object, move.to) in made:
                support[move.object] = move.to
            standing = any(contact.body == move.object for contact in active)
            beneath = stack(support, move.object) if standing else ()
            yield ContactState(move.object, active, beneath, index)


def _changes(move: Move, origin: str) -> list[tuple[frozenset[Contact], frozenset[Contact]]]:
    """Contacts (made, lost) at each event of a move, from closing to opening the hand.

    The support contact becomes one of the hand's own constraints once the hand holds the object.
    """
    fingers = frozenset(Contact(finger, move.object) for finger in FINGERS)
    start, end = Contact(move.object, origin), Contact(move.object, move.to)
    none: frozenset[Contact] = frozenset()
    moving = frozenset({Contact(move.object, origin, slips=True)}) if move.slide else none
    return [
        (fingers | {start}, none),
        (moving, frozenset({start})),
        (frozenset({end}), moving),
        (none, fingers | {end}),
    ]
