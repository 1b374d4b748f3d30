"""Table 4 as a picture: every estimate's deviation from the actual value."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes

from hmmseg.plot.style import BLUE, GREEN, GREY, INK, ORANGE, RED, canvas
from paper_figs.results import load, target

KEYS = ("weight", "height", "width")
BLOCKS = ("block1", "block2")
ROWS = (
    ("printed", "one", "the paper, as printed", RED, "*"),
    ("paper", "one", "its method, one recording", ORANGE, "s"),
    ("paper", "all", "its method, ten recordings", ORANGE, "D"),
    ("bayes", "one", "Bayesian, one recording", GREEN, "^"),
    ("bayes", "all", "Bayesian, ten recordings", BLUE, "o"),
)


def entry(table: dict[str, Any], method: str, which: str, block: str, key: str) -> tuple[float, float]:
    """Mean and sd of one estimate."""
    if method == "printed":
        mean, sd = table["printed"][block][key]
        return mean, sd
    found = table["recordings"][method][which][block][key]
    return found["mean"], found["sd"]


def draw(ax: Axes, table: dict[str, Any], rows: tuple) -> None:
    names = [(block, key) for block in BLOCKS for key in KEYS]
    for y, (block, key) in enumerate(names):
        value, spread = table["actual"][block][key]
        ax.fill_betweenx(
            [y - 0.42, y + 0.42], -100 * spread / value, 100 * spread / value, color=GREY, alpha=0.35, lw=0
        )
        for k, (method, which, label, colour, marker) in enumerate(rows):
            mean, sd = entry(table, method, which, block, key)
            place = y + 0.15 * (k - (len(rows) - 1) / 2)
            ax.errorbar(
                100 * (mean / value - 1),
                place,
                xerr=100 * sd / value,
                fmt=marker,
                color=colour,
                ms=4.5,
                lw=1,
                mec=INK,
                mew=0.3,
                label=label if y == 0 else None,
            )
    for y in range(1, len(names)):
        ax.axhline(y - 0.5, color=GREY, lw=0.4, alpha=0.6)
    ax.axvline(0, color=INK, lw=0.5, zorder=0)
    ax.set_yticks(range(len(names)), [f"{block}\n{key}" for block, key in names])
    ax.set_ylim(len(names) - 0.45, -0.55)
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel("Estimate − actual [% of actual]")


def main() -> None:
    table = load("estimates")["table_4"]
    with canvas(target("table4"), height=4.6) as figure:
        left, right = figure.subplots(1, 2, sharey=True, width_ratios=[1.7, 1])
        draw(left, table, ROWS)
        left.set_xlim(-21, 21)
        left.set_title("all methods (bars: ± 1 sd)", fontsize=8)
        draw(right, table, ROWS[3:])
        right.set_xlim(-1.9, 1.9)
        right.set_title("the Bayesian ones, ten times enlarged", fontsize=8)
        handles, labels = left.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)


if __name__ == "__main__":
    main()
