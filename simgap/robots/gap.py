"""The gap that attribution is asked about: whitened rows, what is fitted along, and candidates."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from simgap.attribution.problem import BANDS, Candidate, Gap
from simgap.attribution.problem import Rows as GapRows
from simgap.robots.linear import Linear
from simgap.robots.model import Composed
from simgap.robots.phases import Phases
from simgap.robots.whiten import Whitener


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
    along = fitted_along(composed)
    known = [p for n in along for p in composed.effects[n].parameters.values()]
    sd, neutral = np.array([p.sd for p in known]), np.array([p.nominal for p in known])
    at = np.array([v for n in along for v in linear.moved[n].at])
    own = [composed.effects[n].by_log for n in along for _ in composed.effects[n].parameters]
    # Columns are whitened together: there are hundreds of blocks, and time goes into the calls.
    columns = [np.zeros((finite.size, 0)), *(_finite(linear.moved[n].jacobian) for n in along)]
    nuisance = whiten(np.concatenate(columns, 1)) * sd
    residual = residual + nuisance @ ((at - neutral) / sd)
    made = []
    for name in candidates:
        moved, effect = linear.moved[name], composed.effects[name]
        known = list(effect.parameters.values())
        both = whiten(_finite(np.column_stack([moved.shift, moved.jacobian])))
        if name in linear.point:
            residual = residual + both[:, 0]
        made.append(
            Candidate(
                name,
                tuple(effect.parameters),
                moved.at,
                np.array([p.nominal for p in known]),
                np.array([p.sd for p in known]),
                both[:, 0],
                both[:, 1:],
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
    told = whiten.counted(finite.size) if isinstance(whiten, Whitener) else None
    whole = Gap(
        mine, residual, nuisance, tuple(made), own=tuple(int(k) for k in np.flatnonzero(own)), told=told
    )
    return whole if finite.all() else whole.taken(np.flatnonzero(finite))


def _finite(values: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(values), values, 0.0)
