"""Block tasks compared with given simulated trials: task-space channels, cut at contact changes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import align
from simgap.generic.aligned import Cut, Ensembles

CHANNELS = ("x", "y", "distance", "offset", "vx", "vy", "fx", "fy", "grip", "shear")


def block_ensembles(real: Sequence[Trial], sim: Sequence[Trial], task: BlockTask, rig: Rig) -> Ensembles:
    """Both kinds aligned apart, each by its own fit; InputError where one has no complete trial."""
    cuts: list[list[Cut]] = [[], []]
    warnings, names = [], ()
    for kind, trials in enumerate((real, sim)):
        for one in align(trials, task, rig).trials:
            trial, signal, found = one.trial, one.signals, one.segmentation
            if not found.complete:
                warnings.append(f"{trial.name}: does not fit its task and is left out")
                continue
            names = tuple(s.label for s in found.spans)
            edges = np.array([found.spans[0].start, *(s.end for s in found.spans)])
            channels = {c: np.asarray(getattr(signal, c)) for c in CHANNELS}
            cuts[kind].append(Cut(Trial(trial.file, np.asarray(signal.t), channels), edges))
        if not cuts[kind]:
            raise InputError(trials[0].file, "does not fit its task", "a recording that shows every subtask")
    if len(real) + len(sim) < 3:
        raise InputError("trials", "one real and one simulated", "more of one kind at least")
    return Ensembles(names, CHANNELS, tuple(cuts[0]), tuple(cuts[1]), tuple(warnings))
