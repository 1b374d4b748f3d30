"""Boundaries, states and properties of one trial by every method, in common terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.paper_formulas import estimate_plugin
from hmmseg.contact.decompose import Subtask
from hmmseg.contact.identifiability import PROPERTIES
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.segmentation.spans import Failure, Segmentation, Span, known
from hmmseg.segmentation.thresholds import NUMBERS, StateLabels
from simgap.world.properties import Block


@dataclass(frozen=True)
class Boundaries:
    """Medians and 90 % intervals (num_boundaries,) [s], NaN where a neighbour is missing."""

    median: np.ndarray
    low: np.ndarray
    high: np.ndarray


def boundaries_of(segmentation: Segmentation, steps: Sequence[Subtask]) -> Boundaries:
    """Boundaries between subtasks that follow one another in the task, of those that were found."""
    out = np.full((3, len(steps) - 1), np.nan)
    places = [i for i, _ in _placed(segmentation, steps)]
    for (i, before), j in zip(_placed(segmentation, steps), places[1:], strict=False):
        if j == i + 1:
            out[:, i] = before.end, *before.end_90
    return Boundaries(*out)


def _placed(segmentation: Segmentation, steps: Sequence[Subtask]) -> list[tuple[int, Span]]:
    """Each span with the index of its subtask; both are in the task's order."""
    placed, at = [], 0
    for span in segmentation.spans:
        while (steps[at].name, steps[at].object) != (span.subtask, span.object):
            at += 1
        placed.append((at, span))
        at += 1
    return placed


def segmentation_from(steps: Sequence[Subtask], shown: Sequence[int], edges: Sequence[float]) -> Segmentation:
    """Segmentation of certain boundaries: subtasks `shown` between `edges` (one more) [s]."""
    missing = [s for s in steps if s.index not in shown]
    failed = Failure(missing[0].index, missing[0].name, missing[0].object, "not shown") if missing else None
    return known("", 0.0, [steps[s] for s in shown], edges, failed)


def numbered_states(steps: Sequence[Subtask], boundaries: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The paper's state number of every sample between known boundaries."""
    numbers = np.array([NUMBERS[step.state] for step in steps])
    return numbers[np.searchsorted(boundaries, t, side="right")]


def unsqueezed(signals: Signals, rig: Rig) -> Signals:
    """Signals with the pads' compression and shear taken out of finger 2's position.

    The paper's formulas take fingertips for rigid; given these signals they err by their
    segmentation and sampling alone, which is what is to be compared.
    """
    pad = rig.fingertip
    squeeze = (signals.fx1 - signals.fx2) / pad.normal_stiffness
    return replace(signals, x2=signals.x2 + squeeze, y2=signals.y2 - signals.fy2 / pad.shear_stiffness)


def plugin_residuals(signals: Signals, segmentation: Segmentation, labels: StateLabels, task: BlockTask,
                     blocks: dict[str, Block]) -> list[float]:  # fmt: skip
    """Relative residual of every block's weight, width and height by the paper's formulas; NaN: none."""
    found: dict = estimate_plugin([signals], [segmentation], task, [labels]).properties
    out = []
    for name in task.objects:
        for key in PROPERTIES:
            estimate = found[name][key]
            value = getattr(blocks[name], key)
            out.append(np.nan if estimate is None else estimate.mean / value - 1)
    return out
