"""Figure 5: positions of the two fingers."""

from __future__ import annotations

import numpy as np

from hmmseg.plot.style import INK, canvas
from paper_figs.panels import name_marks, shade, stacked, state_handles
from paper_figs.results import load, target

PANELS = {
    "x": "Mean $x$ [cm]",
    "y": "Mean $y$ [cm]",
    "distance": "Distance\n$x_2 - x_1$ [cm]",
    "offset": "Offset\n$y_2 - y_1$ [mm]",
}


def main() -> None:
    found = load("recording")
    middle = {(s["subtask"], s["object"]): (s["start"] + s["end"]) / 2 for s in found["spans"]}
    with canvas(target("fig05"), height=5.4) as figure:
        axes = stacked(figure, len(PANELS))
        for ax, (name, label) in zip(axes, PANELS.items(), strict=True):
            shade(ax, found["spans"])
            ax.plot(
                found["t"], (1000 if name == "offset" else 100) * np.array(found["signals"][name]), color=INK
            )
            ax.set_ylabel(label)
            ax.margins(y=0.22)
        name_marks(axes[0], [(time, "m") for (name, _), time in middle.items() if name in ("carry",)])
        released = next(s for s in found["spans"] if s["subtask"] == "release")
        name_marks(axes[0], [((released["start"] + released["end"]) / 2, "m")])
        name_marks(
            axes[1], [(time, "gg") for (name, _), time in middle.items() if name in ("pickup", "place")]
        )
        name_marks(axes[2], [(middle["carry", name], f"g{name[-1]}") for name in ("block1", "block2")])
        axes[-1].set_xlim(0, 10)
        figure.align_ylabels(axes)
        figure.legend(handles=state_handles(), loc="outside lower center", ncols=3)


if __name__ == "__main__":
    main()
