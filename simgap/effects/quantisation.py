"""Forces rounded to a step."""

from __future__ import annotations

import numpy as np

from simgap.effects.base import READOUT, Effect, Parameter

REPEATED = 0.5  # chosen: share of repeated values that only a lattice has
WRITTEN = 1e-5  # prior: N; how finely forces are written that were not rounded before


def _scatter(given, residual: np.ndarray):
    """Whether forces repeat the same values: levels of a lattice through zero.

    Written to 1e-5 N, as files are, one sample in ten repeats another's value by chance; on a lattice
    most do. The step is the usual gap between neighbouring levels, refined on all samples. Values that
    were not rounded would all fall on levels so far apart with a chance of WRITTEN / step each.
    """
    from simgap.gap.rounding import rounded_variance
    from simgap.gap.scatter import Scatter

    read = np.concatenate([force.ravel() for force in given.frame.forces])
    values = read[np.isfinite(read)]
    levels = np.unique(np.round(np.abs(values), 6))
    if 1 - levels.size / values.size < REPEATED or levels.size < 4:
        return None
    step = float(np.median(np.diff(levels)))
    for reach in (4, 16, 64, 256):  # farther levels tell the step ever more closely
        count = np.round(values / step)
        near = (np.abs(count) <= reach) & (count != 0)
        if near.any():
            step = float(values[near] @ count[near] / (count[near] @ count[near]))
    off = np.abs(values / step - np.round(values / step))
    if np.mean(off < 0.1) < 0.9:
        return None
    known = float(4 * sum(given.frame.lengths) * np.log(step / WRITTEN))
    return Scatter("quantisation", step, 1e-3, rounded_variance(given, step), known)


EFFECT = Effect(
    name="quantisation",
    acts_on="sensing",
    says="recorded F = step * round(F / step)",
    shows="plateaus; repeated values",
    mistaken_for=("noise",),
    called="coarse steps in the force readings",
    check="Check the range and resolution of the converter: list the distinct values in a quiet stretch.",
    parameters=(Parameter("step", "N", 1.0, neutral=0.05, log=True, low=1e-3, high=0.5),),
    stage=READOUT,
    scatter=_scatter,
    finish=lambda force, v: v["step"] * np.round(force / v["step"]),
    wrist=True,
)
