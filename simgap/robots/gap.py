"""The gap that attribution is asked about: whitened rows, what is fitted along, and candidates."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from simgap.attribution.problem import BANDS, Candidate, Gap
from simgap.attribution.problem import Rows as GapRows
from simgap.robots.linear import Linear
from simgap.robots.model import Composed
from simgap.robots.phases import Phases


def fitted_along(composed: Composed) -> tuple[str, ...]:
    """Effects that are fitted along with every cause."""
    return tuple(n for n, e in composed.effects.items() if e.fitted)


def gap_of(
    composed: Composed,
    linear: Linear,
    whiten: Callable[[np.ndarray], np.ndarray],
    phases: Phases,
    candidates: Sequence[str],
) -> Gap:
    """The gap about the linear model's point, at which it is exact; `candidates` in this order. `whiten`
    takes rows (N,) or columns (N, k)."""
    finite = np.isfinite(linear.residual)
    residual = whiten(np.where(finite, linear.residual, 0.0))
    along, own = [], []
    for name in fitted_along(composed):
        moved, effect = linear.moved[name], composed.effects[name]
        sd = np.array([p.sd for p in effect.parameters.values()])
        neutral = np.array([p.nominal for p in effect.parameters.values()])
        columns = whiten(_finite(moved.jacobian)) * sd
        own += [effect.by_log] * sd.size
        along.append(columns)
        residual = residual + columns @ ((moved.at - neutral) / sd)
    made = []
    for name in candidates:
        moved, effect = linear.moved[name], composed.effects[name]
        known = list(effect.parameters.values())
        shift = whiten(_finite(moved.shift))
        if name in linear.point:
            residual = residual + shift
        made.append(
            Candidate(
                name,
                tuple(effect.parameters),
                moved.at,
                np.array([p.nominal for p in known]),
                np.array([p.sd for p in known]),
                shift,
                whiten(_finite(moved.jacobian)),
                np.array([p.low for p in known]),
                np.array([p.high for p in known]),
            )
        )
    rows = linear.rows
    mine = GapRows(
        rows.log,
        rows.channel,
        phases.of(rows),
        rows.time,
        tuple(r.name for r in composed.recordings),
        rows.channels,
        phases.names,
        BANDS,
    )
    nuisance = np.concatenate([*along, np.zeros((rows.log.size, 0))], 1)
    whole = Gap(mine, residual, nuisance, tuple(made), own=tuple(int(k) for k in np.flatnonzero(own)))
    return whole if finite.all() else whole.taken(np.flatnonzero(finite))


def _finite(values: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(values), values, 0.0)
