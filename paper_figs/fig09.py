"""Figure 9: the height of the right finger, and what of it gives the heights."""

from __future__ import annotations

import numpy as np

from hmmseg.plot.style import BLUE, GREY, INK, canvas
from paper_figs.panels import only
from paper_figs.results import load, target

CLEAR = {"block2": 0.66, "block1": 0.08}  # s left of the arrow, clear of the curve


def main() -> None:
    found = load("recording")
    t, y = np.array(found["t"]), 100 * np.array(found["signals"]["y2"])
    used = np.array(found["used"]["height"], bool)
    level = {}
    for span in found["spans"]:
        if span["subtask"] in ("pickup", "place"):
            inside = used & (t >= span["start"]) & (t < span["end"])
            level[span["object"], span["subtask"]] = (y[inside].mean(), (span["start"] + span["end"]) / 2)
    with canvas(target("fig09"), height=2.6) as figure:
        ax = figure.subplots()
        ax.plot(t, y, color=GREY, lw=0.9, ls=(0, (3, 1.5)), label="right finger, all states")
        ax.plot(t, only(y, used), color=BLUE, lw=2.0, label="used for a height (hold on ground)")
        for moved, beneath in (("block1", "block2"), ("block2", "block1")):
            (first, start), (second, end) = level[moved, "pickup"], level[moved, "place"]
            ax.plot([start, end], [first, first], color=INK, lw=0.5, ls=":")
            at = end - 0.12
            ax.annotate(
                "",
                (at, second),
                (at, first),
                arrowprops={"arrowstyle": "<->", "lw": 0.7, "color": INK, "shrinkA": 0, "shrinkB": 0},
            )
            ax.text(
                at - CLEAR[beneath],
                (first + second) / 2,
                f"height of {beneath}\n{abs(second - first):.2f} cm",
                ha="right",
                va="center",
                fontsize=7.5,
            )
        ax.set_xlim(0, 10)
        ax.set_ylim(0, 6.5)
        ax.set_xlabel("Time [s]")
        ax.set_ylabel("$y_2$ [cm]")
        ax.legend(loc="upper right", ncols=2)


if __name__ == "__main__":
    main()
