"""A replay against its recording: forces measured and predicted, after the paper's Figures 12 to 14."""

from __future__ import annotations

from pathlib import Path

from hmmseg.plot.spans import Panel, stacked_panels
from hmmseg.plot.style import BLUE, canvas
from hmmseg.segmentation.spans import Segmentation
from simgap.world.replay import Replay


def draw_replay(result: Replay, segmentation: Segmentation, path: Path) -> None:
    """Grip, net and shear forces measured and predicted, over coloured subtasks."""
    signals, predicted = result.signals, result.predicted
    panels = [
        Panel("Distance\n[cm]", 100 * signals.distance),
        Panel("Grip\n[N]", signals.grip),
        Panel("Net $f_x$\n[N]", signals.fx),
        Panel("Net $f_y$\n[N]", signals.fy),
        Panel("Shear\n[N]", signals.shear),
    ]
    with canvas(path, height=6.4) as figure:
        axes = stacked_panels(figure, signals.t, panels, segmentation)
        curves = (predicted["grip"], predicted["fx"], predicted["fy"], predicted["shear"])
        for ax, values in zip(axes[1:], curves, strict=True):
            ax.plot(signals.t, values, color=BLUE, lw=0.9, label="virtual model")
        axes[1].lines[0].set_label("recording")
        axes[1].set_ylim(top=1.4 * axes[1].get_ylim()[1])  # room for the legend
        axes[1].legend(handles=[axes[1].lines[0], axes[1].lines[-1]], loc="upper right", ncols=2)
