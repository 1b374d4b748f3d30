"""The likelihood of blocks of rows, by parts that nothing but the start ties.

In flight a discrepancy is of one channel, and only the uncertain start ties channels: a block's covariance is
B + U U' with B in parts and few columns U, one for each state. By Woodbury's identity

    r' C^-1 r = r' B^-1 r - p' M^-1 p,  log det C = log det B + log det M,  M = 1 + U' B^-1 U,  p = U' B^-1 r,

so that of a block of six channels six small factors are made in place of a large one. Parts of about one
size with the same sources are worked out together: there are hundreds, and one by one most of the time would
go into the calls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.latest import latest
from simgap.robots.blocks import Block, Source
from simgap.robots.triangular import all_inverses, all_solved_by

LATEST = 2  # numerics: variances of a stack by which it is kept: most differences are in another's
SIZES = 8  # numerics: parts are filled up to a multiple of so many rows, with rows that change nothing


@dataclass(frozen=True)
class _Stack:
    """Parts (P,) of one size m and the same sources, filled up: which of the gap's `rows` (P, m), -1 where
    there is none, and of which `block` (P,); their `variance` (P, m), `start` (P, m, S), and the numbers of
    sources with their covariances: of those that tie rows `ties` (K, P, m, m), of those that tie none, which
    have variances alone, `frees` (L, P, m)."""

    rows: np.ndarray
    block: np.ndarray
    variance: np.ndarray
    start: np.ndarray
    tying: np.ndarray
    ties: np.ndarray
    freeing: np.ndarray
    frees: np.ndarray

    @property
    def numbers(self) -> np.ndarray:
        """Of all its sources."""
        return np.concatenate([self.tying, self.freeing])

    def covariance(self, variance: np.ndarray) -> np.ndarray:
        """Of the parts (P, m, m) with sources of these variances (K,)."""
        # By far the most numbers: one pass over them, and no copies.
        out = np.tensordot(variance[self.tying], self.ties, 1)
        diagonal = np.einsum("pii->pi", out)  # a view
        diagonal += self.variance + np.tensordot(variance[self.freeing], self.frees, 1)
        return out


@dataclass(frozen=True)
class Tied:
    """Blocks (B,) of rows, their parts stacked by size; `trace` (B, K) of every source's covariance."""

    stacks: tuple[_Stack, ...]
    trace: np.ndarray
    states: int

    @classmethod
    def of(cls, blocks: Sequence[Block], names: Sequence[str]) -> Tied:
        """Sources are numbered as in `names`."""
        states = max((b.start.shape[1] for b in blocks), default=0)
        alike: dict[tuple, list[tuple[int, np.ndarray]]] = {}
        for number, block in enumerate(blocks):
            for rows in _parts(block):
                own = tuple(n for n in names if n in block.sources and _reaches(block.sources[n], rows))
                alike.setdefault((own, -(-rows.size // SIZES) * SIZES), []).append((number, rows))
        stacks = tuple(_stack(blocks, parts, names, size, states) for (_, size), parts in alike.items())
        trace = [[b.sources[n].trace if n in b.sources else 0.0 for n in names] for b in blocks]
        return cls(stacks, np.array(trace).reshape(len(blocks), len(names)), states)

    def of_residual(self, residual: np.ndarray) -> Likelihood:
        """The likelihood of the gap's rows (N,)."""
        filled = np.append(residual, 0.0)  # what -1 takes
        return Likelihood(
            self, tuple(filled[stack.rows] for stack in self.stacks), tuple({} for _ in self.stacks)
        )


@dataclass(frozen=True)
class Likelihood:
    """Of a residual, in the stacks' shapes (P, m), by the variances of all sources (K,); `kept` is of every
    stack what it was at its latest variances."""

    tied: Tied
    residual: tuple[np.ndarray, ...]
    kept: tuple[dict, ...]

    @property
    def squares(self) -> np.ndarray:
        """Sums of squares (B,) of the residual by block."""
        out = np.zeros(len(self.tied.trace))
        for stack, residual in zip(self.tied.stacks, self.residual, strict=True):
            np.add.at(out, stack.block, np.sum(residual**2, 1))
        return out

    def value(self, variance: np.ndarray) -> float:
        """Minus the log likelihood, but for a constant; LinAlgError where noise is lost in rounding."""
        return self._solved(variance)[0]

    def slope(self, variance: np.ndarray) -> tuple[float, np.ndarray]:
        """`value`, and its derivatives (K,): half of tr C^-1 Q - r' C^-1 Q C^-1 r."""
        value, inner, back, halves = self._solved(variance)
        slope = np.zeros(variance.size)
        for stack, half in zip(self.tied.stacks, halves, strict=True):
            # B^-1 of the residual and the start.
            both = all_solved_by(half.factor, half.white, transposed=True)
            columns = both[:, :, 1:]
            alpha = both[:, :, 0] - np.einsum("pms,ps->pm", columns, back[stack.block])
            inverse, less = all_inverses(half.factor), np.matmul(columns, inner[stack.block])
            free = np.einsum("pii->pi", inverse) - np.sum(less * columns, 2) - alpha**2
            slope[stack.freeing] += 0.5 * np.tensordot(stack.frees, free, 2)
            left = np.concatenate([less, alpha[:, :, None]], 2)
            right = np.concatenate([columns, alpha[:, :, None]], 2)
            inverse -= np.matmul(left, right.transpose(0, 2, 1))
            slope[stack.tying] += 0.5 * np.tensordot(stack.ties, inverse, 3)
        return value, slope

    def _solved(self, variance: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, list[_Half]]:
        """The value, M^-1 (B, S, S), M^-1 p (B, S), and the stacks whitened."""
        count, states = len(self.tied.trace), self.tied.states
        inner, pull = np.tile(np.eye(states), (count, 1, 1)), np.zeros((count, states))
        halves = [self._half(n, variance) for n in range(len(self.residual))]
        for stack, half in zip(self.tied.stacks, halves, strict=True):
            np.add.at(inner, stack.block, half.product)
            np.add.at(pull, stack.block, half.pull)
        value = sum(half.value for half in halves)
        if not states:
            return value, inner, pull, halves
        inverse = np.linalg.inv(inner)
        back = np.einsum("bst,bt->bs", inverse, pull)
        value += 0.5 * float(np.linalg.slogdet(inner)[1].sum() - np.sum(pull * back))
        return value, inverse, back, halves

    def _half(self, number: int, variance: np.ndarray) -> _Half:
        """A stack whitened with sources of these variances."""
        stack = self.tied.stacks[number]
        key = tuple(variance[stack.numbers].tolist())
        return latest(self.kept[number], key, lambda: _half(stack, self.residual[number], variance), LATEST)


@dataclass(frozen=True)
class _Half:
    """A stack's factors (P, m, m), the residual and the start (P, m, 1 + S) whitened by them, the start's
    products (P, S, S) and those with the residual (P, S), and what the value has without M."""

    factor: np.ndarray
    white: np.ndarray
    product: np.ndarray
    pull: np.ndarray
    value: float


def _half(stack: _Stack, residual: np.ndarray, variance: np.ndarray) -> _Half:
    factor = np.linalg.cholesky(stack.covariance(variance))
    white = all_solved_by(factor, np.concatenate([residual[:, :, None], stack.start], 2))
    left, start = white[:, :, 0], white[:, :, 1:]
    value = float(np.log(np.einsum("pii->pi", factor)).sum()) + 0.5 * float(np.sum(left**2))
    product = np.matmul(start.transpose(0, 2, 1), start)
    return _Half(factor, white, product, np.einsum("pms,pm->ps", start, left), value)


def _stack(
    blocks: Sequence[Block],
    parts: Sequence[tuple[int, np.ndarray]],
    names: Sequence[str],
    size: int,
    states: int,
) -> _Stack:
    """Parts of blocks that have the same sources, each by its block's number and its rows in it, filled up to
    a size."""
    rows = np.full((len(parts), size), -1)
    variance, start = np.ones(rows.shape), np.zeros((*rows.shape, states))
    first, first_rows = blocks[parts[0][0]], parts[0][1]
    here = [k for k, n in enumerate(names) if n in first.sources and _reaches(first.sources[n], first_rows)]
    tying = np.array([k for k in here if first.sources[names[k]].covariance.ndim == 2], int)
    freeing = np.array([k for k in here if first.sources[names[k]].covariance.ndim == 1], int)
    ties = np.zeros((tying.size, len(parts), size, size))
    frees = np.zeros((freeing.size, len(parts), size))
    for p, (number, mine) in enumerate(parts):
        block, n = blocks[number], mine.size
        rows[p, :n], variance[p, :n] = block.rows[mine], block.variance[mine]
        start[p, :n, : block.start.shape[1]] = block.start[mine]
        place = np.full(block.rows.size, -1)
        place[mine] = np.arange(n)
        for numbers, whole in ((tying, ties), (freeing, frees)):
            for k, source in enumerate(map(int, numbers)):
                whole[k, p] = _filled(block.sources[names[source]], place, size)
    return _Stack(
        rows, np.array([number for number, _ in parts]), variance, start, tying, ties, freeing, frees
    )


def _parts(block: Block) -> list[np.ndarray]:
    """A block's rows by part: what shares a source that ties them is one."""
    label = np.arange(block.rows.size)
    for source in block.sources.values():
        if source.covariance.ndim == 2 and source.rows.size:
            label[np.isin(label, np.unique(label[source.rows]))] = label[source.rows].min()
    return [np.flatnonzero(label == number) for number in np.unique(label)]


def _reaches(source: Source, rows: np.ndarray) -> bool:
    return bool(np.isin(source.rows, rows).any())


def _filled(source: Source, place: np.ndarray, size: int) -> np.ndarray:
    """A source's covariance in a part that is filled up to a size; `place` (n,) of a block's rows in it."""
    here = place[source.rows] >= 0
    at = place[source.rows[here]]
    whole = np.zeros((size,) * source.covariance.ndim)
    if whole.ndim == 1:
        whole[at] = source.covariance[here]
    else:
        whole[np.ix_(at, at)] = source.covariance[np.ix_(here, here)]
    return whole
