"""Held load against known weight: offsets are systematic, scatter alone misleads."""

from __future__ import annotations

import json

import numpy as np

from hmmseg.plot.style import BLUE, GREY, ORANGE, RED, canvas
from paper_figs.results import ROOT, target

RESULTS = ROOT / "experiments" / "results" / "way_eeg_gal.json"


def main() -> None:
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    rows = found["scatter_alone"]
    weight = np.array([r["weight"] for r in rows])
    with canvas(target("way_eeg_gal"), height=2.8) as figure:
        left, right = figure.subplots(1, 2)
        left.errorbar(
            weight,
            [r["offset"] for r in rows],
            [r["sd_between_lifts"] for r in rows],
            fmt="o",
            color=RED,
            ms=4,
            capsize=3,
            label="held load - weight, sd of a lift",
        )
        line = np.linspace(0, 7, 50)
        styles = {
            "force_bias": (GREY, "bias"),
            "force_gain": (ORANGE, "gain"),
            "force_bias+force_gain": (BLUE, "both"),
        }
        for name, (colour, label) in styles.items():
            p = {k: v["mean"] for k, v in found["models"][name]["parameters"].items()}
            left.plot(line, p.get("bias", 0.0) + p.get("gain", 0.0) * line, color=colour, label=label)
        left.axhline(0, color=GREY, lw=0.6, ls="--")
        left.set(xlabel="weight [N]", ylabel="excess of the held load [N]", ylim=(-0.05, 0.45))
        left.legend(fontsize=6.5)
        names = list(styles)
        coverage = [found["models"][n]["weights"]["coverage_95"] for n in ("none", *names)]
        right.bar(range(4), coverage, color=[RED, GREY, ORANGE, BLUE])
        right.axhline(0.95, color=GREY, lw=0.8, ls="--")
        right.set_xticks(range(4), ["scatter\nalone", "bias", "gain", "both"])
        right.set(ylabel="95 % intervals that hold the weight", ylim=(0, 1))


if __name__ == "__main__":
    main()
