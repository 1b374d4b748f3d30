"""Figure 8: the net vertical force, and what of it gives the weights."""

from __future__ import annotations

import numpy as np

from hmmseg.plot.style import BLUE, GREY, canvas
from paper_figs.panels import only
from paper_figs.results import load, target


def main() -> None:
    found = load("recording")
    force, used = np.array(found["signals"]["fy"]), np.array(found["used"]["weight"], bool)
    t = np.array(found["t"])
    with canvas(target("fig08"), height=2.4) as figure:
        ax = figure.subplots()
        ax.axhline(0, color=GREY, lw=0.5)
        ax.plot(t, force, color=GREY, lw=0.9, ls=(0, (3, 1.5)), label="net vertical force, all states")
        ax.plot(t, only(force, used), color=BLUE, lw=1.6, label="used for a weight (hold above ground)")
        for span in (s for s in found["spans"] if s["subtask"] == "carry"):
            inside = used & (t >= span["start"]) & (t < span["end"])
            mean, sd = force[inside].mean(), force[inside].std(ddof=1)
            ax.annotate(
                f"{span['object']}: {mean:.3f} ± {sd:.3f} N",
                ((span["start"] + span["end"]) / 2, 0.62),
                ha="center",
                va="bottom",
                fontsize=7.5,
            )
        ax.set_xlim(0, 10)
        ax.set_ylim(-2, 1)
        ax.set_xlabel("Time [s]")
        ax.set_ylabel("$f_{y1} + f_{y2}$ [N]")
        ax.legend(loc="lower left", ncols=2)


if __name__ == "__main__":
    main()
