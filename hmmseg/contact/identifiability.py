"""Which properties a set of contact states can reveal: balances, and what they determine.

Each contact state gives quasistatic equations between measured signals and unknowns (planar
statics of a rigid block between two fingertips). A property is determined when some combination
of the equations leaves it as the only unknown, which exact elimination finds without tolerances.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction

from hmmseg.contact.states import FINGERS, ContactState

WEIGHT, WIDTH, HEIGHT, FRICTION = "weight", "width", "height", "friction"
FRICTION_ON = "friction_on_"  # + the support's name: of the object against what it stands on

X_POSITIONS, Y_POSITIONS = "horizontal positions", "vertical positions"
X_FORCES, Y_FORCES = "horizontal forces", "vertical forces"

Unknown = tuple[str, ...]  # ("weight", object), or a nuisance such as ("load", subtask, sample)
UNITS = {WEIGHT: "N", WIDTH: "m", HEIGHT: "m"}  # of what an object has by itself
PROPERTIES = tuple(UNITS)


@dataclass(frozen=True)
class Source:
    """A signal measured during a subtask (its index); `sample` counts the loads it was read at."""

    subtask: int
    signal: str
    sample: int = 0


@dataclass(frozen=True)
class Equation:
    """sum(unknowns) = sum(sources), each with a rational coefficient."""

    unknowns: dict[Unknown, Fraction]
    sources: dict[Source, Fraction]

    def minus(self, factor: Fraction, other: Equation) -> Equation:
        """This equation less `factor` times another."""
        return Equation(_minus(self.unknowns, factor, other.unknowns),
                        _minus(self.sources, factor, other.sources))  # fmt: skip


def _minus(a: dict, factor: Fraction, b: dict) -> dict:
    difference = {key: a.get(key, Fraction(0)) - factor * b.get(key, Fraction(0)) for key in a | b}
    return {key: value for key, value in difference.items() if value}


def is_property(unknown: Unknown) -> bool:
    """Whether an unknown is a property of an object, not a nuisance of one moment."""
    return unknown[0] in PROPERTIES or unknown[0].startswith(FRICTION_ON)


def balance(index: int, state: ContactState, loads: int = 1) -> list[Equation]:
    """Quasistatic equations of subtask `index`, at `loads` different vertical forces.

    Geometry: the fingers' distance is the width; each finger is as high as the object's bottom
    plus where it grips, which stays the same throughout one move. Forces: the fingers' net
    vertical force is the weight less the support's load, their net horizontal force is the
    support's push. Slipping: push = friction x load (Coulomb), linearised about given loads;
    their values are arbitrary, distinct numbers, as only rank matters.
    """
    if not state.held:
        return []
    name, support, grasp = state.object, state.support, str(state.move)
    bottom: list[Unknown] = [(HEIGHT, below) for below in state.beneath]
    if support is None:
        bottom = [("lift", str(index))]
    equations = [_equation(index, X_POSITIONS, {(WIDTH, name): 1})]
    for finger in FINGERS:
        equations.append(_equation(index, Y_POSITIONS, dict.fromkeys([*bottom, ("grip", finger, grasp)], 1)))
    if support is None:
        return [*equations, _equation(index, Y_FORCES, {(WEIGHT, name): 1})]
    for sample in range(loads):
        load, push = ("load", str(index), str(sample)), ("push", str(index), str(sample))
        equations.append(_equation(index, Y_FORCES, {(WEIGHT, name): 1, load: -1}, sample))
        equations.append(_equation(index, X_FORCES, {push: 1}, sample))
        if support.slips:
            friction = (FRICTION_ON + support.surface, name)
            slip = {push: Fraction(1), load: Fraction(-1, 3), friction: Fraction(-sample - 2)}
            equations.append(Equation(slip, {}))
    return equations


def _equation(index: int, signal: str, unknowns: dict[Unknown, int], sample: int = 0) -> Equation:
    return Equation({key: Fraction(value) for key, value in unknowns.items()},
                    {Source(index, signal, sample): Fraction(1)})  # fmt: skip


def determined(equations: Iterable[Equation], known: Iterable[Unknown] = ()) -> dict[Unknown, Equation]:
    """Unknowns that the equations determine, each with the combination that does.

    Reduced row echelon form: an unknown is in the row space on its own exactly when its pivot
    row holds nothing else. `known` unknowns are taken as given.
    """
    given = set(known)
    pivots: dict[Unknown, Equation] = {}
    for equation in equations:
        left = {key: value for key, value in equation.unknowns.items() if key not in given}
        row = Equation(left, equation.sources)
        for unknown in [key for key in row.unknowns if key in pivots]:
            row = row.minus(row.unknowns[unknown], pivots[unknown])
        if not row.unknowns:
            continue  # depends on the others: a check on the data, no information
        pivot = min(row.unknowns, key=is_property)  # nuisances go first
        row = Equation({}, {}).minus(-1 / row.unknowns[pivot], row)
        for other, old in pivots.items():
            if pivot in old.unknowns:
                pivots[other] = old.minus(old.unknowns[pivot], row)
        pivots[pivot] = row
    return {unknown: row for unknown, row in pivots.items() if len(row.unknowns) == 1}
