"""What a search is asked, and where it stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from simgap.attribution.posterior import Forms, forms
from simgap.robots.blocks import NONE, Discrepancy
from simgap.robots.gap import fitted_along, gap_of
from simgap.robots.linear import Linear, linearise
from simgap.robots.model import Composed, Point
from simgap.robots.phases import Phases
from simgap.robots.whiten import Whitener

ROUNDS = 10  # numerics: of an iteration that settles sooner


@dataclass(frozen=True)
class Step:
    """Where a search stands: about which point it goes on, and the best set so far, which settled there and
    left a discrepancy of about `off`;
    `field`: the candidates that came near when all were asked; `whole`: all are asked next."""

    point: Point
    best: tuple[str, ...] = ()
    ended: bool = False
    field: tuple[str, ...] = ()
    whole: bool = True
    off: Discrepancy = NONE


@dataclass(frozen=True)
class Asked:
    """In which windows which candidates are asked, which of them are `forced`, the `factor` (N,) on the
    noise's sd and the `fold` (N,) of each row; `plain`: all candidates' sensitivities in these windows where
    what is fitted along fits best without them; `last`: what takes long was tried in some of the windows."""

    composed: Composed
    phases: Phases
    candidates: tuple[str, ...]
    forced: tuple[str, ...]
    factor: np.ndarray
    fold: np.ndarray
    plain: Linear
    last: bool = False

    @cached_property
    def few(self) -> Asked:
        """The same in some of the windows, or this where they are few anyway."""
        numbers = self.composed.thinned()
        if len(numbers) >= len(self.composed.windows):
            return self
        part, mine = self.composed.among(numbers), np.isin(self.composed.rows.window, numbers)
        plain = self.plain.among(part, mine)
        return replace(self, composed=part, factor=self.factor[mine], fold=self.fold[mine], plain=plain)

    def asked(self, step: Step, number: int) -> tuple[str, ...]:
        """The candidates that a round asks: all in the last one."""
        near = {*step.field, *step.best}
        if step.whole or self.forced or number == ROUNDS - 1:
            return self.candidates
        return tuple(n for n in self.candidates if n in near)

    def linearised(self, point: Point, names: Sequence[str]) -> Linear:
        """All about a point; what is known there is not worked out again."""
        names, known = [*fitted_along(self.composed), *names], self.plain
        if known.point == point and {*names} <= {*known.moved, *known.diverged}:
            return known
        return linearise(self.composed, point, names)

    def forms(self, linear: Linear, whiten: Whitener, names: Sequence[str]) -> Forms:
        """The gap about a point, of these candidates."""
        return forms(gap_of(self.composed, linear, whiten, self.phases, names))
