"""Figure 13: the virtual block's weight, beside the recording's block 2."""

from __future__ import annotations

import numpy as np

from hmmseg.plot.style import BLUE, GREY, ORANGE, canvas
from paper_figs.panels import only
from paper_figs.results import load, target


def main() -> None:
    found = load("virtual_block")
    virtual = found["virtual"]
    held = np.any([carry["inside"] for carry in virtual["carries"]], axis=0)
    real = found["recording"]["carries"][-1]["weight"]
    with canvas(target("fig13"), height=2.6) as figure:
        ax = figure.subplots()
        ax.axhline(0, color=GREY, lw=0.5)
        ax.plot(virtual["t"], virtual["fy"], color=GREY, lw=0.9, ls=(0, (3, 1.5)), label="net vertical force")
        ax.plot(
            virtual["t"],
            only(virtual["fy"], held),
            color=BLUE,
            lw=1.6,
            label="while the virtual block is held",
        )
        ax.axhspan(
            real["mean"] - real["sd"],
            real["mean"] + real["sd"],
            color=ORANGE,
            alpha=0.35,
            lw=0,
            label="block 2 as recorded, mean ± sd",
        )
        for carry in virtual["carries"]:
            ax.text(
                (carry["start"] + carry["end"]) / 2,
                0.62,
                f"{carry['weight']['mean']:.3f} ± {carry['weight']['sd']:.3f} N",
                ha="center",
                va="bottom",
                fontsize=7.5,
            )
        ax.set_xlim(0, 10)
        ax.set_ylim(-2.4, 1)
        ax.set_xlabel("Time [s]")
        ax.set_ylabel("$f_{y1} + f_{y2}$ [N]")
        ax.legend(loc="lower center", ncols=3)


if __name__ == "__main__":
    main()
