"""The joint posterior of the properties: corner plot with the measured values where known."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from estimation.actual import Actual
from hmmseg.numbers import SHOWN
from hmmseg.plot.style import BLUE, RED, canvas

SIZE = 1.25  # look: in, a panel
LEFT, RIGHT = 0.95, 0.3  # look: in, margins (below and above alike)
WIDEST = 0.6  # look: share of a panel by which a measured value may widen its range


def draw_corner(
    draws: np.ndarray,
    names: Sequence[tuple[str, str]],
    path: Path | None = None,
    actual: Actual | None = None,
) -> np.ndarray:
    """Posterior draws (num_draws, num_properties) of the (object, property) pairs, SI units.

    Contours hold 39, 68 and 95 % of the probability, dashed lines are the quantiles 2.5, 50 and
    97.5 %. Measured values of `actual` are lines; one that lies far outside the draws is left out,
    its panel saying so. Returns the axes (num_properties, num_properties); ValueError for draws of
    another width than names.
    """
    if draws.ndim != 2 or draws.shape[1] != len(names):
        raise ValueError(f"draws of shape {draws.shape} for {len(names)} names")
    factors = np.array([SHOWN[prop][0] for _, prop in names])
    shown = draws * factors
    labels = [f"{obj}\n{prop} [{SHOWN[prop][1]}]" for obj, prop in names]
    truths = [_measured(actual, obj, prop) for obj, prop in names]
    low, high = np.percentile(shown, 0.05, axis=0), np.percentile(shown, 99.95, axis=0)
    ranges, lines = [], []
    for i, truth in enumerate(truths):
        pad = 0.06 * (high[i] - low[i]) + 1e-12
        a, b, reach = low[i] - pad, high[i] + pad, WIDEST * (high[i] - low[i])
        near = truth is not None and low[i] - reach <= truth <= high[i] + reach
        lines.append(truth if near else None)
        ranges.append((min(a, truth - pad), max(b, truth + pad)) if near and truth is not None else (a, b))
    plot = _corner_function()
    size = SIZE * len(names) + LEFT + RIGHT
    with canvas(path, width=size, height=size, layout=None) as figure:
        plot(
            shown, fig=figure, labels=labels, range=ranges, truths=lines, truth_color=RED, color=BLUE,
            bins=30, smooth=0.8, quantiles=(0.025, 0.5, 0.975), plot_datapoints=False,
            plot_density=False, fill_contours=True, levels=(0.393, 0.68, 0.95), max_n_ticks=3,
            hist_kwargs={"linewidth": 0.9}, label_kwargs={"fontsize": 8}, labelpad=0.12,
        )  # fmt: skip
        figure.subplots_adjust(LEFT / size, LEFT / size, 1 - RIGHT / size, 1 - RIGHT / size)
        axes = np.array(figure.axes).reshape(len(names), len(names))
        for i, (truth, line) in enumerate(zip(truths, lines, strict=True)):
            if truth is not None and line is None:
                axes[i, i].set_title(f"measured {truth:.4g}", color=RED, fontsize=7)
        if any(line is not None for line in lines):
            figure.text(1 - RIGHT / size, 0.99, "lines: measured", color=RED, ha="right", va="top")
        return axes


def _corner_function() -> Callable:
    """corner's function; its ArviZ announces its own refactoring at import, which helps no user."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="\\s*ArviZ is undergoing", category=FutureWarning)
        from corner.corner import corner
    return corner


def _measured(actual: Actual | None, obj: str, prop: str) -> float | None:
    found = None if actual is None else actual.get(obj, {}).get(prop)
    return None if found is None else found[0] * SHOWN[prop][0]
