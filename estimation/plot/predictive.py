"""Posterior-predictive check by eye: recorded signals in the band the fitted model predicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from estimation.identification import Identification
from estimation.predicted import predicted_signals
from hmmseg.plot.spans import name_spans, shade_spans
from hmmseg.plot.style import BLUE, INK, RED, canvas
from hmmseg.segmentation.spans import Segmentation

UNITS = {
    "net vertical force": ("Net fy less\npredicted [N]", 1.0),
    "finger distance": ("Distance less\npredicted [mm]", 1e3),
}


@dataclass(frozen=True)
class Prediction:
    """A recorded signal and what the model predicts of it, all (num_timesteps,) as shown.

    `low` and `high` bound the central 90 % of a new sample, NaN where nothing is predicted.
    """

    label: str
    observed: np.ndarray
    low: np.ndarray
    median: np.ndarray
    high: np.ndarray

    @property
    def coverage(self) -> float:
        """Share of the predicted samples that lie in their band; NaN where there is none."""
        there = np.isfinite(self.observed) & np.isfinite(self.low)
        inside = (self.observed >= self.low) & (self.observed <= self.high)
        return float(inside[there].mean()) if there.any() else float("nan")


def draw_predictive(
    t: np.ndarray,
    predictions: Sequence[Prediction],
    path: Path | None = None,
    segmentation: Segmentation | None = None,
) -> list[Axes]:
    """Recorded samples at t (num_timesteps,) [s] against predicted 90 % bands, a panel a signal.

    Samples outside their band are marked; each panel says which share lies inside.
    """
    with canvas(path, height=1.5 + 1.25 * len(predictions)) as figure:
        axes = list(np.atleast_1d(figure.subplots(len(predictions), 1, sharex=True)))
        for ax, p in zip(axes, predictions, strict=True):
            ax.plot(t, p.observed, ".", color=INK, ms=1.8)
            ax.fill_between(t, p.low, p.high, color=BLUE, alpha=0.35, lw=0)
            ax.plot(t, p.median, color=BLUE, lw=0.9)
            outside = (p.observed < p.low) | (p.observed > p.high)
            ax.plot(t[outside], p.observed[outside], "x", color=RED, ms=3.5, mew=0.8)
            ax.set_ylabel(p.label)
            ax.margins(y=0.15)
            if np.isfinite(p.coverage):
                ax.text(0.995, 0.95, f"{100 * p.coverage:.0f} % inside", transform=ax.transAxes, ha="right",
                        va="top", fontsize=7)  # fmt: skip
            if segmentation is not None:
                shade_spans(ax, segmentation)
        if segmentation is not None:
            name_spans(axes[0], segmentation)
        figure.align_ylabels(axes)
        axes[-1].set_xlabel("Time [s]")
        axes[-1].set_xlim(t[0], t[-1])
        handles = [Line2D([], [], color=INK, marker=".", ls="", label="recorded"),
                   Patch(color=BLUE, alpha=0.35, lw=0, label="predicted, 90 %"),
                   Line2D([], [], color=RED, marker="x", ls="", label="outside")]  # fmt: skip
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
        return axes


def draw_check(found: Identification, trial: int, path: Path | None = None) -> list[Axes]:
    """One trial's recorded signals less what the fitted model predicts, in its band."""
    t, predicted = predicted_signals(found, trial)
    shown = []
    for p in predicted:
        label, factor = UNITS[p.name]
        around = (factor * (v - p.median) for v in (p.observed, p.low, p.median, p.high))
        shown.append(Prediction(label, *around))
    return draw_predictive(t, shown, path, found.segmentations[trial])
