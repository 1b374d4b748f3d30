"""Trials of hands that roll while they carry, read as if they had not."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from hmmseg.contact.equations import pads_of
from hmmseg.hand.roll import with_roll
from hmmseg.io.trial import ROLL
from hmmseg.segmentation.align import AlignedTrials, TrialAlignment
from hmmseg.segmentation.posteriors import tilts

# Of velocities only means are read, which a roll leaves alone.
TURNED = ("x1", "y1", "x2", "y2", "fx1", "fy1", "fx2", "fy2")


def without_roll(aligned: AlignedTrials) -> AlignedTrials:
    """The same with what each carry shows of a roll taken out of trials and signals.

    Trials whose roll was recorded are level as they were read.
    """
    return replace(aligned, trials=tuple(_levelled(trial, aligned) for trial in aligned.trials))


def _levelled(trial: TrialAlignment, aligned: AlignedTrials) -> TrialAlignment:
    s = trial.signals
    if ROLL in trial.trial.channels or trial.trial.inertia is not None:
        return trial  # a wrist's fingers are made up level
    medians = [b.quantile(0.5) for b in trial.boundaries]
    edges = np.maximum.accumulate([float(s.t[0]), *medians, float(s.t[-1])])
    ends = list(pairwise(edges))
    roll = np.zeros(s.t.size)
    for inside, tilt, _ in tilts(s, pads_of(aligned.rig), ends, aligned.subtasks):
        roll[inside] = np.nan_to_num(tilt)
    if not roll.any():
        return trial
    level = with_roll(trial.trial, roll)
    changed = {name: level.channels[name] for name in TURNED}
    return replace(trial, trial=level, signals=replace(s, **changed))
