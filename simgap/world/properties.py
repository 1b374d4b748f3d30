"""Blocks of a virtual scene (given, read from a file or drawn at random) and the tabletop they stand on."""

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from estimation.report import LIMITS, number, read_actual
from hmmseg.contact.decompose import UNITS
from hmmseg.errors import InputError
from hmmseg.io.schema import read_json
from hmmseg.io.task import GROUND, BlockTask, Move
from hmmseg.tables import listed

DEFAULT_FRICTION = 1.2  # prior: of foam on a block, unless stated


@dataclass(frozen=True)
class Block:
    """One block: weight [N], width and height [m], Coulomb friction against a fingertip."""

    weight: float
    width: float
    height: float
    friction: float = DEFAULT_FRICTION

    def __post_init__(self) -> None:
        for name in ("weight", "width", "height", "friction"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"block {name} is {value!r}; expected a positive number")


Blocks = Mapping[str, Block]

# cited: the blocks of the paper's Table 4, weighed and measured with calipers.
PAPER_BLOCKS: Blocks = {"block1": Block(0.343, 0.0159, 0.0160), "block2": Block(0.437, 0.0254, 0.0127)}


def paper_blocks(task: BlockTask) -> dict[str, Block]:
    """The paper's blocks for the objects of a task, by name; in turn if names differ."""
    known = list(PAPER_BLOCKS.values())
    return {name: PAPER_BLOCKS.get(name, known[k % len(known)]) for k, name in enumerate(task.objects)}


def blocks_table(blocks: Blocks) -> Table:
    """A table of blocks for people, lengths in cm as in the paper."""
    rows = []
    for name, b in blocks.items():
        lengths = (f"{100 * length:.4g} cm" for length in (b.width, b.height))
        rows.append((name, f"{b.weight:.4g} N", *lengths, f"{b.friction:.3g}"))
    return listed("blocks", ("block", "weight", "width", "height", "friction"), rows)


def read_properties(path: str | Path, task: BlockTask) -> dict[str, Block]:
    """Read blocks from an `actual.toml` or from the JSON of `identify`; InputError if invalid. Values are
    `value` or `mean`. Friction is used if its mean is known; a lower bound alone raises the default to at
    least the bound. A property that could not be identified is refused."""
    path = Path(path)
    if path.suffix.lower() == ".json":
        table = read_json(path, "identify's JSON or an actual.toml").get("properties")
        if not isinstance(table, dict):
            raise InputError(f"{path}: key properties", "missing", "the JSON of identify")
    else:
        measured = read_actual(path, task.objects)
        table = {name: {key: v for key, (v, _) in entries.items()} for name, entries in measured.items()}
    return blocks_of(table, task, str(path))


def blocks_of(table: Mapping[str, Any], task: BlockTask, where: str) -> dict[str, Block]:
    """Blocks from a table of their properties, as `read_properties` reads it from the file `where`."""
    return {name: _block(table.get(name), f"{where}: key {name}") for name in task.objects}


def _block(entry: Any, where: str) -> Block:
    if not isinstance(entry, dict):
        raise InputError(where, "missing", "weight, width and height of every object of the task")
    for name in UNITS:
        if name not in entry:
            raise InputError(f"{where}.{name}", "missing", f"a number in {UNITS[name]}")
    values = {name: _value(entry[name], f"{where}.{name}", unit) for name, unit in UNITS.items()}
    return Block(**values, friction=_friction(entry.get("friction"), f"{where}.friction"))


def _value(entry: Any, where: str, unit: str) -> float:
    if isinstance(entry, dict):
        if entry.get("unit", unit) != unit:
            raise InputError(f"{where}.unit", f"found {entry['unit']!r}", repr(unit))
        entry = entry.get("value", entry.get("mean"))
    low, high = LIMITS[where.rpartition(".")[2].replace("lower_bound", "friction")]
    return number(entry, where, f"a positive number in {unit}, from {low:g} to {high:g}", low, high)


def _friction(entry: Any, where: str) -> float:
    if entry is None:
        return DEFAULT_FRICTION
    if isinstance(entry, dict) and entry.get("mean", entry.get("value")) is None:
        return max(DEFAULT_FRICTION, _value(entry.get("lower_bound"), f"{where}.lower_bound", "1"))
    return _value(entry, where, entry.get("unit", "1") if isinstance(entry, dict) else "1")


# The tabletop as the operator knows it: piles of blocks at spots along the ground.

MIDDLE = 0.13  # look: m; middle of the hand's workspace
NUDGE = 0.005  # look: m; length of a slide where there is no room for more
ORDERS = 12  # numerics: orders of the piles tried in search of room for slides


def standing_heights(on: Mapping[str, str], heights: Mapping[str, float]) -> dict[str, float]:
    """Height of every block's centre above the ground [m], given what each stands on."""

    def top(name: str) -> float:
        return 0.0 if name == GROUND else heights[name] + top(on[name])

    return {name: top(on[name]) + heights[name] / 2 for name in on}


class Tabletop:
    """Where every block stands; updated by each planned move. `x` [m] are the blocks' centres, `on` what each
    stands on, `spot` the place (index into `spots`) of the lowest block of each pile."""

    def __init__(self, task: BlockTask, blocks: Blocks, spots: np.ndarray, piles: Mapping[str, int]) -> None:
        self.blocks, self.spots = blocks, spots
        self.on, self.spot = dict(task.initial), dict(piles)
        self.x = {name: float(spots[self.place(name)]) for name in task.objects}

    def place(self, name: str) -> int:
        """Spot of the pile that contains a block."""
        while self.on[name] != GROUND:
            name = self.on[name]
        return self.spot[name]

    def centre(self, name: str) -> float:
        """Height of a block's centre above the ground [m]."""
        return standing_heights(self.on, {n: block.height for n, block in self.blocks.items()})[name]

    def top(self, without: str | None = None) -> float:
        """Height of the highest block's top [m], leaving one block out."""
        return max((self.centre(n) + self.blocks[n].height / 2 for n in self.on if n != without), default=0.0)

    def carry(self, move: Move, misplacement: float) -> float:
        """Perform a lifted move; the new centre of the block [m]."""
        if move.to == GROUND:
            here = self.place(move.object)
            spot = min(self._free(), key=lambda k: abs(k - here))
            target = self.spots[spot] + misplacement
            self.spot[move.object] = spot
        else:
            target = self.x[move.to] + misplacement
        self.on[move.object] = move.to
        self.x[move.object] = float(target)
        return float(target)

    def slide(self, move: Move, misplacement: float) -> float:
        """Slide a block to a free neighbouring spot, or a little way; its new centre [m]."""
        here, x = self.place(move.object), self.x[move.object]
        beside = [k for k in self._free() if abs(k - here) == 1]
        if move.to == GROUND and beside:
            self.spot[move.object] = beside[0]
            target = self.spots[beside[0]] + misplacement
        else:
            middle = self.spots[here] if move.to == GROUND else self.x[move.to]
            target = x + (NUDGE if x <= middle else -NUDGE)
        self.x[move.object] = float(target)
        return float(target)

    def _free(self) -> list[int]:
        taken = {self.spot[name] for name, on in self.on.items() if on == GROUND}
        return [k for k in range(len(self.spots)) if k not in taken]


def lay_out(task: BlockTask, blocks: Blocks, clearance: float, misplacement: tuple[float, float],
            rng: np.random.Generator) -> Tabletop:  # fmt: skip
    """Piles at spots far enough apart for open fingers, with the free spots that the moves need."""
    piles = [name for name, on in task.initial.items() if on == GROUND]
    widest = max(blocks[name].width for name in task.objects)
    spacing = max(0.038, widest + clearance / 2 + 0.006) + rng.uniform(0.0, 0.004)
    count = _spots_needed(task)
    middle = MIDDLE + rng.uniform(-0.008, 0.008)
    spots = middle + spacing * (np.arange(count) - (count - 1) / 2)
    orders = [map(int, rng.permutation(count)) for _ in range(ORDERS)]
    tables = [Tabletop(task, blocks, spots, dict(zip(piles, order, strict=False))) for order in orders]
    table = min(tables, key=lambda t: _nudges(task, t))
    for name in task.objects:
        table.x[name] += rng.uniform(*misplacement)
    return table


def _nudges(task: BlockTask, table: Tabletop) -> int:
    """Number of slides along the ground that find no free neighbouring spot."""
    table, count = deepcopy(table), 0
    for move in task.performed:
        if move.slide:
            before = table.spot.get(move.object)
            table.slide(move, 0.0)
            count += move.to == GROUND and table.spot[move.object] == before
        else:
            table.carry(move, 0.0)
    return count


def _spots_needed(task: BlockTask) -> int:
    """Largest number of piles at any time, counting the spot that a block vacates for another one."""

    on = dict(task.initial)
    most = sum(place == GROUND for place in on.values())
    for move in task.performed:
        along = move.to == GROUND == on[move.object]
        on[move.object] = move.to
        most = max(most, sum(place == GROUND for place in on.values()) + along)
    return most
