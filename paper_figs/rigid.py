"""Widths under rigid fingertips: how short, and which pads or grips the paper's own figures need."""

from __future__ import annotations

import numpy as np

from hmmseg.plot.style import GREY, INK, RED, canvas
from paper_figs.panels import BLOCK_COLOURS
from paper_figs.results import load, target


def main() -> None:
    found = load("rigid")
    needed = found["needed"]
    with canvas(target("rigid"), height=3.3) as figure:
        left, right = figure.subplots(1, 2)
        grip = np.linspace(0, 4, 50)
        left.plot(
            grip, 2e3 * grip / needed["nominal_stiffness"], color=INK, lw=0.9, label="$2N/k$, nominal pads"
        )
        for name, colour in BLOCK_COLOURS.items():
            for source, marker in (("recordings", "o"), ("simulated", "^")):
                rows = [r for r in found[source] if r["object"] == name]
                left.plot(
                    [r["grip"] for r in rows],
                    [1e3 * r["short"] for r in rows],
                    marker,
                    ms=4.5,
                    color=colour,
                    mec=INK,
                    mew=0.4,
                    label=f"{name}, {source}",
                )
            need = needed["blocks"][name]
            left.plot([0, need["grip_at_nominal"]], [1e3 * need["short"]] * 2, color=colour, lw=0.8, ls="--")
            left.plot(
                need["grip_at_nominal"],
                1e3 * need["short"],
                "*",
                color=RED,
                ms=10,
                mec=INK,
                mew=0.4,
                zorder=5,
            )
            left.text(
                0.06, 1e3 * need["short"] + 0.03, f"paper, {name}: {1e3 * need['short']:.1f} mm", fontsize=7
            )
            stiffness = np.array(need["stiffness"])
            right.plot(
                needed["grip"],
                stiffness / 1e3,
                color=colour,
                lw=1.6,
                label=f"{name}: {1e3 * need['short']:.1f} mm short",
            )
        left.set_title("(a)", loc="left", fontweight="bold")
        right.set_title("(b)", loc="left", fontweight="bold")
        left.set_xlim(0, 4)
        left.set_ylim(0, 2.1)
        left.set_xlabel("Mean grip in the carry, $N$ [N]")
        left.set_ylabel("Width short with rigid fingertips [mm]")
        left.legend(loc="lower right")
        right.axhline(needed["nominal_stiffness"] / 1e3, color=GREY, lw=0.8, ls="--")
        right.text(
            1.05, needed["nominal_stiffness"] / 1e3 + 0.06, "the stand-in's pads", fontsize=7, color=GREY
        )
        right.set_xlabel("Grip, $N$ [N]")
        right.set_ylabel("Pad stiffness that this takes [N/mm]")
        right.set_xlim(1, 4)
        right.set_ylim(0, None)
        right.legend(loc="lower right")


if __name__ == "__main__":
    main()
