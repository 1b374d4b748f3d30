"""Panels over time and pictures of fingers and blocks, shared by several of the paper's figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from hmmseg.plot.style import GREY, INK, ORANGE, SKY, STATE_COLOURS

THRESHOLD = 0.05  # N
BLOCK_COLOURS = {"block1": SKY, "block2": ORANGE}
PAD, SHANK, SHANK_HEIGHT, PAD_HEIGHT = 0.002, 0.003, 0.03, 0.012  # m, as drawn
THRESHOLD_HANDLE = Line2D([], [], color=GREY, lw=0.6, ls=(0, (4, 3)), label="thresholds ± 0.05 N")


def stacked(figure: Figure, count: int) -> list[Axes]:
    """Panels (a), (b), ... one above the other over time [s]."""
    axes = list(np.atleast_1d(figure.subplots(count, 1, sharex=True)))
    for letter, ax in zip("abcdefg", axes, strict=False):
        ax.text(0.006, 0.95, f"({letter})", transform=ax.transAxes, va="top", fontweight="bold")
    axes[-1].set_xlabel("Time [s]")
    return axes


def shade(ax: Axes, spans: Iterable[Mapping[str, Any]]) -> None:
    """Subtasks in the colours of their states."""
    for span in spans:
        ax.axvspan(span["start"], span["end"], color=STATE_COLOURS[span["state"]], alpha=0.3, lw=0, zorder=0)


def state_handles(states: Iterable[str] = ("free-motion", "hold-on-ground", "hold-above-ground")) -> list:
    """Legend entries of the states."""
    return [Patch(color=STATE_COLOURS[state], alpha=0.3, lw=0, label=state) for state in states]


def name_marks(ax: Axes, marks: Iterable[tuple[float, str]], height: float = 0.97) -> None:
    """Short names at times, along the top of a panel."""
    for time, text in marks:
        ax.text(time, height, text, transform=ax.get_xaxis_transform(), ha="center", va="top",
                fontsize=7.5, style="italic")  # fmt: skip


def thresholds(ax: Axes) -> None:
    """The force thresholds as dashed lines."""
    for level in (-THRESHOLD, THRESHOLD):
        ax.axhline(level, color=GREY, lw=0.6, ls=(0, (4, 3)), zorder=1)


def only(values: Sequence[float], chosen: Sequence[int]) -> np.ndarray:
    """Values where `chosen`, else NaN, so that lines break."""
    return np.where(np.asarray(chosen, bool), np.array(values, float), np.nan)


def forces(
    figure: Figure, one: Mapping[str, Sequence[float]], behind: Mapping[str, Sequence[float]] | None = None
) -> list[Axes]:
    """The four panels of the paper's Figures 6 and 12; `behind` is drawn in grey."""
    labels = {"fx": "Net $f_x$ [N]", "fy": "Net $f_y$ [N]", "grip": "Grip [N]", "shear": "Shear [N]"}
    axes = stacked(figure, len(labels))
    for ax, (name, label) in zip(axes, labels.items(), strict=True):
        thresholds(ax)
        if behind is not None:
            ax.plot(behind["t"], behind[name], color=GREY, lw=0.7)
        ax.plot(one["t"], one[name], color=INK, lw=0.9)
        ax.set_ylabel(label)
        low, high = ax.get_ylim()
        ax.set_ylim(low - 0.06 * (high - low), high + 0.2 * (high - low))
    axes[-1].set_xlim(0, 10)
    figure.align_ylabels(axes)
    return axes


def scene(
    ax: Axes,
    fingers: Sequence[Sequence[float]],
    blocks: Mapping[str, Sequence[float]],
    sizes: Mapping[str, Sequence[float]],
    names: bool = True,
) -> None:
    """Fingers with their pads, blocks and ground, all in cm; positions and (width, height) in m.

    The pads reach to their undeformed faces; what a block hides of them is pressed in.
    """
    for sign, (x, y) in zip((-1, 1), fingers, strict=True):
        near = x if sign > 0 else x - PAD
        bottom = y - PAD_HEIGHT / 2
        far = x + PAD if sign > 0 else x - PAD - SHANK
        ax.add_patch(_box(near, bottom, PAD, PAD_HEIGHT, facecolor="#E8C9A0", edgecolor=INK, lw=0.4))
        ax.add_patch(_box(far, bottom, SHANK, SHANK_HEIGHT, facecolor="#9AA5AE", edgecolor=INK, lw=0.4))
    for name, (x, y) in blocks.items():
        width, height = sizes[name]
        ax.add_patch(_box(x - width / 2, y - height / 2, width, height, facecolor=BLOCK_COLOURS[name],
                          edgecolor=INK, lw=0.5, zorder=3))  # fmt: skip
        if names:
            ax.text(100 * x, 100 * y, name[-1], ha="center", va="center", fontsize=7, zorder=4)
    ax.axhline(0, color=INK, lw=0.8, zorder=2)
    ax.axhspan(-1, 0, color=GREY, alpha=0.35, lw=0)
    ax.set_aspect("equal")


def _box(x: float, y: float, width: float, height: float, **style: Any) -> Rectangle:
    return Rectangle((100 * x, 100 * y), 100 * width, 100 * height, **style)
