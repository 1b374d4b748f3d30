"""Recordings that seem not to fit their task because of what is wrong with the hand.

A turned sensor or a slow filter can make a carried block look as if it lay on the ground. Such trials are
aligned as if they fitted; what then explains them best is taken out, and if they fit without it, they do.
"""

from __future__ import annotations

from collections.abc import Sequence

from hmmseg.io.rig import Rig
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import AlignedTrials, align
from simgap.effects import decoys
from simgap.gap.bank import Bank
from simgap.gap.candidates import best_fits
from simgap.gap.fit import Start, fit, neutral, problem
from simgap.gap.frame import build
from simgap.gap.realign import realigned

TRIED = 3  # leading candidates that are taken out in turn, and decoys after them
ROUNDS = 2  # times that the fit is repeated with the boundaries it gives
HOPELESS = 1e4  # times the noise's square, in the mean: no effect of a hand, but another task


def insisted(
    trials: Sequence[Trial],
    failed: AlignedTrials,
    rig: Rig,
    bank: Bank,
    actual: dict | None,
    wanted: Sequence[tuple[str, ...]],
) -> tuple[AlignedTrials, list[str]]:
    """Another alignment of trials that all `failed`, if most fit their task without one of the candidates.

    Where none of them helps, `failed` as it is. The second is a warning that says so.
    """
    aligned = align(trials, failed.task, rig, insist=True)
    for _ in range(ROUNDS):
        given = problem(build(trials, aligned, rig), bank.noise, actual)
        healthy = fit(given, [Start((), neutral(given))])[0]
        if healthy.square.sum() > HOPELESS * given.size:
            break
        found = sorted(best_fits(given, wanted, healthy), key=lambda f: f.cost)
        decoy = [f for f in found if f.effects[0] in decoys()]
        for f in [f for f in found if f not in decoy][:TRIED] + decoy[:TRIED]:
            again = realigned(trials, given, f)
            if 2 * sum(t.segmentation.complete for t in again.trials) > len(trials):
                why = failed.trials[0].segmentation.failed
                return again, [f"{why}; without {' + '.join(f.effects)} it fits"]
        aligned = realigned(trials, given, found[0], insist=True)
    return failed, []
