"""What a task determines of its heights: single ones, and sums of several where no single one is.

The rises of the recorded moves are integer combinations of heights. Exact elimination (reduced row
echelon form in fractions) gives the heights that are determined on their own; what is left of the
row space is described by the simplest combinations among the rises themselves and the rows of the
echelon form: few terms, no minus signs, small coefficients.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from math import gcd, lcm

Terms = dict[str, int]


def simplest_combinations(rows: Iterable[Mapping[str, int]], order: Sequence[str]) -> list[Terms]:
    """Independent integer combinations of the unknowns in `order` that span `rows`, single ones first.

    Each is {unknown: coefficient} with coprime coefficients, the first of them positive.
    """
    given = [
        _whole({k: Fraction(v) for k, v in row.items() if v}, order) for row in rows if any(row.values())
    ]
    echelon = [_whole(row, order) for row in _echelon([_fractions(row) for row in given], order)]
    single = [row for row in echelon if len(row) == 1]
    known = {name for row in single for name in row}
    rest = [{k: v for k, v in row.items() if k not in known} for row in given]
    left = [_whole(_fractions(row), order) for row in rest if row] + [r for r in echelon if len(r) > 1]
    chosen = list(single)
    for row in sorted(left, key=_complexity):
        if len(_echelon([_fractions(r) for r in [*chosen, row]], order)) > len(chosen):
            chosen.append(row)
    return sorted(single, key=lambda row: order.index(next(iter(row)))) + chosen[len(single) :]


def _complexity(row: Terms) -> tuple[int, bool, int]:
    return len(row), any(v < 0 for v in row.values()), sum(abs(v) for v in row.values())


def _fractions(row: Mapping[str, int]) -> dict[str, Fraction]:
    return {k: Fraction(v) for k, v in row.items()}


def _echelon(rows: list[dict[str, Fraction]], order: Sequence[str]) -> list[dict[str, Fraction]]:
    """Rows of the reduced row echelon form, pivots in `order`."""
    pivots: dict[str, dict[str, Fraction]] = {}
    for row in rows:
        for name, pivot in pivots.items():
            if name in row:
                row = _minus(row, row[name], pivot)
        if not row:
            continue
        lead = next(name for name in order if name in row)
        row = {k: v / row[lead] for k, v in row.items()}
        pivots = {k: _minus(p, p[lead], row) if lead in p else p for k, p in pivots.items()}
        pivots[lead] = row
    return list(pivots.values())


def _minus(a: dict[str, Fraction], factor: Fraction, b: dict[str, Fraction]) -> dict[str, Fraction]:
    out = {k: a.get(k, Fraction(0)) - factor * b.get(k, Fraction(0)) for k in a | b}
    return {k: v for k, v in out.items() if v}


def _whole(row: Mapping[str, Fraction], order: Sequence[str]) -> Terms:
    """The same direction with coprime whole coefficients, the first positive."""
    terms = {name: row[name] for name in order if name in row}
    common = lcm(*(v.denominator for v in terms.values()))
    whole = {k: int(v * common) for k, v in terms.items()}
    share = gcd(*whole.values())
    sign = 1 if next(iter(whole.values())) > 0 else -1
    return {k: sign * v // share for k, v in whole.items()}
