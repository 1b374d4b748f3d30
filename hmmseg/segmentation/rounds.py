"""Repeated tasks: cut a recording into rounds, each then a trial of a single round.

The task's chain is closed: the next round may begin from the free motion after the last move, and also from
any state reached by departing from the chain, so that a failing round does not spoil the others. One Viterbi
path over the few states of the chain finds the rounds, at a cost linear in the length of the recording
whatever their number. Long recordings are read from disk round by round.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hmmseg.contact.decompose import FREE, Subtask, subtasks
from hmmseg.hand.read import LongRecording
from hmmseg.hand.signals import Signals, come_late, differenced, group_size, task_space
from hmmseg.hmm import dense
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.segmentation.conformity import DEPARTURE, Conformity, assignments, column, departing, settled
from hmmseg.segmentation.emissions import MAX_RATE, Features, thin
from hmmseg.segmentation.free_contacts import FreeContacts, fit_free_contacts

MARGIN = 64  # numerics: rows read on either side of a part, for differences of its neighbours


class OnDisk:
    """Signals that are read anew at every access.

    Whether velocities are late is judged from the beginning, as a drive keeps its habits.
    """

    def __init__(self, recording: LongRecording, rig: Rig) -> None:
        self.recording, self.rig = recording, rig
        self._late = come_late(recording.beginning())

    @property
    def t(self) -> np.ndarray:
        """Times (num_timesteps,) [s]."""
        return self.recording.t

    def read(self, start: int, stop: int) -> Signals:
        """Signals of samples `start` to `stop`."""
        low, high = max(start - MARGIN, 0), min(stop + MARGIN, self.t.size)
        signals = task_space(self.recording.rows(low, high), self.rig)
        if self._late:
            signals = differenced(signals)
        return part(signals, slice(start - low, stop - low))

    def thinned(self) -> Signals:
        """The whole recording, thinned as by `thin`."""
        rate = self.recording.rate
        step = group_size(rate, MAX_RATE)
        size = max(self.recording.piece // step, 1) * step
        pieces = [
            thin(self.read(start, min(start + size, self.t.size)), rate=rate)
            for start in range(0, self.t.size, size)
        ]
        arrays = [name for name, value in vars(pieces[0]).items() if isinstance(value, np.ndarray)]
        joined: dict[str, Any] = {n: np.concatenate([getattr(p, n) for p in pieces]) for n in arrays}
        return replace(pieces[0], **joined)


Recorded = Signals | OnDisk
GLANCE = 4096  # numerics: samples used to match the recording's blocks with objects


def one_round(task: BlockTask) -> BlockTask:
    """The task performed once."""
    return replace(task, repeat=1)


def round_tasks(task: BlockTask, number: int) -> list[BlockTask]:
    """Each round as a task of its own, starting from where the blocks then stand."""
    support, out = dict(task.initial), []
    for _ in range(number):
        out.append(BlockTask(dict(support), task.moves))
        for move in task.moves:
            support[move.object] = move.to
    return out


def find_cuts(f: Features, task: BlockTask) -> list[float]:
    """Times [s] within the free motions between the rounds of one recording, in order; none for one round.

    `f` needs no more than emissions' MAX_RATE.
    """
    free = fit_free_contacts(f, any(move.slide for move in task.moves))
    steps = subtasks(one_round(task))
    leave = min(0.5, max(4 * len(free.gripped) + 1, len(steps)) / len(f.t))
    candidates = assignments(free, steps)
    best = 0
    if len(candidates) > 1:  # the table of a long recording is large, so compare on its beginning
        glance = replace(free, table=free.table[:GLANCE])
        tables = [_closed(glance, steps, each, leave) for each in candidates]
        best = int(np.argmax([dense.log_evidence(table, *model) for table, model in tables]))
    table, model = _closed(free, steps, candidates[best], leave)
    num_states = len(steps) + len(free.states)
    path = dense.viterbi(table, *model).path % num_states
    states = np.array([s.state for s in steps] + [state for state, _ in free.states])
    open_ = (states == FREE)[path]
    begins = np.flatnonzero((path[1:] == 1) & open_[:-1]) + 1
    if begins.size and (~open_[: begins[0]]).any():
        begins = np.r_[-1, begins]  # a block held before the first whole round is a truncated round
    cuts = []
    for begin in begins[1:]:
        held = np.flatnonzero(~open_[:begin])
        before = held[-1] + 1 if held.size else 0  # the first sample of the free motion before the round
        cuts.append(float(f.t[(before + begin) // 2]))
    return cuts


def _closed(
    free: FreeContacts, steps: Sequence[Subtask], assignment: dict[str, int | None], leave: float
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Log-likelihoods and model of the closed chain, which restarts after its end, with settling stages."""
    columns = [column(free, s, assignment) for s in steps]
    initial, transition = departing(free.states, columns, leave)
    k = len(steps)
    for i, step in enumerate(steps[:-1]):
        if step.state == FREE and i > 0:  # a round abandoned between two moves
            transition[i, 1] = np.log(leave * DEPARTURE)
    transition[k - 1, 1] = np.log(leave)
    transition[k + free.states.index((FREE, None)), 1] = np.log(leave / 2)
    table, _, model = settled(free, columns, initial, transition)
    return table, model


def slices(t: np.ndarray, cuts: Sequence[float]) -> list[slice]:
    """Samples of each round, given t (num_timesteps,) [s]."""
    edges = [0, *np.searchsorted(t, cuts), t.size]
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]


def part(recorded: Recorded, samples: slice) -> Signals:
    """A stretch of a recording."""
    if isinstance(recorded, OnDisk):
        return recorded.read(samples.start, samples.stop)
    sliced: dict[str, Any] = {k: v[samples] for k, v in vars(recorded).items() if isinstance(v, np.ndarray)}
    return replace(recorded, **sliced)


def merge_point(verdicts: Sequence[Conformity], times: Sequence[np.ndarray]) -> int | None:
    """Which round to merge with its successor if there is one too many; None if all fit.

    Among failing rounds, the one whose next grip follows soonest: a block gripped again. `times` [s] are
    those of the samples judged.
    """
    waits = {}
    for r in range(len(verdicts) - 1):
        if verdicts[r].failing is not None:
            held = [run for run in verdicts[r].runs if run.state != FREE]
            then = [run for run in verdicts[r + 1].runs if run.state != FREE]
            released = times[r][held[-1].stop - 1] if held else times[r][0]
            waits[r] = float((times[r + 1][then[0].start] if then else times[r + 1][-1]) - released)
    return min(waits, key=lambda r: waits[r], default=None)
