"""The work of one unit: record its trials, run every method on each, compare with the truth."""

from __future__ import annotations

import itertools
import math
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from estimation.design import build
from estimation.mode import Mode, find_mode
from estimation.observations import aligned_weights
from estimation.posterior import Posterior, posterior
from estimation.sampler import sample
from experiments.scoring import state_accuracy
from experiments.sweeps.cells import THRESHOLDS, Unit
from experiments.sweeps.free_hmm import label_freely
from experiments.sweeps.methods import (
    PROPERTIES,
    boundaries_of,
    numbered_states,
    plugin_residuals,
    segmentation_from,
    unsqueezed,
)
from experiments.sweeps.trials import Recorded, interpolated, record_cell, scene, stated_rig
from hmmseg.contact.decompose import Subtask, subtasks
from hmmseg.hand.signals import Signals, task_space
from hmmseg.hmm.chain import InfeasibleAlignment
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.segmentation.align import align
from hmmseg.segmentation.spans import Segmentation
from hmmseg.segmentation.thresholds import (
    FORCE_THRESHOLD,
    VELOCITY_THRESHOLD,
    StateLabels,
    label_states,
    monotone_order,
    segment_qualitative,
)

Z95 = 1.959964


@dataclass(frozen=True)
class Scene:
    """What the methods are told, and the task's subtasks."""

    rig: Rig
    task: BlockTask
    steps: tuple[Subtask, ...]


def measure(unit: Unit) -> dict[str, Any]:
    """Scores of every method on the unit's trials, one entry a trial, ready for JSON (null: none).

    Residuals of boundaries [s] and, relative, of properties (weight, width and height of each object
    in the task's order).
    """
    began = time.process_time()
    rig, task = scene()
    told = Scene(stated_rig(unit.cell, rig), task, subtasks(task))
    trials = []
    for number, recorded in zip(unit.trials, record_cell(unit.cell, unit.trials, rig, task), strict=True):
        signals = task_space(recorded.trial, told.rig)
        sampled = number - unit.first < unit.sampled
        trials.append({
            "trial": number,
            "ours": _ours(recorded, signals, told, number if sampled else None),
            "unconstrained": _unconstrained(recorded, signals, told),
            "qualitative": _qualitative(recorded, told),
            "true_spans": _true_spans(recorded, signals, told),
        })  # fmt: skip
    return _jsonable({"trials": trials, "seconds": time.process_time() - began, "commit": commit()})


@cache
def commit() -> str:
    """The commit that this process runs, `-dirty` where files differ from it."""
    here = Path(__file__).parent
    run = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=here, capture_output=True,
                         text=True, check=False)  # fmt: skip
    return run.stdout.strip() or "unknown"


def _ours(recorded: Recorded, signals: Signals, told: Scene, seed: int | None) -> dict[str, Any]:
    """Our segmentation and Laplace posterior; with a seed, the sampled posterior beside it."""
    count = len(told.task.objects) * len(PROPERTIES)
    try:
        aligned = align([recorded.trial], told.task, told.rig)
    except InfeasibleAlignment:
        lost, none = np.full(recorded.boundaries.size, np.nan), np.full(count, np.nan)
        return {"residual": lost, "inside_90": lost, "accuracy": 0.0, "property": none, "inside_95": none}
    scores = _scores(aligned.trials[0].segmentation, recorded, signals, told)
    weighed, noise = aligned_weights(aligned, np.random.default_rng(recorded.number))
    design = build(aligned, weighed, noise)
    columns = [(name, key) for name in told.task.objects for key in PROPERTIES]
    truth = np.array([getattr(recorded.blocks[name], key) for name, key in columns])
    where = [columns.index(u.name) for u in design.unknowns if u.single]  # these come first
    location, sd = np.full(count, np.nan), np.full(count, np.nan)
    if not where:
        return scores | {"property": location, "inside_95": location}
    post = posterior(design)
    mode = find_mode(post)
    location[where] = mode.unknowns[: len(where)]
    sd[where] = np.sqrt(np.diag(mode.unknowns_covariance)[: len(where)])
    z = (location - truth) / sd
    scores |= {"property": location / truth - 1, "inside_95": _where(np.abs(z) < Z95, z)}
    if seed is not None:
        scores["sampled"] = _sampled(post, mode, truth[where], seed)
    return scores


def _sampled(post: Posterior, mode: Mode, truth: np.ndarray, seed: int) -> dict[str, Any]:
    """The sampler's posterior against the Laplace one, per property determined."""
    drawn = sample(post, seed, mode=mode)
    draws, found = drawn.flat[:, : truth.size], mode.unknowns[: truth.size]
    laplace = np.sqrt(np.diag(mode.unknowns_covariance)[: truth.size])
    low, high = np.percentile(draws, (2.5, 97.5), axis=0)
    return {
        "inside_95": ((low <= truth) & (truth <= high)).astype(float),
        "laplace_inside_95": (np.abs(found - truth) < Z95 * laplace).astype(float),
        "shift": (np.median(draws, axis=0) - found) / laplace,
        "width_ratio": (high - low) / (2 * Z95 * laplace),
        "ess": drawn.ess, "rhat": drawn.rhat,
    }  # fmt: skip


def _unconstrained(recorded: Recorded, signals: Signals, told: Scene) -> dict[str, Any]:
    thinned, labels = label_freely(signals)
    assigned = monotone_order(labels, told.steps)
    shown = [int(s) for s in np.flatnonzero(assigned.first >= 0)]
    t = thinned.t
    inner = [(t[assigned.last[a]] + t[assigned.first[b]]) / 2 for a, b in itertools.pairwise(shown)]
    segmentation = segmentation_from(told.steps, shown, [t[0], *inner, t[-1]] if shown else [])
    scores = _scores(segmentation, recorded, signals, told)
    del scores["inside_90"]  # it states none
    truth = numbered_states(told.steps, recorded.boundaries, t)
    scores["sample_accuracy"] = float(np.mean(labels.state == truth))
    nearest = np.clip(np.searchsorted(thinned.t, signals.t, side="right") - 1, 0, t.size - 1)
    every = StateLabels(labels.state[nearest], labels.sliding[nearest])
    scores["property"] = plugin_residuals(unsqueezed(signals, told.rig), segmentation, every, told.task,
                                          recorded.blocks)  # fmt: skip
    return scores


def _qualitative(recorded: Recorded, told: Scene) -> dict[str, Any]:
    """The baseline at every pair of thresholds; properties where both are scaled alike.

    Its rules label no sample that lacks a value they ask for, so lost values are interpolated.
    """
    recorded = replace(recorded, trial=interpolated(recorded.trial))
    signals = task_space(recorded.trial, told.rig)
    table: dict[str, list] = {"residual": [], "inside_90": [], "accuracy": [], "sample_accuracy": []}
    corrected, properties = unsqueezed(signals, told.rig), []
    truth = numbered_states(told.steps, recorded.boundaries, signals.t)
    for force, velocity in itertools.product(THRESHOLDS, THRESHOLDS):
        levels = force * FORCE_THRESHOLD, velocity * VELOCITY_THRESHOLD
        segmentation = segment_qualitative(recorded.trial, signals, told.task, *levels)
        for key, value in _scores(segmentation, recorded, signals, told).items():
            table[key].append(value)
        labels = label_states(signals, *levels)
        table["sample_accuracy"].append(float(np.mean(labels.state == truth)))
        if force == velocity:
            properties.append(plugin_residuals(corrected, segmentation, labels, told.task, recorded.blocks))
    return table | {"property": properties}


def _true_spans(recorded: Recorded, signals: Signals, told: Scene) -> dict[str, Any]:
    """The paper's formulas on the true spans: with pads taken out, and rigid as it has them."""
    edges = [signals.t[0], *recorded.boundaries, signals.t[-1]]
    segmentation = segmentation_from(told.steps, range(len(told.steps)), edges)
    states = numbered_states(told.steps, recorded.boundaries, signals.t)
    labels = StateLabels(states, np.zeros(states.size, dtype=bool))
    rest = segmentation, labels, told.task, recorded.blocks
    return {"property": plugin_residuals(unsqueezed(signals, told.rig), *rest),
            "rigid": plugin_residuals(signals, *rest)}  # fmt: skip


def _scores(segmentation: Segmentation, recorded: Recorded, signals: Signals, told: Scene) -> dict[str, Any]:
    found = boundaries_of(segmentation, told.steps)
    inside = (found.low <= recorded.boundaries) & (recorded.boundaries <= found.high)
    accuracy = state_accuracy(segmentation, list(recorded.boundaries), signals.t, told.steps)
    residual = found.median - recorded.boundaries
    return {"residual": residual, "inside_90": _where(inside, residual), "accuracy": accuracy}


def _where(true: np.ndarray, known: np.ndarray) -> np.ndarray:
    """1 or 0, NaN where nothing is known."""
    return np.where(np.isfinite(known), true, np.nan)


def _jsonable(value: Any) -> Any:
    """Lists and numbers of six digits; null for what is not finite."""
    if isinstance(value, dict):
        return {key: _jsonable(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | Sequence) and not isinstance(value, str):
        return [_jsonable(entry) for entry in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
