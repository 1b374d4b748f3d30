"""The task-space signals of one trial with its subtasks, after the paper's Figures 5 to 7."""

from __future__ import annotations

from pathlib import Path

from hmmseg.drawing import canvas
from hmmseg.hand.signals import Signals
from hmmseg.segmentation.spans import Segmentation
from hmmseg_cli.figures.spans import Panel, stacked_panels


def draw_signals(signals: Signals, segmentation: Segmentation, path: Path) -> None:
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
        stacked_panels(figure, signals.t, panels, segmentation)
