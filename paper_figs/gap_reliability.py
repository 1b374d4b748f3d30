"""How often the likeliest verdict of the blind check is right, by the probability it was given."""

from __future__ import annotations

import numpy as np

from hmmseg.plot.style import BLUE, GREY, canvas
from paper_figs.gap_results import load
from paper_figs.results import target


def main() -> None:
    found = load()
    bins, error = found["reliability"], found["table"]["calibration_error"]["value"]
    with canvas(target("gap_reliability"), width=3.6, height=3.2) as figure:
        ax = figure.subplots()
        ax.plot([0, 1], [0, 1], color=GREY, lw=0.8, ls="--", label="as said")
        said = np.array([b["said"] for b in bins])
        right = np.array([b["right"]["value"] for b in bins])
        ends = np.array([b["right"]["interval_95"] for b in bins]).T
        ax.errorbar(said, right, np.abs(ends - right), fmt="o", ms=4, color=BLUE, capsize=2, lw=0.9,
                    label="found, 95 % interval")  # fmt: skip
        for x, y, b in zip(said, right, bins, strict=True):
            ax.annotate(f"{b['right']['count']}", (x, y), (5, -9), textcoords="offset points", fontsize=6.5)
        ax.set_xlabel("probability of the likeliest verdict")
        ax.set_ylabel("share that is right")
        ax.set_xlim(0, 1.04)
        ax.set_ylim(-0.02, 1.04)
        ax.set_title(f"calibration error {error:.3f}; numbers are cases", loc="left")
        ax.legend(loc="upper left")


if __name__ == "__main__":
    main()
