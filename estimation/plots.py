"""Figures of an identification: corner plot, estimates against measurements, and predicted signals."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.special import ndtri

from estimation.identification import Identification
from estimation.observations import channel_values, gravity_factor
from estimation.report import Actual
from hmmseg import numbers
from hmmseg.contact.decompose import ABOVE_GROUND, FREE
from hmmseg.numbers import SHOWN
from hmmseg.plot.spans import name_spans, shade_spans
from hmmseg.plot.style import BLUE, GREY, INK, RED, canvas
from hmmseg.segmentation.spans import Segmentation


@dataclass(frozen=True)
class Prediction:
    """A recorded signal minus its prediction, and the predictive band of a new sample, (num_timesteps,)."""

    label: str
    observed: np.ndarray
    low: np.ndarray  # of the central 90 % about 0, NaN without a prediction
    high: np.ndarray  # likewise

    @property
    def coverage(self) -> float:
        """Share of the predicted samples inside their band; NaN if there are none."""
        there = np.isfinite(self.observed) & np.isfinite(self.low)
        inside = (self.observed >= self.low) & (self.observed <= self.high)
        return float(inside[there].mean()) if there.any() else float("nan")


def predictions(found: Identification, trial: int) -> tuple[np.ndarray, list[Prediction]]:
    """Times (num_timesteps,) [s] of one trial; its predicted net vertical force and finger distance."""
    weighed = found.weighed[trial]
    signals, masks = weighed.signals, weighed.masks.mean(axis=0) > 0.5
    factor = gravity_factor(signals, found.rig)
    given = signals.distance - channel_values(signals, found.rig)["distance"]
    out = []
    for label, prop, key, scale, observed in (
        ("Net fy less\npredicted [N]", "weight", "force", 1.0, signals.fy),
        ("Distance less\npredicted [mm]", "width", "distance", 1e3, signals.distance),
    ):
        mean, half = np.full((2, signals.t.size), np.nan)
        for step in found.aligned.subtasks:
            held = step.state == ABOVE_GROUND if prop == "weight" else step.state != FREE
            if held and (str(step.object), prop) in found.names:
                inside, draws = masks[step.index], found.of(str(step.object), prop)
                expected = draws.mean() * factor if prop == "weight" else draws.mean() + given
                mean[inside] = expected[inside]
                half[inside] = ndtri(0.95) * np.hypot(np.sqrt(found.noise.variance[key]), draws.std())
        out.append(Prediction(label, scale * (observed - mean), -scale * half, scale * half))
    return signals.t, out


SIZE = 1.25  # look: in, of a panel
LEFT, RIGHT = 0.95, 0.3  # look: in, margins (the same at bottom and top)
WIDEST = 0.6  # look: share of a panel by which a measured value may widen its range


def draw_corner(
    draws: np.ndarray,
    names: Sequence[tuple[str, str]],
    path: Path | None = None,
    actual: Actual | None = None,
) -> np.ndarray:
    """Corner plot of posterior draws (num_draws, num_properties) of the (object, property) pairs, SI units.

    Contours contain 39, 68 and 95 % of the probability, dashed lines are the 2.5, 50 and 97.5 % quantiles.
    Measured values of `actual` are lines; one far outside the draws is omitted and stated in its panel.
    Returns the axes (num_properties, num_properties); ValueError if draws and names differ in number."""
    if draws.ndim != 2 or draws.shape[1] != len(names):
        raise ValueError(f"draws of shape {draws.shape} for {len(names)} names")
    factors = np.array([SHOWN[prop][0] for _, prop in names])
    shown = draws * factors
    labels = [f"{obj}\n{prop} [{SHOWN[prop][1]}]" for obj, prop in names]
    known = [(actual or {}).get(obj, {}).get(prop) for obj, prop in names]
    truths = [None if m is None else m[0] * factor for m, factor in zip(known, factors, strict=True)]
    low, high = np.percentile(shown, 0.05, axis=0), np.percentile(shown, 99.95, axis=0)
    ranges, lines = [], []
    for i, truth in enumerate(truths):
        pad = 0.06 * (high[i] - low[i]) + 1e-12
        a, b, reach = low[i] - pad, high[i] + pad, WIDEST * (high[i] - low[i])
        near = truth is not None and low[i] - reach <= truth <= high[i] + reach
        lines.append(truth if near else None)
        ranges.append((min(a, truth - pad), max(b, truth + pad)) if near and truth is not None else (a, b))
    with warnings.catch_warnings():  # corner's ArviZ announces its own refactoring at import
        warnings.filterwarnings("ignore", message="\\s*ArviZ is undergoing", category=FutureWarning)
        from corner.corner import corner
    size = SIZE * len(names) + LEFT + RIGHT
    with canvas(path, width=size, height=size, layout=None) as figure:
        corner(
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


ORDER = ("weight", "width", "height", "friction")


def draw_estimates(
    properties: Mapping[str, Mapping[str, dict[str, Any] | None]],
    actual: Actual | None,
    path: Path | None = None,
) -> Axes:
    """Plot one row per property: 68 and 95 % interval in % of the measured value, with the numbers.
    `properties` is the JSON of `identify`. Without a measured value the row is relative to the estimate
    itself (open marker); a property that is None or only bounded says so."""
    rows = [(obj, key) for obj, entry in properties.items() for key in ORDER if key in entry]
    with canvas(path, height=1.1 + 0.27 * len(rows)) as figure:
        ax = figure.subplots()
        reach = [
            _draw_row(ax, y, key, properties[obj][key], (actual or {}).get(obj, {}).get(key))
            for y, (obj, key) in enumerate(rows)
        ]
        limit = 1.08 * max(reach, default=0.0) or 1.0
        ax.set_xlim(-limit, limit)
        ax.axvline(0, color=INK, lw=0.6, zorder=0)
        ax.set_yticks(range(len(rows)), [f"{obj} {key}" for obj, key in rows])
        ax.tick_params(axis="y", length=0)
        ax.set_ylim(len(rows) - 0.4, -0.6)
        ax.spines["left"].set_visible(False)
        for y in range(1, len(rows)):
            if rows[y][0] != rows[y - 1][0]:
                ax.axhline(y - 0.5, color=GREY, lw=0.5)
        head = "mean ± sd  (measured)" if actual else "mean ± sd"
        ax.text(1.02, -0.85, head, transform=ax.get_yaxis_transform(), va="bottom", fontsize=7.5,
                style="italic")  # fmt: skip
        ax.set_xlabel("Estimate less measured value [%]" if actual else "About the estimate [%]")
        handles: list[Artist] = [
            Line2D([], [], color=BLUE, lw=3.2, solid_capstyle="butt", label="68 % interval"),
            Line2D([], [], color=BLUE, lw=1.0, label="95 % interval"),
        ]
        if actual:
            handles = [Line2D([], [], color=BLUE, marker="o", ls="", ms=3.5, label="estimate"), *handles]
            handles += [Patch(color=GREY, alpha=0.4, lw=0, label="measured, ± 1 sd")]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
        return ax


def _draw_row(
    ax: Axes, y: int, key: str, estimate: dict[str, Any] | None, measured: tuple[float, float] | None
) -> float:
    """Draw one property; returns the largest distance from 0 that it needs [%]."""
    factor, unit = SHOWN[key]
    beside = ax.get_yaxis_transform()

    def note(text: str) -> None:
        ax.text(1.02, y, text, transform=beside, va="center", ha="left", fontsize=7.5)

    reach = 0.0
    if measured is not None and estimate is not None and "mean" in estimate:
        measured_sd = 100 * measured[1] / measured[0]
        ax.fill_betweenx([y - 0.32, y + 0.32], -measured_sd, measured_sd, color=GREY, alpha=0.4, lw=0)
        reach = measured_sd
    if estimate is None or "mean" not in estimate:
        said = " not determined " if estimate is None else " lower bound only "
        ax.text(0, y, said, va="center", ha="center", fontsize=7.5, style="italic", color=GREY,
                backgroundcolor="white")  # fmt: skip
        bound = "–" if measured else ""
        if estimate is not None:
            bound = f"≥ {estimate['lower_bound'] * factor:.2f} {unit}".rstrip()
        note(bound + _against(measured, factor))
        return reach
    reference = estimate["mean"] if measured is None else measured[0]
    for interval, width in (("interval_95", 1.0), ("interval_68", 3.2)):
        ends = [100 * (value / reference - 1) for value in estimate[interval]]
        ax.plot(ends, [y, y], color=BLUE, lw=width, solid_capstyle="butt")
        reach = max(reach, *map(abs, ends))
    centre = 100 * (estimate["mean"] / reference - 1)
    ax.plot(centre, y, "o", color=BLUE, ms=3.5, mfc=BLUE if measured else "white", zorder=3)
    note(numbers.estimate(estimate["mean"], estimate["sd"], SHOWN[key]) + _against(measured, factor))
    return max(reach, abs(centre))


def _against(measured: tuple[float, float] | None, factor: float) -> str:
    return "" if measured is None else f"  ({numbers.plain(measured[0] * factor, 4)})"


def draw_predictive(
    t: np.ndarray, shown: Sequence[Prediction], path: Path | None, segmentation: Segmentation
) -> list[Axes]:
    """Plot recorded samples at t (num_timesteps,) [s] in predicted 90 % bands, one panel per signal. Samples
    outside their band are marked; each panel states the share inside."""
    with canvas(path, height=1.5 + 1.25 * len(shown)) as figure:
        axes = list(np.atleast_1d(figure.subplots(len(shown), 1, sharex=True)))
        for ax, p in zip(axes, shown, strict=True):
            ax.plot(t, p.observed, ".", color=INK, ms=1.8)
            ax.fill_between(t, p.low, p.high, color=BLUE, alpha=0.35, lw=0)
            ax.axhline(0, color=BLUE, lw=0.9)
            outside = (p.observed < p.low) | (p.observed > p.high)
            ax.plot(t[outside], p.observed[outside], "x", color=RED, ms=3.5, mew=0.8)
            ax.set_ylabel(p.label)
            ax.margins(y=0.15)
            if np.isfinite(p.coverage):
                ax.text(0.995, 0.95, f"{100 * p.coverage:.0f} % inside", transform=ax.transAxes, ha="right",
                        va="top", fontsize=7)  # fmt: skip
            shade_spans(ax, segmentation)
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
    """Plot one trial's recorded signals minus the fitted model's prediction, in its band."""
    return draw_predictive(*predictions(found, trial), path, found.segmentations[trial])
