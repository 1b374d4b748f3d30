"""The blind check's confusion matrix: what was true against what was said, shares of each row."""

from __future__ import annotations

import numpy as np

from hmmseg.plot.style import BLUE, INK, canvas
from paper_figs.gap_results import load, words
from paper_figs.results import target

LAST = ("pair", "wrong pair", "none", "unknown", "error")  # after the effects


def matrix(confusion: dict[str, dict[str, int]]) -> tuple[list[str], list[str], np.ndarray]:
    """Row names, column names and counts (rows, columns)."""
    said = {s for row in confusion.values() for s in row}
    effects = sorted((set(confusion) | said) - set(LAST))
    rows = [n for n in (*effects, *LAST) if n in confusion]
    columns = [n for n in (*effects, *LAST) if n in said or n in effects]
    counts = np.array([[confusion[r].get(c, 0) for c in columns] for r in rows])
    return rows, columns, counts


def main() -> None:
    from matplotlib.colors import LinearSegmentedColormap

    rows, columns, counts = matrix(load()["confusion"])
    shade = LinearSegmentedColormap.from_list("count", ["white", BLUE])
    with canvas(target("gap_confusion"), height=0.9 + 0.235 * len(rows) + 1.1) as figure:
        ax = figure.subplots()
        share = counts / counts.sum(1, keepdims=True)
        ax.imshow(share, cmap=shade, vmin=0, vmax=1, aspect="auto")
        for r, c in zip(*np.nonzero(counts), strict=True):
            ax.text(c, r, f"{counts[r, c]}", ha="center", va="center", fontsize=7,
                    color="white" if share[r, c] > 0.6 else INK)  # fmt: skip
        ax.set_xticks(range(len(columns)), [words(c) for c in columns], rotation=60, ha="right")
        ax.set_yticks(
            range(len(rows)), [f"{words(r)} ({n})" for r, n in zip(rows, counts.sum(1), strict=True)]
        )
        ax.set_xlabel("said: leading cause or verdict")
        ax.set_ylabel("true, above the detection floor (cases)")


if __name__ == "__main__":
    main()
