"""Which parameters these logs can tell, and which only together: read off sensitivities before any fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

UNSEEN = 1.0  # chosen: noise deviations: what a parameter's usual size must move all samples by, together
EXACT, CLOSE = 1e-6, 0.02  # chosen: share of a parameter's sensitivity that is its own, at most
LARGEST = 6  # numerics: parameters of a set


@dataclass(frozen=True)
class Alike:
    """Parameters of which only a combination is determined; `own`: the share that the first has to itself."""

    names: tuple[str, ...]
    own: float

    @property
    def exact(self) -> bool:
        """Whether they cannot be told apart by any amount of such data."""
        return self.own <= EXACT


@dataclass(frozen=True)
class Identifiability:
    """`unseen` parameters move nothing by more than noise; `alike` are sets that act alike."""

    unseen: tuple[str, ...]
    alike: tuple[Alike, ...]

    def body(self) -> dict:
        """As the JSON document has it."""
        return {
            "unseen": list(self.unseen),
            "alike": [{"parameters": list(a.names), "own": a.own, "exact": a.exact} for a in self.alike],
        }


def identifiability(names: Sequence[str], product: np.ndarray) -> Identifiability:
    """From inner products (p, p) of sensitivities, whitened, each for a change of one usual size.

    A parameter is alike the fewest others that make up its sensitivity, found one by one (orthogonal
    matching pursuit: Pati, Rezaiifar and Krishnaprasad 1993).
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
    """The fewest other columns that make up column j, and the share of its square that they leave.

    A set that makes it up exactly goes before a smaller one that does so closely.
    """
    chosen: list[int] = []
    close: tuple[list[int], float] = ([], 1.0)
    left = gram[:, j].copy()  # of column j, what is left along every column
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
