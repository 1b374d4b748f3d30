"""What is no gap: an accident of one trial, and single samples beside contact changes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from simgap.effects import catalogue
from simgap.gap.fit import Fitted, Problem, residual_at
from simgap.gap.locate import subtask_name

WILD, LOUD = 5.0, 3.0  # sd; an event reaches the first and goes on while samples exceed the second
BESIDE = 0.015  # share of residuals beside contact changes that may be left out of the fits
EVENTS = 0.03  # share of residuals that may be left out as events
RECURS = 3  # trials at least, to tell an event from an effect
SOLE = 1.5  # times the other trials' largest residual there, before anything is explained
CALM = 1.3  # mean square that a candidate leaves elsewhere, at most, if it explains all but an event


def odd(
    given: Problem, fits: Sequence[Fitted], healthy: Fitted
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """What no candidate explains and is no gap: single residuals beside contact changes, and events.

    Both (T, N, C), None where there are none. An effect recurs: what is wild in one of several trials and
    in none of the others (a finger that brushes a block) is an event. More than a few are a gap to be
    explained.
    """
    known = [f for f in fits if f.effects[0] in catalogue()]
    leading = [healthy, *sorted(known, key=lambda f: f.cost)[:3]]
    each = [np.abs(residual_at(given, f.effects, f.u)) for f in leading]
    least = np.min(each, axis=0)
    there, edge = given.whitening.weight > 0, (given.frame.arrays.kind % 2 == 1)[..., None]
    beside = there & edge & (least > WILD)
    event = _events(given, np.where(edge, np.minimum(least, WILD), least), each[0], each[1:2])
    return tuple(
        found if 0 < found.sum() <= most * given.size else None
        for found, most in ((beside, BESIDE), (there & event[..., None], EVENTS))
    )  # type: ignore[return-value]


def _events(given: Problem, least: np.ndarray, before: np.ndarray, best: Sequence[np.ndarray]) -> np.ndarray:
    """Samples (T, N) of events, from residuals (T, N, C): the least that leading candidates leave, those
    without any effect, and those of the best candidate if there is one.

    A wrong candidate may explain what recurs in all trials but one. So an event is larger than what the other
    trials have there before anything is explained, or all that a candidate leaves which else leaves noise.
    """
    there, subtask = given.whitening.weight > 0, given.frame.arrays.subtask
    if given.frame.num_trials < RECURS:
        return np.zeros(subtask.shape, bool)
    count = len(given.frame.steps)
    odd_one = least.max(2)

    def most(values: np.ndarray) -> np.ndarray:
        largest = np.where(there, values, 0.0).max(2)
        return np.stack([np.where(subtask == s, largest, 0.0).max(1) for s in range(count)], 1)

    hit, had = most(least) > WILD, most(before)
    others = np.stack([np.delete(had, r, axis=0).max(0) for r in range(len(had))])
    alone = hit & (hit.sum(0) == 1)
    calm = [z for z in best if np.mean(z[there & ~_at(alone, subtask)[..., None]] ** 2) < CALM]
    alone = _at(alone if calm else alone & (had > SOLE * others), subtask)
    moments, loud = alone & (odd_one > WILD), alone & (odd_one > LOUD)
    while True:
        near = moments.copy()
        near[:, 1:] |= moments[:, :-1]
        near[:, :-1] |= moments[:, 1:]
        if not (near & loud & ~moments).any():
            return near
        moments |= near & loud


def _at(cell: np.ndarray, subtask: np.ndarray) -> np.ndarray:
    """What trials and subtasks (T, S) have, at their samples (T, N)."""
    return np.take_along_axis(cell, subtask, axis=1)


def told(given: Problem, event: np.ndarray) -> list[str]:
    """A warning for every trial and subtask with an event."""
    frame, out = given.frame, []
    for r in range(frame.num_trials):
        when = event[r].any(1)
        for s in np.unique(frame.arrays.subtask[r, when]):
            t = frame.world.t[r, when & (frame.arrays.subtask[r] == s)]
            out.append(
                f"{frame.files[r]}: {subtask_name(frame.steps[s])}, {t[0]:.2f} to {t[-1]:.2f} s: an event of "
                "this trial alone, left out"
            )
    return out
