"""Style that all figures share: colour-blind safe colours, fonts, sizes, saving."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, SLIDING

WIDTH = 7.2  # look: in, a journal's double column
DPI = 200  # numerics: of figures
# Okabe and Ito's palette, distinguishable under the common colour vision deficiencies.
BLUE, ORANGE, GREEN, RED, PURPLE, SKY, YELLOW = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#F0E442",
)  # fmt: skip
INK, GREY = "#222222", "#8C8C8C"
STATE_COLOURS = {FREE: "#BDBDBD", ON_GROUND: ORANGE, SLIDING: PURPLE, ABOVE_GROUND: SKY}
OTHER_COLOURS = (SKY, ORANGE, GREEN, PURPLE, YELLOW, RED, BLUE)
STYLE: dict[Any, Any] = {
    "font.size": 8.0, "axes.titlesize": 8.0, "axes.labelsize": 8.0, "legend.fontsize": 7.5,
    "xtick.labelsize": 7.5, "ytick.labelsize": 7.5, "axes.linewidth": 0.6, "lines.linewidth": 0.9,
    "xtick.major.width": 0.6, "ytick.major.width": 0.6, "axes.spines.top": False,
    "axes.spines.right": False, "axes.edgecolor": INK, "text.color": INK, "axes.labelcolor": INK,
    "xtick.color": INK, "ytick.color": INK, "legend.frameon": False, "axes.axisbelow": True,
}  # fmt: skip


@contextmanager
def canvas(
    path: Path | None, width: float = WIDTH, height: float = 3.0,
    layout: Literal["constrained"] | None = "constrained",
) -> Iterator[Figure]:  # fmt: skip
    """An empty figure of this size [in], saved to `path` (kind by its suffix) when the block ends. Without
    pyplot: nothing stays open and no display is needed. Without a path the caller shows the figure; in a
    notebook, or if a script has loaded pyplot, it is one of pyplot's."""
    with matplotlib.rc_context(STYLE):
        if path is None and not sys.modules.keys().isdisjoint(("matplotlib.pyplot", "ipykernel")):
            from matplotlib import pyplot

            figure = pyplot.figure(figsize=(width, height), layout=layout)
        else:
            figure = Figure(figsize=(width, height), layout=layout)
            FigureCanvasAgg(figure)
        yield figure
        if path is not None:
            figure.savefig(path, dpi=DPI)


def state_colours(states: list[str]) -> dict[str, str]:
    """A colour for each state: fixed for contact states, by order of appearance for others."""
    others = [state for state in dict.fromkeys(states) if state not in STATE_COLOURS]
    chosen = {state: OTHER_COLOURS[i % len(OTHER_COLOURS)] for i, state in enumerate(others)}
    return {state: STATE_COLOURS.get(state) or chosen[state] for state in dict.fromkeys(states)}
