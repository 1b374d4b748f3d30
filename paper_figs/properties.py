"""Figures of the properties: estimates, posteriors, and the errors of the paper's widths and heights."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from scipy.stats import gaussian_kde

from hmmseg.numbers import SHOWN
from hmmseg.plot.style import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, RED, canvas
from paper_figs.panels import BLOCK_COLOURS
from paper_figs.results import load, target

KEYS = ("weight", "height", "width")
BLOCKS = ("block1", "block2")
ROWS = (
    ("printed", "one", "the paper, as printed", RED, "*"),
    ("paper", "one", "its method, one recording", ORANGE, "s"),
    ("paper", "all", "its method, ten recordings", ORANGE, "D"),
    ("bayes", "one", "Bayesian, one recording", GREEN, "^"),
    ("bayes", "all", "Bayesian, ten recordings", BLUE, "o"),
)
JITTER = 0.09
CORNER = 7.2  # in
LEVELS = (0.393, 0.865)  # one and two standard deviations of a plane normal
PRIOR_SPREAD, POSTERIOR_SPREAD = 2.6, 4.0  # standard deviations shown
POSTERIORS = (("one", GREEN, "one recording"), ("all", BLUE, "ten recordings"))


def entry(table: dict[str, Any], method: str, which: str, block: str, key: str) -> tuple[float, float]:
    """Mean and sd of one estimate."""
    if method == "printed":
        mean, sd = table["printed"][block][key]
        return mean, sd
    found = table["recordings"][method][which][block][key]
    return found["mean"], found["sd"]


def draw_estimates(ax: Axes, table: dict[str, Any], rows: tuple) -> None:
    names = [(block, key) for block in BLOCKS for key in KEYS]
    for y, (block, key) in enumerate(names):
        value, spread = table["actual"][block][key]
        ax.fill_betweenx(
            [y - 0.42, y + 0.42], -100 * spread / value, 100 * spread / value, color=GREY, alpha=0.35, lw=0
        )
        for k, (method, which, label, colour, marker) in enumerate(rows):
            mean, sd = entry(table, method, which, block, key)
            place = y + 0.15 * (k - (len(rows) - 1) / 2)
            ax.errorbar(
                100 * (mean / value - 1),
                place,
                xerr=100 * sd / value,
                fmt=marker,
                color=colour,
                ms=4.5,
                lw=1,
                mec=INK,
                mew=0.3,
                label=label if y == 0 else None,
            )
    for y in range(1, len(names)):
        ax.axhline(y - 0.5, color=GREY, lw=0.4, alpha=0.6)
    ax.axvline(0, color=INK, lw=0.5, zorder=0)
    ax.set_yticks(range(len(names)), [f"{block}\n{key}" for block, key in names])
    ax.set_ylim(len(names) - 0.45, -0.55)
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel("Estimate − actual [% of actual]")


def table4() -> None:
    """Table 4 as a picture: every estimate's deviation from the actual value."""
    table = load("estimates")["table_4"]
    with canvas(target("table4"), height=4.6) as figure:
        left, right = figure.subplots(1, 2, sharey=True, width_ratios=[1.7, 1])
        draw_estimates(left, table, ROWS)
        left.set_xlim(-21, 21)
        left.set_title("all methods (bars: ± 1 sd)", fontsize=8)
        draw_estimates(right, table, ROWS[3:])
        right.set_xlim(-1.9, 1.9)
        right.set_title("the Bayesian ones, ten times enlarged", fontsize=8)
        handles, labels = left.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)


def rigid() -> None:
    """Widths under rigid fingertips: their shortfall, and the pads or grips that the paper's figures
    imply."""
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


def slip() -> None:
    """Slip and the paper's heights: (a) what slip does, (b) what recordings show."""
    found = load("slip")
    with canvas(target("slip"), height=3.3) as figure:
        left, right = figure.subplots(1, 2)
        draw_relation(left, found)
        draw_recordings(right, found)


def corner() -> None:
    """Joint posterior of all properties: of one recording, and of ten pooled."""
    with warnings.catch_warnings():  # its ArviZ announces its own refactoring at import
        warnings.filterwarnings("ignore", category=FutureWarning)
        from corner.corner import corner
    found = load("posterior")
    names = found["all"]["names"]
    factors = np.array([SHOWN[key][0] for _, key in names])
    draws = {which: np.array(found[which]["draws"]) * factors for which in ("one", "all")}
    truths = [found["actual"][block][key][0] * SHOWN[key][0] for block, key in names]
    labels = [f"{block}\n{key} [{SHOWN[key][1]}]" for block, key in names]
    low, high = (draws["one"].mean(axis=0) + k * draws["one"].std(axis=0) for k in (-4, 4))
    ranges = [
        (min(a, t) - 0.05 * (b - a), max(b, t) + 0.05 * (b - a))
        for a, b, t in zip(low, high, truths, strict=True)
    ]
    with canvas(target("corner"), width=CORNER, height=CORNER, layout=None) as figure:
        for which, colour in (("one", GREY), ("all", BLUE)):
            corner(
                draws[which],
                fig=figure,
                labels=labels,
                range=ranges,
                color=colour,
                levels=LEVELS,
                bins=60,
                smooth=1.5,
                plot_datapoints=False,
                plot_density=False,
                max_n_ticks=3,
                labelpad=0.18,
                label_kwargs={"fontsize": 7.5},
                hist_kwargs={"lw": 1, "density": True},
                contour_kwargs={"linewidths": 0.9},
            )
        axes = np.array(figure.axes).reshape(len(names), len(names))
        for ax in axes[1:, 0]:  # labels near a corner would meet those of the next panel
            low, high = ax.get_ylim()
            ticks = [tick for tick in ax.get_yticks() if low < tick < high]
            inner = [0.1 < (tick - low) / (high - low) < 0.9 for tick in ticks]
            ax.set_yticks(ticks, [f"{t:.3f}" if shown else "" for t, shown in zip(ticks, inner, strict=True)])
        for i, vertical in enumerate(truths):
            for row in range(i, len(names)):
                axes[row, i].axvline(vertical, color=RED, lw=0.7)
            for column in range(i):
                axes[i, column].axhline(vertical, color=RED, lw=0.7)
        figure.subplots_adjust(0.11, 0.11, 0.98, 0.98)
        handles = [
            Line2D([], [], color=GREY, label="one recording"),
            Line2D([], [], color=BLUE, label="ten recordings"),
            Line2D([], [], color=RED, label="actual"),
        ]
        figure.legend(handles=handles, loc="upper right", bbox_to_anchor=(0.97, 0.97))


def draw_property(ax: Axes, found: dict[str, Any], k: int) -> None:
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


def prior_posterior() -> None:
    """Prior, and posterior of one recording and of ten."""
    found = load("posterior")
    with canvas(target("prior_posterior"), height=4.4) as figure:
        axes = figure.subplots(2, 3)
        for k, ax in enumerate(axes.flat):
            draw_property(ax, found, k)
        handles = [Patch(color=GREY, alpha=0.5, lw=0, label="prior")]
        handles += [Line2D([], [], color=colour, label=label) for _, colour, label in POSTERIORS]
        handles.append(Line2D([], [], color=RED, lw=0.9, ls="--", label="actual"))
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
