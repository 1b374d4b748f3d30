"""A boundary between two subtasks from the rows around it, as the alignment off line reads them.

The filter knows a boundary to a sample of its own pace; where a block is lifted, or samples are far apart,
the contact equations say more: the alignment of the two subtasks alone, with the crossing between samples
(hmmseg.segmentation.boundaries), under the parameters that the filter has learned.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from hmmseg.contact.decompose import FREE, ON_GROUND, SLIDING, Subtask
from hmmseg.hand.signals import task_space
from hmmseg.hmm import left_to_right, smooth
from hmmseg.io.trial import Trial
from hmmseg.levels import DRIFTS
from hmmseg.online import layout as at
from hmmseg.segmentation.boundaries import combine
from hmmseg.segmentation.changes import Disagreement, Prior, moment
from hmmseg.segmentation.emissions import MAX_RATE, WINDOW, Parameters, features, log_likelihoods, thin
from hmmseg.segmentation.pads import sense
from hmmseg.segmentation.posteriors import contacts, nearest_touch

if TYPE_CHECKING:
    from hmmseg.online.filter import Filter

NEAREST = round(DRIFTS * MAX_RATE)  # samples of a hold that locate the block next to a contact change
REACH = 0.6  # chosen: s before a boundary: what is read of the subtask that it ends
FINE = 100.0  # numerics: Hz; in faster recordings the filter itself places touches
SCALES: tuple[str, ...] = ("force", "carry", "net_x", "shear", "velocity", "level", "width")


def refined(
    filter_: Filter, h: np.ndarray, before: Subtask, after: Subtask, previous: float, mean: float, sd: float
) -> tuple[float, float] | None:
    """Median and sd [s] of a boundary that the filter places at `mean`; None where the rows say no more.

    `h`: the heaviest hypothesis; `previous`: the boundary before.
    """
    touch = before.state == FREE or after.name == "place"
    wrist = filter_.rig.gripper is not None
    start = max(mean - REACH, previous)
    rows = [each for each in filter_.rows if start <= each[0] <= mean + max(filter_.lag, REACH)]
    if len(rows) < 2 * NEAREST or filter_.failed_now:
        return None
    t = np.array([each[0] for each in rows])
    if touch and 1.0 / np.median(np.diff(t)) > FINE:
        return None
    read = np.array([each[1] for each in rows])
    names = [name for k, name in enumerate(filter_.channels) if not np.isnan(read[:, k]).all()]
    trial = Trial(
        "stream",
        t,
        {name: read[:, filter_.channels.index(name)] for name in names},
        touches=tuple(filter_.touches),
        timing=read[:, len(filter_.channels)] if wrist else None,
    )
    if set(filter_.channels) - set(names) - set(filter_.optional):
        return None
    signals = thin(task_space(trial, filter_.rig), MAX_RATE, WINDOW)
    if signals.t.size < NEAREST:
        return None
    parameters = _parameters(filter_, h)
    found = features(signals, filter_.rig)
    steps = (_numbered(before, 0), _numbered(after, 1))
    levels = {}
    for step in steps:
        side = signals.t < mean if step.index == 0 else signals.t > mean
        if step.state in (ON_GROUND, SLIDING) and side.any():
            near = found.block_y(parameters.bias)[side]
            near = near[-NEAREST:] if step.index == 0 else near[:NEAREST]
            if np.isfinite(near).any():
                levels[step.index] = float(np.nanmedian(near))
    parameters = Parameters(parameters.bias, parameters.weight, parameters.scale, parameters.width, (levels,))
    chain = left_to_right([signals.t.size / 2] * 2)
    try:
        posterior = smooth(log_likelihoods(found, steps, parameters, 0), chain)
    except ValueError:
        return None
    probability = posterior.boundary[:, 0]
    n, t = int(probability.argmax()), signals.t
    near = (t[n + 1], t[n + 1] + DRIFTS) if touch else (t[n] - DRIFTS, t[n])
    table = contacts(signals, sense([], [], (), parameters, filter_.rig), parameters)
    change = table.change(*steps, Prior(t, probability, (float(t[0]), float(t[-1]))), near)
    out = combine(t, probability, {}) if change is None else moment(change, Disagreement())
    if wrist and FREE in (before.state, after.state):
        out = nearest_touch(tuple(filter_.touches), out)
    median = out.quantile(0.5)
    if not math.isfinite(median) or abs(median - mean) > 3 * sd + 2 / MAX_RATE:
        return None  # another event than the filter's
    return median, out.sd


def _numbered(step: Subtask, index: int) -> Subtask:
    return Subtask(index, step.name, step.object, step.state, step.move, step.support, step.constraints)


def _parameters(filter_: Filter, h: np.ndarray) -> Parameters:
    """What a hypothesis has learned, under the names of the segmentation off line."""
    bias = h[at.BIAS : at.BIAS + 8 : 2] / h[at.BIAS + 1 : at.BIAS + 8 : 2]
    squared = h[at.SCALES : at.SCALES + 14 : 2] / h[at.SCALES + 1 : at.SCALES + 14 : 2]
    scale = dict(zip(SCALES, np.sqrt(squared).tolist(), strict=True))
    weight, width = {}, {}
    for o, name in enumerate(filter_.task.objects):
        own = h[at.OBJECTS + 4 * o : at.OBJECTS + 4 * o + 4]
        weight[name] = max(float(own[0] / own[1]), 1e-3) if own[1] > 0 else float(10 * scale["force"])
        if own[3] > 0:
            width[name] = float(own[2] / own[3])
    return Parameters(bias, weight, scale, width)
