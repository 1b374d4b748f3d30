"""Which candidates act together: evidence of sets of them in closed form, about one point.

There the rows are linear in all parameters, x in prior standard deviations from neutral:

    residual = columns x + noise N(0, V),      V = V_0 + level^2 (discrepancy as it is at the point),

with priors N(0, 1) of what is fitted along and Cauchy slabs of the set's effects.

A set's log evidence is Laplace's about its mode. The discrepancy that a set leaves is known only once it is
fitted, so there are several levels of it, each with the normal equations of all columns by fold, and a set is
scored with the likeliest. The log density of a fold given the others is the evidence of all folds less that
of the others.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from scipy.special import gammaln

from simgap.bounded import least
from simgap.robot_effects.base import RobotEffect
from simgap.robots.linear import Linear, Moved
from simgap.robots.model import Point
from simgap.robots.whiten import Whitener

TURNS = 6  # numerics: iterations of reweighted least squares
PIVOTS = 8  # numerics: exchanges of bounds for many sets at once

Names = tuple[str, ...]


@dataclass(frozen=True)
class Evidence:
    """A set's evidence with one level of the discrepancy.

    `score`: log evidence [nats]; `x`: mode (m,) of what is fitted along, then of the set's parameters;
    `covariance`: there (m, m); 0 of what is at a bound; `spread`: the same without bounds (m, m): what lies
    at a bound is not certain, nor is what it is traded against.
    """

    score: float
    x: np.ndarray
    covariance: np.ndarray
    spread: np.ndarray


@dataclass(frozen=True)
class Sets:
    """Normal equations of all columns about a point.

    The first column is the residual with every effect neutral; then come those that are fitted along, then
    for each candidate a constant and its derivatives.

    `names`: the candidates; `gram`: products of columns (levels, folds, M, M); `half_log_det`: half log
    determinants of the noise (levels, folds); `along`: number of columns that are fitted along; `size`:
    number of parameters of each candidate; `labels`: names of all their parameters; `low`, `high`: bounds
    (M,) by column; `log_odds`: prior log odds of a candidate to act.
    """

    names: Names
    gram: np.ndarray
    half_log_det: np.ndarray
    along: int
    size: tuple[int, ...]  # parameters of each candidate
    labels: tuple[str, ...]  # of all parameters
    low: np.ndarray  # by column
    high: np.ndarray
    log_odds: float

    @classmethod
    def of(
        cls,
        effects: Mapping[str, RobotEffect],
        linear: Linear,
        levels: Sequence[Whitener],
        names: Sequence[str],
        fold: np.ndarray,
        log_odds: float,
    ) -> Sets:
        """The normal equations about the point of a linearisation.

        Args:
            effects: By name; those that are `fitted` are fitted along.
            linear: The linearisation, which has these candidates and what is fitted along.
            levels: Whiteners, one for each level of the discrepancy.
            names: The candidates.
            fold: Fold (N,) of each row.
            log_odds: Prior log odds of a candidate to act.
        """
        seen = np.isfinite(linear.residual)
        along = [n for n, e in effects.items() if e.fitted]
        columns, bounds = [np.nan_to_num(linear.residual)], [(0.0, 0.0)]
        for name in along:
            moved, known = linear.moved[name], list(effects[name].parameters.values())
            for k, p in enumerate(known):
                columns.append(np.nan_to_num(moved.jacobian[:, k]) * p.sd)
                columns[0] = columns[0] + columns[-1] * (moved.at[k] - p.nominal) / p.sd
                bounds.append((p.coordinate(p.low), p.coordinate(p.high)))
        width = len(columns) - 1
        for name in names:
            if name in linear.point:
                columns[0] = columns[0] + np.nan_to_num(linear.moved[name].shift)
            columns += _columns(effects[name], linear.moved[name])
            known = effects[name].parameters.values()
            bounds += [(0.0, 0.0), *((p.coordinate(p.low), p.coordinate(p.high)) for p in known)]
        whole, numbers = np.where(seen[:, None], np.column_stack(columns), 0.0), np.unique(fold)
        gram, half = [], []
        for whiten in levels:
            white = whiten(whole)
            parts = [white[fold == n] for n in numbers]
            gram.append([part.T @ part for part in parts])
            half.append(whiten.half_log_dets(np.searchsorted(numbers, fold)))
        size = tuple(len(effects[n].parameters) for n in names)
        labels = tuple(effects[n].label(short) for n in names for short in effects[n].parameters)
        low, high = np.array(bounds).T
        return cls(tuple(names), np.array(gram), np.array(half), width, size, labels, low, high, log_odds)

    def scores(self, sets: Sequence[Names], level: int, without: int | None = None) -> np.ndarray:
        """Log evidence (len(sets),) of sets with a level, `without` one fold."""
        alike: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for i, names in enumerate(sets):
            alike[tuple(sorted(self._size(n) for n in names))].append(i)
        out = np.zeros(len(sets))
        for mine in alike.values():
            found = self._evidence([sets[i] for i in mine], level, without)
            out[mine] = found[0]
        return out

    def fit(self, names: Names, level: int) -> Evidence:
        """A set's evidence with a level; parameters in the order of `names`."""
        score, x, covariance, spread = self._evidence([names], level, None, kept=True)
        return Evidence(float(score[0]), x[0], covariance[0], spread[0])

    def pruned(self, names: Names, level: int) -> Names:
        """The set less the effects needed least, dropped one by one while that makes it likelier."""
        score = float(self.scores([names], level)[0])
        while names:
            fewer = [tuple(n for n in names if n != out) for out in names]
            scores = self.scores(fewer, level)
            if scores.max() < score:
                break
            names, score = fewer[int(scores.argmax())], float(scores.max())
        return names

    def held_out(self, names: Names, level: int) -> np.ndarray:
        """Log density (folds,) of each fold given the others."""
        whole = self.scores([names], level)[0]
        return np.array([whole - self.scores([names], level, k)[0] for k in range(self.gram.shape[1])])

    def jackknife(self, names: Names, level: int) -> np.ndarray:
        """A set's modes (folds, m), each without one fold."""
        folds = range(self.gram.shape[1])
        return np.array([self._evidence([names], level, k, kept=True)[1][0] for k in folds])

    def product(self) -> tuple[list[str], np.ndarray]:
        """Names of the candidates' parameters, and inner products (p, p) of their columns, whitened by the
        sensors' noise."""
        at = [self.first[j] + 1 + k for j, size in enumerate(self.size) for k in range(size)]
        return list(self.labels), self.gram[-1].sum(0)[np.ix_(at, at)]

    @cached_property
    def first(self) -> np.ndarray:
        """The column of each candidate's constant."""
        return 1 + self.along + np.cumsum([0, *(1 + k for k in self.size)])

    def _size(self, name: str) -> int:
        return self.size[self.names.index(name)]

    def _evidence(
        self, sets: Sequence[Names], level: int, without: int | None, kept: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Scores (B,), modes (B, m), covariances and spreads (B, m, m) of sets whose effects have equally
        many parameters."""
        used = np.arange(self.gram.shape[1]) != without
        gram, half = self.gram[level][used].sum(0), float(self.half_log_det[level][used].sum())
        place = {n: self.first[j] for j, n in enumerate(self.names)}
        ordered = [s if kept else tuple(sorted(s, key=self._size)) for s in sets]
        free = np.array([
            [*range(1, 1 + self.along), *(place[n] + 1 + k for n in s for k in range(self._size(n)))]
            for s in ordered
        ], int)  # fmt: skip
        constant = np.array([[0, *(place[n] for n in s)] for s in ordered])
        sign = np.array([1.0, *(-1.0 for _ in ordered[0])])
        block = np.repeat(np.arange(len(ordered[0])), np.array([self._size(n) for n in ordered[0]], int))
        square = np.einsum("i,bij,j->b", sign, gram[constant[:, :, None], constant[:, None, :]], sign)
        pull = np.einsum("i,bij->bj", sign, gram[constant[:, :, None], free[:, None, :]])
        bend = gram[free[:, :, None], free[:, None, :]]
        low, high = self.low[free], self.high[free]
        count, a = free.shape[1], self.along
        size = np.bincount(block, minlength=len(ordered[0]))
        prior, x = np.ones(free.shape), np.zeros(free.shape)
        eye, side = np.eye(count), np.zeros(free.shape, int)
        for _ in range(TURNS):
            x = _within(bend + prior[:, :, None] * eye, pull, low, high, side)
            if block.size:
                square_x = np.stack([np.sum(x[:, a:][:, block == j] ** 2, 1) for j in range(size.size)], 1)
                prior[:, a:] = ((1 + size) / (1 + square_x))[:, block]
        held = side != 0
        loose = ~(held[:, :, None] | held[:, None, :])
        matrix = np.where(loose, bend + prior[:, :, None] * eye, eye)
        energy = square - 2 * np.einsum("bi,bi->b", pull, x) + np.einsum("bi,bij,bj->b", x, bend, x)
        score = -0.5 * np.maximum(energy, 0.0) - half - 0.5 * np.sum(x[:, :a] ** 2, 1)
        if block.size:
            score = score + np.sum(
                gammaln((1 + size) / 2) - gammaln(0.5) - 0.5 * size * np.log(np.pi)
                - 0.5 * (1 + size) * np.log1p(square_x), 1,
            )  # fmt: skip
        score += 0.5 * ((~held[:, a:]).sum(1)) * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(matrix)[1]
        score += len(ordered[0]) * self.log_odds
        if not kept:
            return score, x, np.zeros((0, 0, 0)), np.zeros((0, 0, 0))
        spread = np.linalg.inv(bend + prior[:, :, None] * eye)
        return score, x, np.linalg.inv(matrix) * loose, spread


def _within(
    matrix: np.ndarray, pull: np.ndarray, low: np.ndarray, high: np.ndarray, side: np.ndarray
) -> np.ndarray:
    """The x (B, m) within bounds (B, m) that minimise x' matrix x / 2 - pull x.

    `side` (B, m): the bound at which each coordinate is thought to be, -1 low, 1 high; corrected in place.
    All are solved at once, and those that this does not settle one by one.
    """
    out, open_ = np.empty_like(pull), np.arange(len(pull))
    for _ in range(PIVOTS):
        bend, mine, s = matrix[open_], pull[open_], side[open_]
        at = np.where(s < 0, low[open_], np.where(s > 0, high[open_], 0.0))
        rest = np.where(s != 0, at, mine - np.einsum("bij,bj->bi", bend, at))
        free = (s == 0)[:, :, None] & (s == 0)[:, None, :]
        x = np.linalg.solve(np.where(free, bend, np.eye(s.shape[1])), rest[..., None])[..., 0]
        # As in `simgap.bounded`: what lies beyond a bound is fixed there, what is drawn inwards freed.
        slope = np.einsum("bij,bj->bi", bend, x) - mine
        beyond = (x > high[open_]).astype(int) - (x < low[open_])
        new = np.where(s != 0, np.where(s * slope > 0, 0, s), beyond)
        out[open_], side[open_] = x, new
        open_ = open_[(new != s).any(1)]
        if not open_.size:
            return out
    for b in open_:
        out[b], held = least(matrix[b], pull[b], low[b], high[b])
        side[b] = np.where(held, np.where(out[b] == low[b], -1, 1), 0)
    return out


def _columns(effect: RobotEffect, moved: Moved) -> list[np.ndarray]:
    """A candidate's constant and its derivatives by usual sizes."""
    known = list(effect.parameters.values())
    sd, neutral = np.array([p.sd for p in known]), np.array([p.nominal for p in known])
    slope = np.nan_to_num(moved.jacobian) * sd
    return [np.nan_to_num(moved.shift) - slope @ ((moved.at - neutral) / sd), *slope.T]


def neighbours(best: Names, names: Sequence[str]) -> list[Names]:
    """Sets with one effect more, one less, or one exchanged."""
    fewer = [tuple(n for n in best if n != out) for out in best]
    more = [(*kept, n) for kept in (best, *fewer) for n in names if n not in best]
    return [*more, *fewer]


def pairs(best: Names, names: Sequence[str]) -> list[Names]:
    """Sets with two effects more."""
    return [(*best, *two) for two in combinations([n for n in names if n not in best], 2)]


def point_of(
    effects: Mapping[str, RobotEffect], found: Evidence, names: Names, along: Sequence[str]
) -> dict[str, Mapping[str, float]]:
    """The parameters at a mode."""
    out: dict[str, Mapping[str, float]] = {}
    at = 0
    for name in (*along, *names):
        known = effects[name].parameters
        values = found.x[at : at + len(known)]
        out[name] = {
            short: float(np.clip(p.nominal + p.sd * v, p.low, p.high))
            for (short, p), v in zip(known.items(), values, strict=True)
        }
        at += len(known)
    return out


def without(point: Point, out: str) -> dict[str, Mapping[str, float]]:
    """A point without one effect."""
    return {n: v for n, v in point.items() if n != out}


# Identifiability: which parameters these logs determine, and which only jointly.


UNSEEN = 1.0  # chosen: noise deviations by which a parameter's usual size must move all samples, together
EXACT, CLOSE = 1e-6, 0.02  # chosen: shares of a sensitivity that no others reproduce, at most
LARGEST = 6  # numerics: most parameters of a set


@dataclass(frozen=True)
class Alike:
    """Parameters of which only a combination is determined; `own`: the share of its sensitivity that only the
    first has."""

    names: tuple[str, ...]
    own: float

    @property
    def exact(self) -> bool:
        """Whether no amount of such data tells them apart."""
        return self.own <= EXACT


@dataclass(frozen=True)
class Identifiability:
    """Parameters that are `unseen`, moving nothing beyond noise, and sets of parameters that act `alike`."""

    unseen: tuple[str, ...]
    alike: tuple[Alike, ...]

    def body(self) -> dict[str, Any]:
        """The entry of the JSON document."""
        return {
            "unseen": list(self.unseen),
            "alike": [{"parameters": list(a.names), "own": a.own, "exact": a.exact} for a in self.alike],
        }


def identifiability(names: Sequence[str], product: np.ndarray) -> Identifiability:
    """Which parameters the logs determine, and which only jointly, from sensitivities at one point.

    A parameter is alike the fewest others that reproduce its sensitivity, found one by one (orthogonal
    matching pursuit: Pati, Rezaiifar and Krishnaprasad 1993).

    Args:
        names: Names of p parameters.
        product: Inner products (p, p) of whitened sensitivities to changes of one usual size.
    """
    length = np.sqrt(np.diag(product))
    unseen = length < UNSEEN
    seen = np.flatnonzero(~unseen)
    gram = product[np.ix_(seen, seen)] / np.outer(length[seen], length[seen])
    found: dict[frozenset[int], Alike] = {}
    for j in range(seen.size):
        chosen, own = _makers(gram, j)
        if own > CLOSE:
            continue
        key = frozenset([j, *chosen])
        others = tuple(names[int(seen[i])] for i in (j, *chosen))
        if not any(known <= key for known in found) and (key not in found or found[key].own > own):
            found[key] = Alike(others, own)
    alike = sorted(found.values(), key=lambda a: (len(a.names), a.own))
    return Identifiability(
        tuple(name for name, none in zip(names, unseen, strict=True) if none), tuple(alike)
    )


def _makers(gram: np.ndarray, j: int) -> tuple[list[int], float]:
    """The fewest other columns that reproduce column j, and the share of its square that they leave.

    A set that reproduces it exactly goes before a smaller one that does so closely.
    """
    chosen: list[int] = []
    close: tuple[list[int], float] = ([], 1.0)
    left = gram[:, j].copy()  # what is left of column j along every column
    for _ in range(min(LARGEST - 1, len(gram) - 1)):
        left[[j, *chosen]] = 0.0
        chosen.append(int(np.abs(left).argmax()))
        within = gram[np.ix_(chosen, chosen)]
        weights = np.linalg.lstsq(within, gram[chosen, j], rcond=None)[0]
        left = gram[:, j] - gram[:, chosen] @ weights
        own = max(float(left[j]), 0.0)
        if own <= EXACT:
            return chosen, own
        if own <= CLOSE < close[1]:
            close = list(chosen), own
    return close
