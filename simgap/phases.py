"""The phases of manipulation that the equations of the gap distinguish."""

from __future__ import annotations

from enum import IntEnum

from hmmseg.contact.decompose import ABOVE_GROUND, Subtask
from hmmseg.contact.decompose import FREE as FREE_MOTION


class Phase(IntEnum):
    """Phases in the order of one-hot arrays."""

    FREE = 0
    PICKUP = 1
    CARRY = 2
    PLACE = 3
    SLIDE = 4


def phase_of(step: Subtask) -> Phase:
    """The phase of a subtask of blocks."""
    if step.state == FREE_MOTION:
        return Phase.FREE
    return Phase.CARRY if step.state == ABOVE_GROUND else Phase[step.name.upper()]
