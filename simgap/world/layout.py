"""The table as the operator knows it: piles of blocks at spots along the ground."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy

import numpy as np

from hmmseg.io.task import GROUND, BlockTask, Move
from simgap.world.properties import Blocks

MIDDLE = 0.13  # look: m; the middle of the hand's workspace
NUDGE = 0.005  # look: m; a slide where there is no room for more
ORDERS = 12  # numerics: of the piles, tried to leave room for slides


def standing_heights(on: Mapping[str, str], heights: Mapping[str, float]) -> dict[str, float]:
    """Height of every block's centre above the ground [m] from what each stands on."""

    def top(name: str) -> float:
        return 0.0 if name == GROUND else heights[name] + top(on[name])

    return {name: top(on[name]) + heights[name] / 2 for name in on}


class Table:
    """Where every block stands; changed by the moves as they are planned.

    `x` [m] is every block's centre, `on` what it stands on, `spot` the place (index into `spots`)
    of a pile's lowest block.
    """

    def __init__(self, task: BlockTask, blocks: Blocks, spots: np.ndarray) -> None:
        self.blocks, self.spots = blocks, spots
        self.on = dict(task.initial)
        self.x: dict[str, float] = {}
        self.spot: dict[str, int] = {}

    def place(self, name: str) -> int:
        """Spot of the pile that a block is in."""
        while self.on[name] != GROUND:
            name = self.on[name]
        return self.spot[name]

    def centre(self, name: str) -> float:
        """Height of a block's centre above the ground [m]."""
        return standing_heights(self.on, {n: block.height for n, block in self.blocks.items()})[name]

    def top(self, without: str | None = None) -> float:
        """Height of the highest block's top [m], one block left out."""
        return max((self.centre(n) + self.blocks[n].height / 2 for n in self.on if n != without), default=0.0)

    def carry(self, move: Move, misplacement: float) -> float:
        """Perform a lifted move; where the block's centre comes to stand [m]."""
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
        """Perform a slide to a free spot beside, or by a little; where the centre comes to stand [m]."""
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
            rng: np.random.Generator) -> Table:  # fmt: skip
    """Piles at spots far enough apart for open fingers, with the free spots that the moves need."""
    piles = [name for name, on in task.initial.items() if on == GROUND]
    widest = max(blocks[name].width for name in task.objects)
    spacing = max(0.038, widest + clearance / 2 + 0.006) + rng.uniform(0.0, 0.004)
    count = _spots_needed(task)
    middle = MIDDLE + rng.uniform(-0.008, 0.008)
    spots = middle + spacing * (np.arange(count) - (count - 1) / 2)
    orders = [rng.permutation(count) for _ in range(ORDERS)]
    tables = [
        _table(task, blocks, spots, dict(zip(piles, map(int, order), strict=False))) for order in orders
    ]
    table = min(tables, key=lambda t: _nudges(task, t))
    for name in task.objects:
        table.x[name] += rng.uniform(*misplacement)
    return table


def _table(task: BlockTask, blocks: Blocks, spots: np.ndarray, piles: dict[str, int]) -> Table:
    table = Table(task, blocks, spots)
    table.spot = piles
    table.x = {name: float(spots[table.place(name)]) for name in task.objects}
    return table


def _nudges(task: BlockTask, table: Table) -> int:
    """How many slides along the ground find no free spot beside them."""
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
    """Most piles at any time, counting the spot that a block leaves for another on the ground."""
    on = dict(task.initial)
    most = sum(place == GROUND for place in on.values())
    for move in task.performed:
        along = move.to == GROUND == on[move.object]
        on[move.object] = move.to
        most = max(most, sum(place == GROUND for place in on.values()) + along)
    return most
