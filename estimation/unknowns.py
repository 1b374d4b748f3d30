"""What moves that were recorded determine, and what each observation says of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.combinations import Terms, simplest_combinations
from estimation.observations import (
    CHANNELS,
)
from hmmseg.contact.decompose import PROPERTIES
from hmmseg.io.task import BlockTask

FORCE, DISTANCE, RISE = range(len(CHANNELS))


@dataclass(frozen=True)
class Unknown:
    """What the recording determines: a property, or a combination of one property of several objects."""

    prop: str
    terms: Terms

    @property
    def single(self) -> bool:
        """Whether it is a property of one object."""
        return len(self.terms) == 1

    @property
    def properties(self) -> tuple[str, ...]:
        """`object.property` of all that enter."""
        return tuple(f"{obj}.{self.prop}" for obj in self.terms)

    @property
    def name(self) -> tuple[str, str]:
        """(object, property); objects of a combination joined as in `b + c`."""
        text = ""
        for obj, c in self.terms.items():
            sign = " - " if c < 0 else " + "
            text += (sign if text else "") + (obj if abs(c) == 1 else f"{abs(c)} {obj}")
        return text, self.prop


def determined(
    task: BlockTask, objects: Sequence[str], rises: dict[int, Terms], there: np.ndarray
) -> tuple[Unknown, ...]:
    """What the moves recorded in `there` (num_moves, 3) determine, objects in the task's order."""
    names = list(task.objects)
    held = {
        c: {obj for obj, seen in zip(objects, there[:, c], strict=True) if seen} for c in (FORCE, DISTANCE)
    }
    out = []
    recorded = [rises[m] for m, seen in enumerate(there[:, RISE]) if seen]
    heights = simplest_combinations(recorded, names)
    for name in names:
        out += [Unknown("weight", {name: 1})] * (name in held[FORCE])
        out += [Unknown("width", {name: 1})] * (name in held[DISTANCE])
        out += [Unknown("height", {name: 1})] * ({name: 1} in heights)
    return (*out, *(Unknown("height", terms) for terms in heights if len(terms) > 1))


def coefficients_of(
    unknowns: Sequence[Unknown], objects: Sequence[str], rises: dict[int, Terms]
) -> np.ndarray:
    """Coefficients (num_moves, 3, Q) of the unknowns in each observation of a move."""
    out = np.zeros((len(objects), len(CHANNELS), len(unknowns)))
    heights = [i for i, u in enumerate(unknowns) if u.prop == "height"]
    names = list(dict.fromkeys(name for i in heights for name in unknowns[i].terms))
    basis = np.array([[unknowns[i].terms.get(name, 0) for name in names] for i in heights], float)
    for m, obj in enumerate(objects):
        for i, u in enumerate(unknowns):
            if u.single and obj in u.terms and u.prop != "height":
                out[m, PROPERTIES.index(u.prop), i] = 1.0
        if heights and rises[m] and set(rises[m]) <= set(names):
            rise = np.array([rises[m].get(name, 0) for name in names], float)
            solved, *_ = np.linalg.lstsq(basis.T, rise, rcond=None)
            if np.abs(solved @ basis - rise).max() < 1e-9:
                out[m, RISE, heights] = np.where(np.abs(solved) > 1e-9, solved, 0.0)
    return out
