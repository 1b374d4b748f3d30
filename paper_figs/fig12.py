"""Figure 12: forces while virtual block 2 is picked up and placed twice."""

from __future__ import annotations

from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hmmseg.plot.style import GREY, INK, STATE_COLOURS, canvas
from paper_figs.panels import THRESHOLD_HANDLE, forces
from paper_figs.results import load, target


def main() -> None:
    found = load("virtual_block")
    with canvas(target("fig12"), height=5.4) as figure:
        axes = forces(figure, found["virtual"], found["recording"])
        for ax in axes:
            for carry in found["virtual"]["carries"]:
                ax.axvspan(
                    carry["start"],
                    carry["end"],
                    color=STATE_COLOURS["hold-above-ground"],
                    alpha=0.3,
                    lw=0,
                    zorder=0,
                )
        lines = [
            Line2D([], [], color=INK, lw=0.9, label="virtual block 2, twice"),
            Line2D([], [], color=GREY, lw=0.7, label="recording: block 1, then block 2"),
        ]
        held = Patch(color=STATE_COLOURS["hold-above-ground"], alpha=0.3, lw=0, label="virtual block held")
        handles = [*lines, held, THRESHOLD_HANDLE]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)


if __name__ == "__main__":
    main()
