"""Reliability of the blind check's probabilities."""

from __future__ import annotations

import json

import numpy as np

from hmmseg.plot.style import BLUE, GREY, canvas
from paper_figs.results import ROOT, target

RESULTS = ROOT / "experiments" / "results" / "blind_check.json"
PANELS = (
    ("calibration_error", "probability of the likeliest verdict"),
    ("inclusion_all", "probability that an effect acts"),
)


def gap_reliability() -> None:
    """Plot the share that came true against the stated probability, for verdicts and single effects."""
    found = json.loads(RESULTS.read_text(encoding="utf-8"))["table"]
    with canvas(target("gap_reliability"), height=3.2) as figure:
        for ax, (key, words) in zip(figure.subplots(1, 2), PANELS, strict=True):
            bins = found[key]["bins"]
            ax.plot([0, 1], [0, 1], color=GREY, lw=0.8, ls="--", label="as said")
            said, true = (np.array([b[k] for b in bins]) for k in ("said", "true"))
            ax.plot(said, true, "o", ms=4, color=BLUE, label="found")
            for x, y, b in zip(said, true, bins, strict=True):
                ax.annotate(f"{b['count']}", (x, y), (5, -9), textcoords="offset points", fontsize=6.5)
            ax.set(xlabel=words, ylabel="share that comes true")
            ax.set(xlim=(-0.02, 1.04), ylim=(-0.02, 1.04))
            ax.set_title(f"calibration error {found[key]['value']:.3f}; numbers are counts", loc="left")
            ax.legend(loc="upper left")
