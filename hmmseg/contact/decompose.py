"""Task decomposition: from objects and moves to subtasks, and the properties each can reveal.

A task is divided at each expected change of the active constraint set: the contacts of the fingers with the
manipulated object, and of the object with its support. Each contact state gives quasistatic equations between
measured signals and unknowns (planar statics of a rigid block between two fingertips). A property is
determined if some combination of the equations of one subtask, or of two of the same move, isolates it as the
only unknown, which exact elimination finds without tolerances. Properties that no pair determines are sought
in all moves together, such as the heights in a tower of three.
"""

import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, TypeVar

from hmmseg.io.task import GROUND, AnyTask, BlockTask, SequenceTask
from hmmseg.tables import Tabled

FREE = "free-motion"
ON_GROUND = "hold-on-ground"
SLIDING = "sliding-on-ground"
ABOVE_GROUND = "hold-above-ground"
FINGERS = ("finger1", "finger2")


@dataclass(frozen=True)
class Subtask:
    """One step of a task, between two changes of the active constraints of the hand and its object."""

    index: int
    name: str
    object: str | None
    state: str  # the contact state; every support is called ground, as in the paper
    # 0-based, in `task.performed`; a pregrasp is of the first, a release of the move it ends
    move: int | None
    support: str | None = None  # what the held object touches besides the fingers
    beneath: tuple[str, ...] = ()  # objects from the support down to the ground

    @property
    def label(self) -> str:
        """Its name in the interface, such as `carry block1`."""
        return labelled(self.name, self.object)

    @property
    def constraints(self) -> tuple[str, ...]:
        """The active contacts of the hand and the held object; none in a plain ordered task."""
        if self.state == FREE or self.object is None:
            return ()
        slips = " (slipping)" if self.state == SLIDING else ""
        standing = [] if self.support is None else [f"{self.object}-{self.support}{slips}"]
        return tuple(sorted([*(f"{finger}-{self.object}" for finger in FINGERS), *standing]))


def labelled(subtask: str, obj: str | None) -> str:
    """A subtask with its object, such as `carry block1`; only its name if it has none."""
    return subtask if obj is None else f"{subtask} {obj}"


def stack(support: dict[str, str], name: str) -> tuple[str, ...]:
    """Objects from the support of `name` down to the ground, nearest first."""
    beneath, below = [], support[name]
    while below != GROUND:
        beneath.append(below)
        below = support[below]
    return tuple(beneath)


def subtasks(task: AnyTask) -> tuple[Subtask, ...]:
    """The ordered subtasks of a task: per move of blocks pregrasp, pickup, carry or slide, place, release."""
    if isinstance(task, SequenceTask):
        return tuple(Subtask(i, name, None, name, None) for i, name in enumerate(task.sequence))
    support = dict(task.initial)
    steps = [Subtask(0, "pregrasp", task.performed[0].object, FREE, 0)]
    for index, move in enumerate(task.performed):
        obj = move.object
        lifted, before = (None, ()), (support[obj], stack(support, obj))
        support[obj] = move.to
        after = (move.to, stack(support, obj))
        moved = ("slide", SLIDING, before) if move.slide else ("carry", ABOVE_GROUND, lifted)
        grip = (("pickup", ON_GROUND, before), moved, ("place", ON_GROUND, after), ("release", FREE, lifted))
        for name, state, (on, beneath) in grip:
            steps.append(Subtask(len(steps), name, obj, state, index, on, beneath))
    return tuple(steps)


WEIGHT, WIDTH, HEIGHT, FRICTION = "weight", "width", "height", "friction"
FRICTION_ON = "friction_on_"  # + the support's name: of the object against what it stands on

X_POSITIONS, Y_POSITIONS = "horizontal positions", "vertical positions"
X_FORCES, Y_FORCES = "horizontal forces", "vertical forces"

Unknown = tuple[str, ...]  # ("weight", object), or a nuisance such as ("load", subtask, sample)
UNITS = {WEIGHT: "N", WIDTH: "m", HEIGHT: "m"}  # of what an object has by itself
PROPERTIES = tuple(UNITS)


@dataclass(frozen=True)
class Source:
    """A signal measured during a subtask (its index); `sample` numbers the loads at which it was read."""

    subtask: int
    signal: str
    sample: int = 0


Key = TypeVar("Key")
Row = dict[Key, Fraction]  # a sum of its keys with these coefficients, which is 0
Equation = Row[Unknown | Source]


def reduced(rows: Iterable[Row[Key]], lead: Callable[[Row[Key]], Key | None]) -> dict[Key, Row[Key]]:
    """Rows of the reduced row echelon form by pivot, which `lead` chooses (None: no pivot in this row)."""
    pivots: dict[Key, Row[Key]] = {}
    for row in rows:
        for key in [key for key in row if key in pivots]:
            row = _minus(row, row[key], pivots[key])
        pivot = lead(row)
        if pivot is None:
            continue
        row = {key: value / row[pivot] for key, value in row.items()}
        pivots = {key: _minus(old, old[pivot], row) if pivot in old else old for key, old in pivots.items()}
        pivots[pivot] = row
    return pivots


def _minus(a: Row[Key], factor: Fraction, b: Row[Key]) -> Row[Key]:
    difference = {key: a.get(key, Fraction(0)) - factor * b.get(key, Fraction(0)) for key in a | b}
    return {key: value for key, value in difference.items() if value}


def is_property(unknown: Unknown) -> bool:
    """Whether an unknown is a property of an object, not a nuisance of one moment."""
    return unknown[0] in PROPERTIES or unknown[0].startswith(FRICTION_ON)


def balance(step: Subtask, loads: int = 1) -> list[Equation]:
    """Quasistatic equations of a subtask, at `loads` different vertical forces.

    Geometry: the fingers' distance is the width; the height of each finger is that of the object's bottom
    plus that of the grip on it, which is constant throughout one move. Forces: the fingers' net vertical
    force is the weight less the support's load, their net horizontal force is the support's push. Slipping:
    push = friction x load (Coulomb), linearised about given loads; their values are arbitrary, distinct
    numbers, as only rank matters."""
    if step.state == FREE or step.object is None:
        return []
    index, name, grasp = step.index, step.object, str(step.move)
    bottom: list[Unknown] = [(HEIGHT, below) for below in step.beneath]
    if step.support is None:
        bottom = [("lift", str(index))]
    equations = [_equation({(WIDTH, name): 1}, Source(index, X_POSITIONS))]
    for finger in FINGERS:
        held = dict.fromkeys([*bottom, ("grip", finger, grasp)], 1)
        equations.append(_equation(held, Source(index, Y_POSITIONS)))
    if step.support is None:
        return [*equations, _equation({(WEIGHT, name): 1}, Source(index, Y_FORCES))]
    for sample in range(loads):
        load, push = ("load", str(index), str(sample)), ("push", str(index), str(sample))
        equations.append(_equation({(WEIGHT, name): 1, load: -1}, Source(index, Y_FORCES, sample)))
        equations.append(_equation({push: 1}, Source(index, X_FORCES, sample)))
        if step.state == SLIDING:
            friction = (FRICTION_ON + step.support, name)
            equations.append({push: Fraction(1), load: Fraction(-1, 3), friction: Fraction(-sample - 2)})
    return equations


def _equation(unknowns: Mapping[Unknown, int], measured: Source) -> Equation:
    """The equation that the unknowns, with these coefficients, sum to the measured signal."""
    return {key: Fraction(value) for key, value in unknowns.items()} | {measured: Fraction(-1)}


def determined(equations: Iterable[Equation], known: Iterable[Unknown] = ()) -> dict[Unknown, Row[Source]]:
    """Unknowns that the equations determine, each as a combination of sources. An unknown is in the row space
    on its own exactly if its pivot row contains no other. `known` unknowns are given."""

    def unknown(row: Equation) -> list[Unknown]:
        return [key for key in row if not isinstance(key, Source)]

    def lead(row: Equation) -> Unknown | None:
        return min(unknown(row), key=is_property, default=None)  # nuisances go first

    excluded = set(known)
    rows = ({key: value for key, value in row.items() if key not in excluded} for row in equations)
    return {pivot: {key: -value for key, value in row.items() if isinstance(key, Source)}
            for pivot, row in reduced(rows, lead).items()
            if len(unknown(row)) == 1 and not isinstance(pivot, Source)}  # fmt: skip


@dataclass(frozen=True)
class Evidence:
    """One way to learn a property: the signals of the subtasks required together."""

    sources: tuple[Source, ...]
    bound: bool = False  # only a lower bound, as of friction without slip
    given: tuple[Unknown, ...] = ()  # properties, determined elsewhere, that are required
    condition: str | None = None  # what the recording must show in addition

    @property
    def subtasks(self) -> tuple[int, ...]:
        """Indices of the required subtasks, in order."""
        return tuple(sorted({source.subtask for source in self.sources}))

    def signals(self, subtask: int | None = None) -> tuple[str, ...]:
        """Names of the required signals, of one subtask or of all."""
        wanted = (s.signal for s in self.sources if subtask in (None, s.subtask))
        return tuple(sorted(set(wanted)))

    def terms(self) -> dict[str, Any]:
        """What is learned and required, for JSON."""
        return {"kind": "bound" if self.bound else "value",
                "given": [f"{owner}.{name}" for name, owner in self.given],
                "condition": self.condition}  # fmt: skip


@dataclass(frozen=True)
class Property:
    """A property of an object: every way to learn it, or the reason why there is none."""

    object: str
    name: str  # weight, width, height, friction (of the fingers on it) or friction_on_SUPPORT
    evidence: tuple[Evidence, ...]  # each suffices by itself, the strongest first
    reason: str | None = None

    @property
    def kind(self) -> str | None:
        """ "value", "bound" if only a lower bound is available, None if nothing is."""
        if not self.evidence:
            return None
        return "bound" if all(evidence.bound for evidence in self.evidence) else "value"

    def to_json(self) -> dict[str, Any] | None:
        """Its entry in `decompose`'s JSON document."""
        ways = [{"subtasks": e.subtasks, "signals": e.signals(), **e.terms()} for e in self.evidence]
        return {"kind": self.kind, "evidence": ways} if ways else None


@dataclass(frozen=True, repr=False)
class Decomposition(Tabled):
    """A task's subtasks in order, and for each object the evidence for its properties."""

    task: AnyTask
    subtasks: tuple[Subtask, ...]
    properties: dict[str, dict[str, Property]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def entries(self) -> list[Property]:
        """All properties of all objects."""
        return [entry for entries in self.properties.values() for entry in entries.values()]

    def reveals(self, index: int) -> list[tuple[Property, Evidence]]:
        """Properties that subtask `index` helps to reveal, each with its first such evidence."""
        pairs = []
        for entry in self.entries:
            evidence = next((e for e in entry.evidence if index in e.subtasks), None)
            if evidence is not None:
                pairs.append((entry, evidence))
        order = (WEIGHT, WIDTH, HEIGHT, FRICTION)  # friction on a support comes last
        return sorted(pairs, key=lambda pair: [pair[0].name == name for name in order], reverse=True)

    def in_paper(self, index: int, entry: Property) -> bool:
        """Whether the paper's Table 1 would list the property for this subtask: weight and width only while
        held above the ground, friction with a support only in sliding contact (Sections 2.1 and 3.2)."""
        state = self.subtasks[index].state
        if entry.name in (WEIGHT, WIDTH):
            return state == ABOVE_GROUND
        return state == SLIDING or not entry.name.startswith(FRICTION_ON)

    def minimal(self) -> tuple[Subtask, ...]:
        """The minimal sequence: subtasks that reveal a property, and the free motions that delimit them."""
        if not self.properties:
            return self.subtasks
        useful = {s.index for s in self.subtasks if self.reveals(s.index)}
        moves = {self.subtasks[index].move for index in useful}
        delimiting = {s.index for s in self.subtasks if s.state == FREE and s.move in moves}
        first = {0} if moves else set()  # delimits whichever move is the first to stay
        return tuple(s for s in self.subtasks if s.index in useful | delimiting | first)

    @property
    def reasons(self) -> dict[str, str]:
        """Why a property cannot be revealed, by `object.property`."""
        return {f"{p.object}.{p.name}": p.reason for p in self.entries if p.reason is not None}

    def cell(self, index: int, entry: Property, evidence: Evidence) -> str:
        """Signals of subtask `index` that reveal a property; parentheses mark what goes beyond the paper."""
        partners = [str(other + 1) for other in evidence.subtasks if other != index]
        signals = " and ".join(evidence.signals(index)).replace("horizontal forces and", "horizontal and")
        text = (">= " if evidence.bound else "") + signals
        if entry.object != self.subtasks[index].object:
            text = f"{entry.object}: {text}"
        if partners:
            text += f", with {', '.join(partners)}"
        if evidence.condition:
            text += f"; {evidence.condition}"
        return text if self.in_paper(index, entry) else f"({text})"

    def equation(self) -> str:
        """The decomposition in the notation of the paper's equation 1: subtask = (state, {properties})."""
        numbered = {name: re.fullmatch(r"(.*?)(\d+)", name) for name in self.properties}
        label = {name: name for name in numbered}
        if len({match[1] for match in numbered.values() if match}) == 1 and all(numbered.values()):
            label = {name: match[2] for name, match in numbered.items() if match}  # block1: 1
        parts = []
        for s in self.subtasks:
            revealed = [entry for entry, _ in self.reveals(s.index) if self.in_paper(s.index, entry)]
            names = [f"{entry.name.replace('_', ' ')} {label[entry.object]}" for entry in revealed]
            subject = s.name if s.object is None else f"{s.name.capitalize()} {label[s.object]}"
            state = s.state if s.object is None or s.state == FREE else f"{s.state} {label[s.object]}"
            parts.append(f"{subject} = ({state}, {{{', '.join(names) or '∅'}}})")
        return "T = { " + ",\n      ".join(parts) + " }"

    def to_json(self) -> dict[str, Any]:
        """The body of `decompose`'s JSON document."""
        document: dict[str, Any] = {
            "subtasks": [
                {
                    "index": subtask.index, "subtask": subtask.name, "object": subtask.object,
                    "state": subtask.state, "move": None if subtask.move is None else subtask.move + 1,
                    "support": subtask.support, "constraints": subtask.constraints,
                    "properties": [
                        {"property": f"{entry.object}.{entry.name}",
                         "signals": evidence.signals(subtask.index),
                         "with": [other for other in evidence.subtasks if other != subtask.index],
                         **evidence.terms(),
                         "in_paper": self.in_paper(subtask.index, entry)}
                        for entry, evidence in self.reveals(subtask.index)
                    ],
                }
                for subtask in self.subtasks
            ],
            "minimal": [subtask.index for subtask in self.minimal()], "equation": self.equation(),
            "properties": {
                name: {key: entry.to_json() for key, entry in entries.items()}
                for name, entries in self.properties.items()
            },
            "reasons": self.reasons, "notes": self.notes,
        }  # fmt: skip
        if isinstance(self.task, BlockTask):
            rises = height_equations(self.task)
            document["height_equations"] = [{"move": index + 1, "rise": rise} for index, rise in rises]
            document["repeat"] = self.task.repeat
        return document

    def tables(self) -> list[Any]:
        """The paper's Table 1; in parentheses, what the balance gives beyond it."""
        from rich.table import Table

        columns = [WEIGHT, WIDTH, HEIGHT, FRICTION] if self.properties else []
        if any(entry.name.startswith(FRICTION_ON) for entry in self.entries):
            columns.append(FRICTION_ON)
        heads = {FRICTION: "Friction of fingers", FRICTION_ON: "Friction on support"}
        caption = "Parentheses: derivable, though not in the paper's table. >=: a lower bound."
        table = Table(caption=caption if columns else None, show_lines=bool(columns))
        for head in ("", "Subtask", "State"):
            table.add_column(head, no_wrap=True)
        for column in columns:
            table.add_column(heads.get(column, column.capitalize()))
        for subtask in self.subtasks:
            cells = {column: "" for column in columns}
            for entry, evidence in self.reveals(subtask.index):
                column = FRICTION_ON if entry.name.startswith(FRICTION_ON) else entry.name
                cells[column] = self.cell(subtask.index, entry, evidence)
            table.add_row(str(subtask.index + 1), subtask.label, subtask.state, *cells.values())
        return [table]


VARYING_LOAD = "the vertical force must vary while the object slides"


def height_equations(task: BlockTask) -> list[tuple[int, dict[str, int]]]:
    """For each performed move, the rise of its object's bottom as a sum of object heights.

    The paper's height of the block beneath (its Table 3) is the case of a single coefficient.

    Args:
        task: of blocks.

    Returns:
        (0-based index of the move, {object: coefficient}) per move: bottom height at place less that
        at pickup. The rise of a slide is {}.
    """
    held, equations = [step for step in subtasks(task) if step.state != FREE], []
    for move, (start, end) in enumerate(zip(held[::3], held[2::3], strict=True)):
        rise = {name: (name in end.beneath) - (name in start.beneath) for name in task.objects}
        equations.append((move, {name: value for name, value in rise.items() if value}))
    return equations


def decompose(task: AnyTask) -> Decomposition:
    """Subtasks of a task, and how each object's properties can be learned."""
    if isinstance(task, SequenceTask):
        note = "a plain ordered task has no block physics: no properties"
        return Decomposition(task, subtasks(task), notes=(note,))
    steps = subtasks(task)
    learned = _learn(steps)
    properties: dict[str, dict[str, Property]] = {}
    for name in task.objects:
        rubbed = [key for key, owner in learned if owner == name and key.startswith(FRICTION_ON)]
        properties[name] = {}
        for key in (*PROPERTIES, FRICTION, *sorted(set(rubbed))):
            ways = learned.get((key, name), ())
            evidence = tuple(sorted(ways, key=lambda e: (e.bound, e.condition is not None, e.subtasks)))
            reason = None if evidence else _reason(task, steps, name, key)
            properties[name][key] = Property(name, key, evidence, reason)
    notes = ()
    if task.repeat == "unknown":
        notes = ("the moves repeat as often as the recording shows; one round is decomposed",)
    return Decomposition(task, steps, properties, notes)


def _learn(steps: Sequence[Subtask]) -> dict[Unknown, list[Evidence]]:
    """Every way to learn each property."""
    learned: dict[Unknown, list[Evidence]] = {}
    moves: dict[object, list[list[Subtask]]] = {}  # moves with equal contacts determine equal properties
    for _, group in itertools.groupby((s for s in steps if s.state != FREE), lambda s: s.move):
        move = list(group)
        moves.setdefault(tuple((s.constraints, s.beneath) for s in move), []).append(move)
    for alike in moves.values():
        _learn_within(alike, learned)
    equations = [e for alike in moves.values() for s in alike[0] for e in balance(s)]
    for unknown, row in determined(equations).items():
        if unknown[0] in PROPERTIES:
            learned.setdefault(unknown, [_evidence(row)])
    for step in itertools.chain.from_iterable(itertools.chain.from_iterable(moves.values())):
        _learn_friction(step, learned)
    return learned


def _learn_within(alike: list[list[Subtask]], learned: dict[Unknown, list[Evidence]]) -> None:
    """What single subtasks of moves with equal contacts determine, and what only pairs of them do."""
    first, alone = alike[0], set()
    for size in (1, 2):
        for subset in itertools.combinations(first, size):
            rows = determined(e for s in subset for e in balance(s))
            for unknown in filter(is_property, rows):
                if size == 1:
                    alone.add(unknown)
                elif unknown in alone:
                    continue
                for move in alike:
                    moved = {a.index: b.index for a, b in zip(first, move, strict=True)}
                    learned.setdefault(unknown, []).append(_evidence(rows[unknown], moved))


def _learn_friction(step: Subtask, learned: dict[Unknown, list[Evidence]]) -> None:
    """Friction at the contacts of one subtask, determined where the contact forces are known. A fingertip's
    forces are measured; a support's follow from the balance once the weight is given. Slip determines the
    coefficient, sticking bounds it from below."""
    forces, name = (Source(step.index, X_FORCES), Source(step.index, Y_FORCES)), str(step.object)
    learned.setdefault((FRICTION, name), []).append(Evidence(forces, bound=True))
    if step.support is None:
        return
    friction = (FRICTION_ON + step.support, name)
    target = friction if step.state == SLIDING else ("load", str(step.index), "0")
    equations = balance(step)
    unknowns = {key for equation in equations for key in equation if not isinstance(key, Source)}
    given = {key for key in unknowns if any(way.condition is None for way in learned.get(key, ()))}
    given -= {friction}
    if target in determined(equations, given):
        needed = tuple(u for u in given if target not in determined(equations, given - {u}))
        learned.setdefault(friction, []).append(Evidence(forces, step.state != SLIDING, needed))
        return
    for unknown, row in determined(balance(step, loads=3), given).items():
        if is_property(unknown):
            learned.setdefault(unknown, []).append(_evidence(row, condition=VARYING_LOAD))


def _evidence(
    sources: Iterable[Source], moved: Mapping[int, int] | None = None, condition: str | None = None
) -> Evidence:
    used = {((moved or {}).get(source.subtask, source.subtask), source.signal) for source in sources}
    return Evidence(tuple(Source(*source) for source in sorted(used)), condition=condition)


def _reason(task: BlockTask, steps: Iterable[Subtask], name: str, key: str) -> str:
    """Why nothing reveals a property, in plain words."""
    if key == HEIGHT:
        rises = {str(i + 1): rise for i, rise in height_equations(task) if name in rise}
        if not rises:
            return f"no recorded move changes the height at which something rests by {name}'s height"
        move, rise = next(iter(rises.items()))
        others = ", ".join(sorted(set(rise) - {name}))
        return f"move {move} changes heights by {name}'s only together with the height of {others}"
    if not any(step.state != FREE and step.object == name for step in steps):
        return f"no recorded move grips {name}"
    return f"no recorded move lifts {name} clear of its support"
