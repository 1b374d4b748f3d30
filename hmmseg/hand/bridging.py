"""Where a hand was while some of its coordinates are missing: interpolated, coordinate by coordinate.

A height takes four link angles. Where two readings in five are missing, all four are there in one sample of
eight, though each of them is known well enough from its neighbours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import Rig
from hmmseg.io.trial import Trial
from hmmseg.robust import bridged


def with_heights(signals: Signals, trial: Trial, rig: Rig) -> Signals:
    """The signals with heights wherever coordinates can be interpolated over time.

    Only for what a fraction of a hand's way decides: an interpolated height has an error of its own.
    """
    names = ("q11", "q12", "q21", "q22") if rig.jointed else ("y1", "y2")
    known = {name: np.isfinite(trial.channels[name]) for name in names}
    if all(k.all() for k in known.values()) or not all(k.any() for k in known.values()):
        return signals
    filled = {name: bridged(trial.channels[name], trial.t) for name in names}
    whole = task_space(replace(trial, channels=trial.channels | filled), rig)
    return replace(signals, y1=whole.y1, y2=whole.y2, sd_y=whole.sd_y)
