"""Align again with an effect taken out: late or softened forces displace the boundaries themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Rig
from hmmseg.segmentation.align import AlignedTrials, align
from simgap.effects.base import tips
from simgap.gap.evaluation import world_without
from simgap.gap.fit import Fitted
from simgap.gap.problem import Problem
from simgap.gap.trial_arrays import thinned


def realigned(aligned: AlignedTrials, given: Problem, found: Fitted, all_fit: bool = False) -> AlignedTrials:
    """Boundaries of the trials in the frame, from signals that the candidate has been taken out of."""
    frame, rig, trials = given.frame, given.frame.rig, [a.trial for a in aligned.trials]
    world = world_without(given, found.effects, found.u)
    (position, velocity), force = tips(world), world.force
    rows = []
    for r, trial in enumerate(trials):
        n = frame.lengths[r]
        names = [f"{kind}{axis}{i}" for kind in ("", "v", "f") for i in (1, 2) for axis in "xy"]
        columns = np.concatenate([np.asarray(z[r, :n]) for z in (position, velocity, force)], 1)
        small, _ = thinned(trial, rig)
        rows.append(replace(task_space(small, rig), **dict(zip(names, columns.T, strict=True))))
    again = align(trials, frame.task, _hand(rig, world), all_fit, rows)
    return replace(again, rig=rig)


def _hand(rig: Rig, world) -> Rig:
    """The rig with the pads that the candidate gives it."""
    give = {
        "normal_stiffness": float(np.mean(world.give_normal)),
        "shear_stiffness": float(np.mean(world.give_shear)),
    }
    pads = {k: 1 / v for k, v in give.items() if v > 1e-7}
    return rig.model_copy(update={"fingertip": rig.fingertip.model_copy(update=pads)})


def moved(before: AlignedTrials, after: AlignedTrials) -> float:
    """Largest shift of a boundary [s]; infinite where a trial no longer fits its task."""
    shifts = []
    for a, b in zip(before.trials, after.trials, strict=True):
        if not b.segmentation.complete:
            return float("inf")
        shifts += [
            abs(p.quantile(0.5) - q.quantile(0.5)) for p, q in zip(a.boundaries, b.boundaries, strict=True)
        ]
    return max(shifts)
