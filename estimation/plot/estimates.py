"""Estimated properties with their intervals against measured ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from estimation.actual import Actual
from hmmseg.numbers import SHOWN
from hmmseg.plot.style import BLUE, GREY, INK, canvas

ORDER = ("weight", "width", "height", "friction")


def draw_estimates(
    properties: Mapping[str, Mapping[str, dict | None]], actual: Actual | None, path: Path | None = None
) -> Axes:
    """One row a property: 68 and 95 % interval in % of the measured value, numbers beside it.

    `properties` is the JSON of `identify`. Without a measured value the row is drawn about the
    estimate itself (open marker); a property that is None or only bounded says so.
    """
    rows = [(obj, key) for obj, entry in properties.items() for key in ORDER if key in entry]
    with canvas(path, height=1.1 + 0.27 * len(rows)) as figure:
        ax = figure.subplots()
        reach = [0.0]
        for y, (obj, key) in enumerate(rows):
            measured = None if actual is None else actual.get(obj, {}).get(key)
            reach.append(_draw_row(ax, y, key, properties[obj][key], measured))
        limit = 1.08 * max(reach) or 1.0
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
        handles = [Line2D([], [], color=BLUE, lw=3.2, solid_capstyle="butt", label="68 % interval"),
                   Line2D([], [], color=BLUE, lw=1.0, label="95 % interval")]  # fmt: skip
        if actual:
            handles = [Line2D([], [], color=BLUE, marker="o", ls="", ms=3.5, label="estimate"), *handles]
            handles += [Patch(color=GREY, alpha=0.4, lw=0, label="measured, ± 1 sd")]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
        return ax


def _draw_row(
    ax: Axes, y: int, key: str, estimate: dict | None, measured: tuple[float, float] | None
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
    if estimate is None:
        ax.text(0, y, " not determined ", va="center", ha="center", fontsize=7.5, style="italic",
                color=GREY, backgroundcolor="white")  # fmt: skip
        note(("–" + _against(measured, factor)) if measured else "")
        return reach
    if "mean" not in estimate:
        ax.text(0, y, " lower bound only ", va="center", ha="center", fontsize=7.5, style="italic",
                color=GREY, backgroundcolor="white")  # fmt: skip
        note(f"≥ {estimate['lower_bound'] * factor:.2f} {unit}".rstrip() + _against(measured, factor))
        return reach
    reference = estimate["mean"] if measured is None else measured[0]
    for interval, width in (("interval_95", 1.0), ("interval_68", 3.2)):
        ends = [100 * (value / reference - 1) for value in estimate[interval]]
        ax.plot(ends, [y, y], color=BLUE, lw=width, solid_capstyle="butt")
        reach = max(reach, *map(abs, ends))
    centre = 100 * (estimate["mean"] / reference - 1)
    ax.plot(centre, y, "o", color=BLUE, ms=3.5, mfc=BLUE if measured else "white", zorder=3)
    digits = _digits(estimate["sd"] * factor)
    shown = f"{estimate['mean'] * factor:.{digits}f} ± {estimate['sd'] * factor:.{digits}f} {unit}"
    note(shown.rstrip() + _against(measured, factor))
    return max(reach, abs(centre))


def _against(measured: tuple[float, float] | None, factor: float) -> str:
    if measured is None:
        return ""
    value, sd = measured[0] * factor, measured[1] * factor
    return f"  ({value:.{max(0, _digits(sd) - 1)}f})" if sd > 0 else f"  ({value:.4g})"


def _digits(sd: float) -> int:
    """Decimals that show two digits of a standard deviation."""
    return max(0, 1 - math.floor(math.log10(sd))) if sd > 0 else 4
