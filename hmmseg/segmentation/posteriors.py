"""Posteriors of the boundaries of an aligned trial, and its spans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from hmmseg.contact.decompose import FREE, Subtask
from hmmseg.hand.signals import Signals
from hmmseg.hmm.alignment import AlignmentPosterior
from hmmseg.levels import DRIFTS
from hmmseg.segmentation.boundaries import BoundaryPosterior, combine, normal
from hmmseg.segmentation.changes import Change, Disagreement, Prior
from hmmseg.segmentation.crossings import contacts
from hmmseg.segmentation.emissions import Parameters
from hmmseg.segmentation.moment import moment
from hmmseg.segmentation.motions import Kind
from hmmseg.segmentation.pads import Sensing
from hmmseg.segmentation.spans import Span
from hmmseg.segmentation.tilt import corner_drops

INTERVAL = (0.05, 0.95)  # physics: a definition: the central 90 %
NEARBY = 0.15  # chosen: s; a touch known apart from forces this near a boundary is that boundary
Touches = tuple[tuple[float, float], ...]


def contact_changes(
    signals: Signals, thinned: Signals, sensing: Sensing, steps: tuple[Subtask, ...], parameters: Parameters,
    posterior: AlignmentPosterior,
) -> list[Change | None]:  # fmt: skip
    """What one trial shows of each of its boundaries; None where its signals say nothing of it.

    `signals` are those that locate contacts, `thinned` those that were aligned.
    """
    t = thinned.t
    path = posterior.smoothed.argmax(axis=1)
    last = np.searchsorted(path, np.arange(len(steps) - 1), side="right") - 1
    edges = [float(t[0]), *t[last], float(t[-1])]
    drop = corner_drops(signals, sensing.pads, list(pairwise(edges)), steps)
    table = contacts(signals, sensing, parameters, drop)
    out = []
    for k in range(len(steps) - 1):
        probability = posterior.moves[0][:, k]
        prior = Prior(t, probability, (edges[k], edges[k + 2]))
        n = int(probability.argmax())
        out.append(table.change(steps[k], steps[k + 1], prior, _held_side(t, path, steps, k, n)))
    return out


def boundary_posteriors(
    changes: Sequence[Change | None], known: Mapping[tuple[Kind, int], Disagreement], t: np.ndarray,
    posterior: AlignmentPosterior, touches: Touches = (),
) -> tuple[BoundaryPosterior, ...]:  # fmt: skip
    """Posterior of each boundary of one trial, aligned at t (num_timesteps,) [s].

    `touches` [s]: times, and sds, of touches and releases known apart from forces.
    """
    found = []
    for k, change in enumerate(changes):
        if change is None:
            found.append(combine(t, posterior.moves[0][:, k], {}))
        else:
            posted = moment(change, known.get(change.sort, Disagreement()))
            found.append(nearest_touch(touches, posted) if len(change.contacts) > 1 else posted)
    return tuple(found)


def nearest_touch(touches: Touches, found: BoundaryPosterior) -> BoundaryPosterior:
    """The touch or release that is known apart from forces where there is one nearby, else as it is."""
    middle = found.quantile(0.5)
    for time, sd in sorted(touches, key=lambda touch: abs(touch[0] - middle))[:1]:
        if abs(time - middle) < max(NEARBY, 3 * sd, 3 * found.sd):
            return normal(time, sd)
    return found


def _held_side(
    t: np.ndarray, path: np.ndarray, steps: tuple[Subtask, ...], k: int, n: int
) -> tuple[float, float]:
    """Stretch [s] nearest to interval n of the subtask that rests on the ground beside it."""
    after = steps[k].state == FREE or steps[k + 1].name == "place"
    own = np.flatnonzero(path == (k + 1 if after else k))
    if after:
        return t[n + 1], min(t[n + 1] + DRIFTS, max(t[own[-1]] if own.size else 0.0, t[n + 1]))
    return max(t[n] - DRIFTS, min(t[own[0]] if own.size else np.inf, t[n])), t[n]


def to_spans(
    steps: tuple[Subtask, ...], boundaries: tuple[BoundaryPosterior, ...], first: float, last: float
) -> tuple[Span, ...]:
    """Spans between boundary medians, kept in order."""
    medians = np.maximum.accumulate([first, *(b.quantile(0.5) for b in boundaries), last])
    sds = [0.0, *(b.sd for b in boundaries), 0.0]
    intervals = [(first, first), *(tuple(b.quantile(q) for q in INTERVAL) for b in boundaries), (last, last)]
    return tuple(
        Span(s.name, s.object, s.state, float(medians[i]), float(medians[i + 1]),
             sds[i], sds[i + 1], intervals[i], intervals[i + 1])
        for i, s in enumerate(steps)
    )  # fmt: skip
