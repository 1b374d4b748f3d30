"""Hit rate of single effects by their size and by what they gain, beside three simple rivals."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hmmseg.plot.style import BLUE, GREEN, ORANGE, RED, SKY, canvas
from paper_figs.gap_results import load
from paper_figs.results import target

METHODS = {
    "set": ("ours, right set", SKY, "D"),
    "named": ("ours, right name", BLUE, "o"),
    "bic": ("BIC over singles", ORANGE, "s"),
    "all_at_once": ("all effects at once", GREEN, "^"),
    "cosine": ("cosine", RED, "v"),
}


def draw(ax: Axes, rows: list[dict[str, Any]], labels: list[str]) -> None:
    """Hit rates with their intervals; methods stand side by side."""
    for k, (name, (label, colour, marker)) in enumerate(METHODS.items()):
        there = [i for i, row in enumerate(rows) if row[name]["value"] is not None]
        x = np.array(there) + 0.09 * (k - 2)
        value = np.array([rows[i][name]["value"] for i in there])
        ends = np.array([rows[i][name]["interval_95"] for i in there]).reshape(-1, 2).T
        ax.errorbar(x, value, np.abs(ends - value), fmt=marker, ms=3.5, color=colour, lw=0.8, capsize=1.5,
                    label=label)  # fmt: skip
    ax.set_xticks(range(len(rows)), labels)
    ax.set_ylim(-0.02, 1.02)
    ax.set_xlim(-0.5, len(rows) - 0.5)


def main() -> None:
    found = load()
    sizes, gains = found["by_size"], found["by_gain"]
    with canvas(target("gap_sizes"), height=2.9) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        spans = [f"{r['from']:g}-{r['to']:g}\n{r['named']['count']} cases" for r in sizes]
        draw(left, sizes, spans)
        left.set_xlabel("size of the effect (1: large), all cases")
        left.set_ylabel("share named rightly")
        spans = [f"{r['from']:g}-{r['to']:g}\n" if r["to"] else f"over {r['from']:g}\n" for r in gains]
        spans = [f"{s}{r['named']['count']} cases" for s, r in zip(spans, gains, strict=True)]
        draw(right, gains, spans)
        right.set_xlabel("held-out gain of the true effect [nats]")
        handles, labels = left.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=5)


if __name__ == "__main__":
    main()
