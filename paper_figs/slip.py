"""Slip and the paper's heights: (a) what slip does, (b) what recordings show."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from hmmseg.plot.style import BLUE, GREY, INK, PURPLE, RED, canvas
from paper_figs.panels import BLOCK_COLOURS
from paper_figs.results import load, target

JITTER = 0.09


def draw_relation(ax: Axes, found: dict[str, Any]) -> None:
    """Residual of a height against the slip that counts towards it [mm]."""
    line = np.array([-2.5, 4.5])
    ax.plot(line, line, color=GREY, lw=0.8, label="estimate − height = slip")
    ax.axhline(1e3 * found["long"], color=RED, lw=0.8, ls="--")
    ax.text(-2.3, 1e3 * found["long"] + 0.08, "the paper's block 1", fontsize=7, color=RED)
    whole = [r for r in found["performed"] if abs(r["slip"]) < 0.01]
    ax.plot(
        [1e3 * r["slip"] for r in whole],
        [1e3 * r["residual"] for r in whole],
        ".",
        color=INK,
        ms=3.5,
        label="whole virtual trials, less and less friction",
    )
    for key, colour, label in (
        ("lifting", BLUE, "slides down as it is lifted"),
        ("touching", PURPLE, "fingers slide down at touchdown"),
    ):
        rows = [r for r in found[key] if r["slip"] is not None]
        ax.plot(
            [1e3 * r["slip"] for r in rows],
            [1e3 * r["residual"] for r in rows],
            "o-",
            ms=3.5,
            lw=0.9,
            color=colour,
            label=label,
        )
    ax.set_xlabel("Slip from pickup to place, positive: block down [mm]")
    ax.set_ylabel("Height, estimate − actual [mm]")
    ax.set_xlim(-2.5, 2.9)
    ax.set_ylim(-2.5, 2.9)
    ax.legend(loc="lower right", fontsize=6.8)
    ax.set_title("(a)", loc="left", fontweight="bold")


def draw_recordings(ax: Axes, found: dict[str, Any]) -> None:
    """Residuals of both heights in recordings without and with slip, and the paper's."""
    groups = {"paper_blocks": "recordings\nwithout slip", "grip_slip_1": "recordings\nwith slip"}
    ax.axhline(0, color=GREY, lw=0.6)
    for k, group in enumerate(groups):
        for side, (name, colour) in zip((-0.2, 0.2), BLOCK_COLOURS.items(), strict=True):
            for pads, fill, shift in (("rigid", "white", -JITTER), ("compliant", colour, JITTER)):
                each = 1e3 * np.array(found[group][name][pads]["each"])
                ax.plot(
                    k + side + shift + np.linspace(-0.035, 0.035, each.size),
                    each,
                    "o",
                    ms=4,
                    mfc=fill,
                    mec=INK if fill != "white" else colour,
                    mew=0.8 if fill == "white" else 0.4,
                )
    for side, (name, colour), key in zip(
        (-0.2, 0.2), BLOCK_COLOURS.items(), ("long", "long_of_block2"), strict=True
    ):
        ax.plot(2 + side, 1e3 * found[key], "*", color=colour, ms=10, mec=INK, mew=0.5)
        ax.text(2 + side, 1e3 * found[key] + 0.12, f"height of\n{name}", ha="center", va="bottom", fontsize=7)
    ax.set_xticks(range(3), [*groups.values(), "the paper"])
    ax.set_xlim(-0.5, 2.5)
    ax.set_ylim(-1, 2.2)
    ax.set_ylabel("Height, estimate − actual [mm]")
    ax.plot([], [], "o", mfc="white", mec=GREY, ms=4, label="pads taken for rigid")
    ax.plot([], [], "o", mfc=GREY, mec=INK, mew=0.4, ms=4, label="pads' shear taken out")
    ax.legend(loc="upper left", fontsize=6.8)
    ax.set_title("(b)", loc="left", fontweight="bold")


def main() -> None:
    found = load("slip")
    with canvas(target("slip"), height=3.3) as figure:
        left, right = figure.subplots(1, 2)
        draw_relation(left, found)
        draw_recordings(right, found)


if __name__ == "__main__":
    main()
