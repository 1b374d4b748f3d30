"""Trials of one task read, fitted and sensed together: what all of them show of task and hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hmmseg.contact.decompose import Subtask
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.segmentation.changes import Change, Disagreement, disagreements
from hmmseg.segmentation.emissions import Features, Parameters
from hmmseg.segmentation.features import WINDOW, features, thin, without
from hmmseg.segmentation.fit import Fit, fit
from hmmseg.segmentation.motions import Kind
from hmmseg.segmentation.pads import Sensing, read_again, sense
from hmmseg.segmentation.posteriors import contact_changes

Spans = Sequence[tuple[float, float]]
LOCAL_RATE = 100.0  # chosen: Hz; contacts are located at up to this rate, at which readings share no noise


@dataclass(frozen=True)
class Reading:
    """One recording, or round: `fine` signals locate contacts, `thinned` ones are aligned by `features`.

    `ends` [s]: its first and last time.
    """

    fine: Signals
    thinned: Signals
    features: Features
    ends: tuple[float, float]


@dataclass(frozen=True)
class Pool:
    """All recordings as they were read last, the fit of those that fit, and what they show of the hand.

    `changes` are those of each fitted recording; `disagreement` as in `disagreements`. `remarks` tell
    people what contradicts the rig.
    """

    readings: list[Reading]
    fit: Fit
    sensing: Sensing
    changes: list[list[Change | None]] = field(default_factory=list)
    disagreement: dict[tuple[Kind, int], Disagreement] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


def pooled(
    recordings: Sequence[Signals], fitting: Sequence[int], steps: tuple[Subtask, ...], rig: Rig,
    taps: Sequence[Spans],
) -> Pool:  # fmt: skip
    """One fit of all that fit; a second one where their forces come late.

    `taps` [s] of each recording are touches that belong to no subtask.
    """

    def once(signals: Sequence[Signals], again: bool) -> tuple[list[Reading], Fit, Sensing]:
        readings = [_read(s, rig, t) for s, t in zip(signals, taps, strict=True)]
        fitted = fit([readings[i].features for i in fitting], steps)
        fine = [readings[i].fine for i in fitting]
        # Forces of a wrist's fingers show no pads of their own.
        again = again or any(r.fine.touches for r in readings)
        paths = [(readings[i].thinned.t, a.path) for i, a in zip(fitting, fitted.posteriors, strict=True)]
        return readings, fitted, sense(fine, paths, steps, fitted.parameters, rig, again)

    readings, fitted, sensing = once(recordings, again=False)
    remarks = sensing.remarks(rig)
    if sensing.late:
        readings, fitted, again = once([read_again(s, sensing) for s in recordings], again=True)
        remarks = replace(again, late=True, filter=sensing.filter, delay=sensing.delay).remarks(rig)
        sensing = replace(again, delay_sd=float(np.hypot(again.delay_sd, sensing.delay_sd)))
    changes = [
        contact_changes(readings[i].fine, readings[i].thinned, sensing, steps, fitted.parameters, alignment)
        for i, alignment in zip(fitting, fitted.posteriors, strict=True)
    ]
    disagreement = disagreements([c for own in changes for c in own if c is not None])
    return Pool(readings, fitted, sensing, changes, disagreement, remarks)


def unfitted(recordings: Sequence[Signals], parameters: Parameters, rig: Rig, taps: Sequence[Spans]) -> Pool:
    """Where no trial fits the task: what is known of the sensors, and no alignment."""
    readings = [_read(s, rig, t) for s, t in zip(recordings, taps, strict=True)]
    return Pool(readings, Fit(parameters, ()), sense([], [], (), parameters, rig))


def _read(signals: Signals, rig: Rig, taps: Spans) -> Reading:
    thinned = thin(signals, window=WINDOW)
    fine = thin(signals, LOCAL_RATE, WINDOW)
    return Reading(
        fine, thinned, without(features(thinned, rig), taps), (float(signals.t[0]), float(signals.t[-1]))
    )
