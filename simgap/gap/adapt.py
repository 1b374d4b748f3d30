"""The bank for the recordings at hand: as learned, or moved to another rig by a linearised bootstrap."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmmseg.io.rig import Rig
from hmmseg.io.task import GROUND, BlockTask
from hmmseg.io.trial import Trial
from simgap.gap.bank import BOOTSTRAP, Bank
from simgap.gap.bootstrap import distribution, statistics
from simgap.gap.fit import Fitted, Problem
from simgap.gap.locate import STATISTICS, Detection

FARTHEST = 2.0  # factor by which a scale may change: beyond it the draws are not to be trusted


def rate_of(trials: Sequence[Trial]) -> float:
    """Sampling rate [Hz] of recordings to three digits, which is as closely as it matters."""
    return float(f"{np.median([t.rate for t in trials]):.3g}")


def fingerprint(task: BlockTask, rig: Rig, rate: float, trials: int) -> str:
    """Digest of all that healthy statistics depend on: hand, pads, noise, moves, rate [Hz], number of trials.

    Names of blocks do not count, nor the rig's nominal rate and systematic errors.
    """
    number = {name: k for k, name in enumerate(task.objects)} | {GROUND: -1}
    table = {
        "rig": rig.model_dump(mode="json", exclude={"rate", "systematic"}),
        "initial": [number[support] for support in task.initial.values()],
        "moves": [(number[m.object], number[m.to], m.slide) for m in task.performed],
        "rate": rate,
        "trials": trials,
    }
    return hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()[:16]


def adapted(bank: Bank, given: Problem, healthy: Fitted, trials: Sequence[Trial]) -> Bank:
    """The bank to judge `trials` by, whose frame and fit of properties alone are given.

    A bank without a reference, or learned on such recordings, is taken as it is.
    """
    frame, reference = given.frame, bank.reference
    if reference is None:
        return bank
    mark = fingerprint(frame.task, frame.rig, rate_of(trials), frame.num_trials)
    if (mark, frame.world.t.shape[1]) == (reference.fingerprint, reference.samples):
        return bank
    here = distribution(statistics(given, healthy))
    return replace(bank, detection=moved(bank.detection, reference.bootstrap, here), source=BOOTSTRAP)


def moved(learned: Detection, there: Detection, here: Detection) -> Detection:
    """Learned distributions, moved as the bootstrap moves from the reference (`there`) to the rig at hand."""

    def one(name: str) -> tuple[float, float]:
        (location, scale), (a, b), (c, d) = (getattr(x, name) for x in (learned, there, here))
        return location + c - a, scale * float(np.clip(d / b, 1 / FARTHEST, FARTHEST))

    return Detection(**{name: one(name) for name in STATISTICS}, margin=learned.margin)
