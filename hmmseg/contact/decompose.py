"""Task decomposition: from objects and moves to subtasks and the properties each can reveal.

A task is cut at each anticipated change of the active constraint set, whose constraints are those of the
hand and of the object it manipulates: finger on object, object on its support. Each contact state gives
quasistatic equations between measured signals and unknowns (planar statics of a rigid block between two
fingertips). A property is determined when some combination of the equations of a subtask, alone or with
another of the same move, leaves it as the only unknown, which exact elimination finds without tolerances.
What no pair determines is sought in all moves together, as the heights in a tower of three are. A sensor in
the wrist does not feel the grip, so that it reveals less.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from hmmseg.io.task import GROUND, AnyTask, BlockTask, Move, SequenceTask
from hmmseg.tables import Tabled

if TYPE_CHECKING:
    from hmmseg.io.rig import Rig

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


HIDDEN_GRIP = (
    "a wrist sensor does not feel what the fingers press against each other with; grip_force under "
    "[gripper] would tell"
)
TOUCHED = "from the opening at which the pads touch, as what they give under the grip is not measured"


def revealed_by(found: Decomposition, rig: Rig) -> Decomposition:
    """The decomposition as this hand can carry it out: what it cannot reveal is without evidence.

    A fingertip hand reveals all; a gripper with a wrist sensor alone has the sum of both fingers' forces,
    which leaves weight, height and friction on a support as they are.
    """
    if rig.gripper is None or rig.gripper.grip_known:
        return found
    properties = {}
    for obj, entries in found.properties.items():
        kept = dict(entries)
        if FRICTION in kept:
            kept[FRICTION] = replace(kept[FRICTION], evidence=(), reason=HIDDEN_GRIP)
        if WIDTH in kept:
            evidence = tuple(_touched(each) for each in kept[WIDTH].evidence)
            kept[WIDTH] = replace(kept[WIDTH], evidence=evidence)
        properties[obj] = kept
    return replace(found, properties=properties)


def _touched(evidence: Evidence) -> Evidence:
    return evidence if evidence.condition else replace(evidence, condition=TOUCHED)
