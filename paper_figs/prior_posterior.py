"""What was known before and after: prior, posterior of one recording and of ten."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from scipy.stats import gaussian_kde

from hmmseg.numbers import SHOWN
from hmmseg.plot.style import BLUE, GREEN, GREY, RED, canvas
from paper_figs.results import load, target

PRIOR_SPREAD, POSTERIOR_SPREAD = 2.6, 4.0  # standard deviations shown
POSTERIORS = (("one", GREEN, "one recording"), ("all", BLUE, "ten recordings"))


def draw(ax: Axes, found: dict[str, Any], k: int) -> None:
    """A property's prior over its whole range; the posteriors, which are a line in it, enlarged."""
    block, key = found["all"]["names"][k]
    factor, unit = SHOWN[key]
    mean, sd = found["all"]["prior_log_mean"][k], found["all"]["prior_log_sd"][k]
    draws = {which: factor * np.array(found[which]["draws"])[:, k] for which, *_ in POSTERIORS}
    x = factor * np.exp(mean + sd * np.linspace(-PRIOR_SPREAD, PRIOR_SPREAD, 300))
    ax.fill_between(x, np.exp(-0.5 * ((np.log(x / factor) - mean) / sd) ** 2), color=GREY, alpha=0.5, lw=0)
    ax.plot([draws["all"].mean()] * 2, [0, 1.0], color=BLUE, lw=1.0)
    ax.set_xscale("log")
    ax.set_ylim(0, 2.9)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.set_xlabel(f"{block} {key} [{unit}]")
    narrower = sd / np.log(draws["all"]).std()
    ax.text(0.02, 0.97, f"{narrower:.0f} times\nnarrower", transform=ax.transAxes, va="top", fontsize=7)
    inset = ax.inset_axes((0.36, 0.5, 0.62, 0.48))
    near = draws["one"].mean() + draws["one"].std() * np.linspace(-POSTERIOR_SPREAD, POSTERIOR_SPREAD, 300)
    for which, colour, _ in POSTERIORS:
        density = gaussian_kde(draws[which])(near)
        inset.plot(near, density / density.max(), color=colour, lw=1.1)
    inset.axvline(factor * found["actual"][block][key][0], color=RED, lw=0.9, ls="--")
    inset.set_yticks([])
    inset.set_ylim(0, 1.08)
    inset.xaxis.set_major_locator(MaxNLocator(3))
    inset.tick_params(labelsize=6.5)
    inset.spines["left"].set_visible(False)


def main() -> None:
    found = load("posterior")
    with canvas(target("prior_posterior"), height=4.4) as figure:
        axes = figure.subplots(2, 3)
        for k, ax in enumerate(axes.flat):
            draw(ax, found, k)
        handles = [Patch(color=GREY, alpha=0.5, lw=0, label="prior")]
        handles += [Line2D([], [], color=colour, label=label) for _, colour, label in POSTERIORS]
        handles.append(Line2D([], [], color=RED, lw=0.9, ls="--", label="actual"))
        figure.legend(handles=handles, loc="outside lower center", ncols=4)


if __name__ == "__main__":
    main()
