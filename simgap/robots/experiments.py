"""The next experiment: of the motions that the robot has run, the one that tells a set apart best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.attribution.heldout import residual_left
from simgap.attribution.posterior import Forms, fitted
from simgap.attribution.verdict import Verdict


@dataclass(frozen=True)
class NextLog:
    """A log whose motion is to be repeated, the effects it separates, and what it is expected to gain."""

    log: str
    separates: tuple[str, ...]
    gain: float


def next_log(f: Forms, verdict: Verdict, logs: Sequence[str]) -> NextLog | None:
    """For a set: of its members' best fits, the log along which the closest two differ most, whitened.

    None where nothing is to be separated, or no motion is expected to gain a nat.
    """
    if verdict.verdict != "set":
        return None
    names = [c.name for c in f.gap.candidates]
    causes = tuple(sorted(names.index(n) for n in verdict.causes))
    best = f.spectrum.columns[:, 0] - residual_left(f, fitted(f, causes))
    gains = np.zeros(len(logs))
    trial = f.gap.rows.trial
    smallest = np.inf
    for rival in verdict.indistinguishable:
        for out in causes:
            other = tuple(sorted({*(j for j in causes if j != out), names.index(rival)}))
            apart = best - (f.spectrum.columns[:, 0] - residual_left(f, fitted(f, other)))
            each = 0.5 * np.bincount(trial, apart**2, len(logs))
            if each.sum() < smallest:
                smallest, gains = float(each.sum()), each
    at = int(gains.argmax())
    if gains[at] < 1.0:
        return None
    return NextLog(logs[at], (*verdict.causes, *verdict.indistinguishable), float(gains[at]))
