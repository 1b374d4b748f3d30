"""Phases of logs: stretches by name, given by a task or told by motion alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simgap.robots.rows import Rows
from simgap.robots.windows import FREE, moves, reaches
from simgap.simulators.protocol import Simulator
from simgap.simulators.recording import Recording

WHOLE = "whole"


@dataclass(frozen=True)
class Phases:
    """`names` of phases, and of each log its boundaries [s] (ascending) with the phase that begins there.

    `free` are phases without contacts, where others have some: a window in which anything touches is none of
    them, for what a contact does goes on after it.
    """

    names: tuple[str, ...]
    starts: tuple[np.ndarray, ...]
    number: tuple[np.ndarray, ...]
    free: frozenset[int] = frozenset()

    def of(self, rows: Rows) -> np.ndarray:
        """The phase (N,) of each row."""
        out = np.zeros(rows.log.size, int)
        for log in np.unique(rows.log):
            mine = rows.log == log
            at = np.searchsorted(self.starts[log], rows.time[mine], side="right") - 1
            found = self.number[log][np.maximum(at, 0)]
            wrong = np.isin(found, list(self.free)) & rows.touching[mine]
            right = np.flatnonzero(~np.isin(found, list(self.free)))
            if wrong.any() and right.size:
                before = np.maximum(np.searchsorted(right, np.flatnonzero(wrong)) - 1, 0)
                found = np.array(found)
                found[wrong] = found[right[before]]
            out[mine] = found
        return out


def one_phase(recordings: Sequence[Recording]) -> Phases:
    """Every log is one phase."""
    first = tuple(np.array([r.t[0]]) for r in recordings)
    return Phases((WHOLE,), first, tuple(np.zeros(1, int) for _ in recordings))


MANY = 4  # chosen: states of contact that are told apart at most, those that last longest


def phases_of(simulator: Simulator, recordings: Sequence[Recording]) -> Phases:
    """By motion, and where the simulator tells contacts, by what touches: a model is off by more there."""
    moving = phases_by_motion(simulator, recordings)
    states = getattr(simulator, "contact_states", None)
    labelled = [] if states is None else [states(log) for log in recordings]
    common = Counter(label for _, labels in labelled for label in labels).most_common()
    if len(common) < 2:
        return moving
    kept = [label for label, _ in common[:MANY]]
    names, starts, numbers = {}, [], []
    for number, (log, (times, labels)) in enumerate(zip(recordings, labelled, strict=True)):
        going = np.searchsorted(moving.starts[number], times, side="right") - 1
        motion = [moving.names[k] for k in moving.number[number][np.maximum(going, 0)]]
        both = [f"{m}, {k if k in kept else OTHER}" for m, k in zip(motion, labels, strict=True)]
        changes = [i for i in range(len(both)) if i == 0 or both[i] != both[i - 1]]
        starts.append(np.array([log.t[0], *times[changes[1:]]]))
        numbers.append(np.array([names.setdefault(both[i], len(names)) for i in changes]))
    free = frozenset(k for name, k in names.items() if name.endswith(f", {FREE}"))
    return Phases(tuple(names), tuple(starts), tuple(numbers), free)


OTHER = "other contacts"


def phases_by_motion(simulator: Simulator, recordings: Sequence[Recording]) -> Phases:
    """`still` and `moving`: half seconds in which any position goes further than a hundredth of its range."""
    reach = reaches(simulator, recordings)
    if not reach:
        return one_phase(recordings)
    starts, numbers = [], []
    for log in recordings:
        edges = np.arange(log.t[0], log.t[-1], min(0.5, 0.25 * float(log.t[-1] - log.t[0])))
        rows = np.searchsorted(log.t, edges)
        ends = np.append(rows[1:], len(log))
        going = [moves(log, int(a), int(b), reach) for a, b in zip(rows, ends, strict=True)]
        changes = np.flatnonzero(np.diff(np.array(going, int), prepend=-1))
        starts.append(edges[changes])
        numbers.append(np.array(going, int)[changes])
    return Phases(("still", "moving"), tuple(starts), tuple(numbers))
