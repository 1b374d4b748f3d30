"""Figure 14: width while held, (a) of the recorded blocks 1 and 2, (b) of the virtual block 2."""

from __future__ import annotations

import numpy as np

from hmmseg.plot.style import BLUE, GREY, ORANGE, canvas
from paper_figs.panels import only, stacked
from paper_figs.results import load, target


def main() -> None:
    found = load("virtual_block")
    with canvas(target("fig14"), height=3.8) as figure:
        axes = stacked(figure, 2)
        for ax, name in zip(axes, ("recording", "virtual"), strict=True):
            one = found[name]
            distance = 100 * np.array(one["distance"])
            held = np.any([carry["inside"] for carry in one["carries"]], axis=0)
            ax.plot(one["t"], distance, color=GREY, lw=0.9, ls=(0, (3, 1.5)), label="distance of the fingers")
            ax.plot(one["t"], only(distance, held), color=BLUE, lw=2, label="while held above ground")
            for carry in one["carries"]:
                width = 100 * carry["width"]["mean"]
                ax.text(
                    (carry["start"] + carry["end"]) / 2,
                    width - 0.12,
                    f"{carry['object']}: {width:.2f} cm\nunder {carry['grip']['mean']:.1f} N",
                    ha="center",
                    va="top",
                    fontsize=7.5,
                )
            ax.set_ylabel("$x_2 - x_1$ [cm]")
            ax.set_ylim(0.5, 4.4)
            ax.axhline(100 * found["size"][0], color=ORANGE, lw=0.9, label="block 2's identified width")
        axes[0].legend(loc="upper right", ncols=3)
        axes[-1].set_xlim(0, 10)


if __name__ == "__main__":
    main()
