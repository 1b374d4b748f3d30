"""The likelihood of one block's rows, by parts that nothing but the start ties.

In flight a discrepancy is of one channel, and only the uncertain start ties channels: the covariance is
B + U U' with B in blocks and few columns U, one for each state. By Woodbury's identity

    square = |z|^2 - |w|^2,  log det = log det B + log det M,   z = L^-1 r,  Z = L^-1 U,  B = L L',
    M = 1 + Z'Z,  M = K K',  w = K^-1 Z'z,

so that of a block of six channels six small factors are made in place of a large one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import lapack

from simgap.latest import latest
from simgap.robots.triangular import factored, solved_by
from simgap.robots.whiten import Block, Source

dpotri: Any = lapack.dpotri  # type: ignore[attr-defined]  # inverse from a Cholesky factor


@dataclass(frozen=True)
class _Part:
    """Rows that no other part's share a source with but such as tie none: their `variance` (m,), `start`
    (m, S), `residual` (m,), and sources by number."""

    variance: np.ndarray
    start: np.ndarray
    residual: np.ndarray
    sources: tuple[tuple[int, Source], ...]

    def whitened(self, variance: Sequence[float]) -> tuple:
        """With its sources of these variances: factor, residual and start whitened by it, the start's
        products (S, S), half the log determinant."""
        whole = np.diag(self.variance)
        for (_, source), one in zip(self.sources, variance, strict=True):
            if one > 0:
                source.add(whole, one)
        factor = factored(whole)
        both = solved_by(factor, np.column_stack([self.residual, self.start]))
        white, start = both[:, 0], both[:, 1:]
        return factor, white, start, start.T @ start, float(np.log(np.diag(factor)).sum())


LATEST = 2  # numerics: variances of a part whose factors are kept: most differences are in another part's


@dataclass(frozen=True)
class Tied:
    """A block's parts; `trace` (K,) of every source's covariance at s = 1; `kept` of each part what it was
    at its latest variances."""

    parts: tuple[_Part, ...]
    size: int
    trace: np.ndarray
    kept: tuple[dict, ...]

    @classmethod
    def of(cls, block: Block, residual: np.ndarray, names: Sequence[str]) -> Tied:
        """Of a block with a residual (n,); sources are numbered as in `names`."""
        label = _labels(block)
        parts = []
        for number in np.unique(label):
            mine = np.flatnonzero(label == number)
            place = np.full(label.size, -1)
            place[mine] = np.arange(mine.size)
            own = []
            for k, name in enumerate(names):
                if name in block.sources:
                    source = block.sources[name]
                    here = place[source.rows] >= 0
                    if here.any():
                        covariance = source.covariance[here]
                        covariance = covariance if covariance.ndim == 1 else covariance[:, here]
                        own.append((k, Source(place[source.rows[here]], covariance)))
            parts.append(_Part(block.variance[mine], block.start[mine], residual[mine], tuple(own)))
        trace = np.array([block.sources[n].trace if n in block.sources else 0.0 for n in names])
        return cls(tuple(parts), label.size, trace, tuple({} for _ in parts))

    @property
    def square(self) -> float:
        """Sum of squares of the residual."""
        return sum(float(p.residual @ p.residual) for p in self.parts)

    def solved(self, variance: np.ndarray) -> Solved:
        """With sources of these variances (K,); LinAlgError where noise is lost in rounding."""
        states = self.parts[0].start.shape[1]
        inner, pull = np.eye(states), np.zeros(states)
        square = half = 0.0
        factors, whites, moved = [], [], []
        for part, store in zip(self.parts, self.kept, strict=True):
            key = tuple(float(variance[k]) for k, _ in part.sources)
            done = latest(store, key, lambda part=part, key=key: part.whitened(key), LATEST)
            factor, white, start, product, own = done
            inner += product
            pull += start.T @ white
            square += float(white @ white)
            half += own
            factors.append(factor)
            whites.append(white)
            moved.append(start)
        if not states:
            return Solved(self, factors, whites, moved, inner, pull, square, half)
        factor = factored(inner)
        gone = solved_by(factor, np.column_stack([pull, np.eye(states)]))
        back = solved_by(factor, gone, transposed=True)
        square -= float(gone[:, 0] @ gone[:, 0])
        half += float(np.log(np.diag(factor)).sum())
        return Solved(self, factors, whites, moved, back[:, 1:], back[:, 0], square, half)


@dataclass(frozen=True)
class Solved:
    """A block's `square` r' C^-1 r and `half` its log determinant; of its parts the factors, and residual and
    start whitened by them; `inverse` (S, S) of M, and it times Z'z (S,)."""

    tied: Tied
    factors: list[np.ndarray]
    whites: list[np.ndarray]
    moved: list[np.ndarray]
    inverse: np.ndarray
    back: np.ndarray
    square: float
    half: float

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """By every source's variance (K,): trace of C^-1 Q, and r' C^-1 Q C^-1 r."""
        trace, pull = np.zeros(self.tied.trace.size), np.zeros(self.tied.trace.size)
        for part, factor, white, start in zip(
            self.tied.parts, self.factors, self.whites, self.moved, strict=True
        ):
            both = solved_by(factor, np.column_stack([white - start @ self.back, start]), transposed=True)
            alpha, columns = both[:, 0], both[:, 1:]
            # Of B^-1 the lower half alone: covariances are as symmetric as it is. C^-1 is that less what the
            # start takes, of which a few columns tell all.
            inverse = dpotri(factor, lower=1)[0]
            diagonal, less = np.diag(inverse), columns @ self.inverse
            for k, source in part.sources:
                at, own = source.rows, source.covariance
                if own.ndim == 1:
                    taken = np.einsum("ij,ij->i", less[at], columns[at])
                    trace[k] += float((diagonal[at] - taken) @ own)
                    pull[k] += float(alpha[at] ** 2 @ own)
                else:
                    both_halves = 2 * np.vdot(source.across(inverse), own) - diagonal[at] @ np.diag(own)
                    trace[k] += float(both_halves - np.vdot(less[at], own @ columns[at]))
                    pull[k] += float(alpha[at] @ own @ alpha[at])
        return trace, pull


def _labels(block: Block) -> np.ndarray:
    """The part (n,) of each row: what shares a source is one part."""
    label = np.arange(block.rows.size)
    for source in block.sources.values():
        if source.covariance.ndim == 2 and source.rows.size:
            label[np.isin(label, np.unique(label[source.rows]))] = label[source.rows].min()
    return label
