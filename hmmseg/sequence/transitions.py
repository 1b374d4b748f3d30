"""Transitions of a plain ordered task: memoryless durations, states that may be skipped.

Durations are geometric on the grid with a learned mean: the one law that a crop at the start does
not disturb, and a wide one, so that the clock does not decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmmseg.hmm import Chain


@dataclass(frozen=True)
class Transitions:
    """Band-limited transitions, of which a chain of hmmseg.hmm is made.

    `bands[d]` (num_states - d,): log weight of going from k to k + d between neighbouring cells;
    `log_initial`, `log_final` (num_states,).
    """

    bands: tuple[np.ndarray, ...]
    log_initial: np.ndarray
    log_final: np.ndarray

    def chain(self, bands: tuple[np.ndarray, ...] | None = None) -> Chain:
        """The chain; with other bands, if given, that may vary in time."""
        stay, advance, *skips = self.bands if bands is None else bands
        return Chain(stay, advance, skips or None, log_initial=self.log_initial, log_final=self.log_final)


def transitions(mean_cells: np.ndarray, presence: np.ndarray, optional: Sequence[bool]) -> Transitions:
    """Transitions from mean durations [cells] and the probability that an optional state occurs."""
    num_states = len(mean_cells)
    skippable = np.asarray(optional, bool)
    present = np.where(skippable, np.log(presence), 0.0)
    absent = np.where(skippable, np.log1p(-np.where(skippable, presence, 0.5)), -np.inf)
    leave = 1.0 / np.maximum(mean_cells, 1.5)
    stay = np.log1p(-leave)
    stay[-1] = 0.0  # the last state lasts as long as the recording does
    jumps = [stay]
    for d in range(1, max(2, _longest_run(skippable) + 2)):
        band = np.array([
            np.log(leave[k]) + absent[k + 1 : k + d].sum() + present[k + d] for k in range(num_states - d)
        ])  # fmt: skip
        jumps.append(band)
    initial = np.array([absent[:k].sum() + present[k] for k in range(num_states)])
    final = np.array([absent[k + 1 :].sum() for k in range(num_states)])
    return Transitions(tuple(jumps), initial, final)


def _longest_run(flags: np.ndarray) -> int:
    longest = run = 0
    for flag in flags:
        run = run + 1 if flag else 0
        longest = max(longest, run)
    return longest
