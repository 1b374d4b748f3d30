"""The channels of a plain ordered task's trial with its subtasks."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes

from hmmseg.io.trial import Trial
from hmmseg.plot.spans import Panel, stacked_panels
from hmmseg.plot.style import canvas
from hmmseg.segmentation.spans import Segmentation

MOST = 12  # look: panels that stay legible on one page


def draw_channels(trial: Trial, segmentation: Segmentation, path: Path | None = None) -> list[Axes]:
    """Every channel of a trial, the first twelve at most, over coloured subtasks, in its own units."""
    names = list(trial.channels)[:MOST]
    panels = [Panel(name, trial.channels[name]) for name in names]
    with canvas(path, height=1.8 + 0.95 * len(panels)) as figure:
        axes = stacked_panels(figure, trial.t, panels, segmentation)
        left_out = len(trial.channels) - len(names)
        if left_out:
            axes[-1].set_xlabel(f"Time [s]   ({left_out} more channels not shown)")
        return axes
