"""The task-space signals of one trial with its subtasks, after the paper's Figures 5 to 7."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes

from hmmseg.hand.signals import Signals
from hmmseg.plot.spans import Panel, stacked_panels
from hmmseg.plot.style import canvas
from hmmseg.segmentation.spans import Segmentation


def draw_signals(signals: Signals, segmentation: Segmentation, path: Path | None = None) -> list[Axes]:
    """Mean position, finger distance, grip, net and shear forces over coloured subtasks."""
    panels = [
        Panel("Mean $x$\n[cm]", 100 * signals.x),
        Panel("Mean $y$\n[cm]", 100 * signals.y),
        Panel("Distance\n[cm]", 100 * signals.distance),
        Panel("Grip\n[N]", signals.grip),
        Panel("Net $f_x$\n[N]", signals.fx),
        Panel("Net $f_y$\n[N]", signals.fy),
        Panel("Shear\n[N]", signals.shear),
    ]
    with canvas(path, height=8.2) as figure:
        return stacked_panels(figure, signals.t, panels, segmentation)
