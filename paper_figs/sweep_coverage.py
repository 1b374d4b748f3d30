"""How often our intervals hold the truth in every sweep, and the sampled posterior against Laplace's."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hmmseg.plot.style import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, canvas
from paper_figs.sweep_lines import SWEEPS
from paper_figs.sweep_results import load, series, target

LINES = {
    "coverage_90": ("boundaries, 90 % intervals", BLUE, "o", 0.90),
    "coverage_95_weight": ("weight, 95 %", ORANGE, "s", 0.95),
    "coverage_95_width": ("width, 95 %", GREEN, "^", 0.95),
    "coverage_95_height": ("height, 95 %", PURPLE, "D", 0.95),
}
SAMPLED = (("laplace_coverage_95", "Laplace", GREY), ("coverage_95", "sampled", BLUE))


def draw_coverage(ax: Axes, found: dict[str, Any], sweep: str) -> None:
    """Coverage over one sweep, the lines moved apart a little so that intervals stay legible."""
    label, unit, _ = SWEEPS[sweep]
    rows = found["sweeps"][sweep]
    spread = np.linspace(-0.24, 0.24, len(LINES))
    for (key, (name, colour, marker, aim)), shift in zip(LINES.items(), spread, strict=True):
        level, value, low, high = series(found, sweep, "ours", key)
        x = np.arange(level.size) + shift
        ends = np.abs(np.stack([value - low, high - value]))
        ax.errorbar(x, 100 * value, 100 * ends, fmt=marker, ms=2.8, lw=0.8, color=colour, label=name)
        ax.axhline(100 * aim, color=colour if aim < 0.95 else INK, lw=0.6, ls=":")
    levels = sorted(row["level"] * unit for row in rows)
    ax.set_xticks(range(len(levels)), [f"{v:g}" for v in levels])
    ax.set_xlabel(label.replace("\n", " "))
    ax.set_ylim(40, 103)


def draw_widths(ax: Axes, found: dict[str, Any]) -> None:
    """Width of sampled 95 % intervals over Laplace's, cell by cell: median, 5 to 95 % of properties."""
    cells = [cell["sampled"] for cell in found["cells"].values() if cell["sampled"]["trials"]]
    for x, sampled in enumerate(sorted(cells, key=lambda s: s["width_ratio"][1])):
        low, middle, high = sampled["width_ratio"]
        ax.plot([x, x], [low, high], color=GREY, lw=0.8)
        ax.plot(x, middle, "o", ms=2.5, color=BLUE)
    ax.axhline(1, color=INK, lw=0.6, ls=":")
    ax.set_xticks([])
    ax.set_xlabel("cells, in order")
    ax.set_ylabel("95 % interval,\nsampled over Laplace")


def draw_both(ax: Axes, found: dict[str, Any]) -> None:
    """Coverage of sampled and of Laplace intervals for the same trials, pooled over each sweep."""
    for shift, (key, label, colour) in zip((-0.15, 0.15), SAMPLED, strict=True):
        for x, sweep in enumerate(SWEEPS):
            cells = [found["cells"][row["cell"]]["sampled"] for row in found["sweeps"][sweep]]
            number = sum(c["properties"] for c in cells)
            covered = sum(c[key] * c["properties"] for c in cells if c["properties"]) / number
            low, high = proportion_interval(covered, number)
            ax.plot([x + shift] * 2, [100 * low, 100 * high], lw=0.8, color=colour)
            ax.plot(x + shift, 100 * covered, "o", ms=3, color=colour, label=label if x == 0 else None)
    ax.axhline(95, color=INK, lw=0.6, ls=":")
    ax.set_xticks(range(len(SWEEPS)), list(SWEEPS))
    ax.set_ylim(70, 101)
    ax.set_ylabel("properties covered\nby 95 % intervals [%]")
    ax.legend(loc="lower left", ncols=2)


def proportion_interval(share: float, number: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's 95 % interval of a share (J. Am. Stat. Assoc. 22, 1927)."""
    centre = (share + z**2 / (2 * number)) / (1 + z**2 / number)
    half = z / (1 + z**2 / number) * np.sqrt(share * (1 - share) / number + z**2 / (4 * number**2))
    return centre - half, centre + half


def main() -> None:
    found = load()
    with canvas(target("sweep_coverage"), height=5.6) as figure:
        above, below = figure.subfigures(2, 1, height_ratios=(2, 1))
        axes = above.subplots(2, 3, sharey=True)
        for ax, sweep in zip(axes.ravel(), SWEEPS, strict=True):
            draw_coverage(ax, found, sweep)
        for row in axes:
            row[0].set_ylabel("covered [%]")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        above.legend(handles, labels, loc="outside upper center", ncols=4)
        widths, both = below.subplots(1, 2, width_ratios=(1, 1.4))
        draw_widths(widths, found)
        draw_both(both, found)


if __name__ == "__main__":
    main()
