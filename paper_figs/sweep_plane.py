"""Noise x threshold: what the baseline does at each, beside methods that have no threshold."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize

from hmmseg.plot.style import GREY, INK, canvas
from paper_figs.sweep_results import load, target, value

PANELS = (
    ("boundary_median", "Boundary error, median [ms]", 1e3, LogNorm(1, 1000), "{:.3g}"),
    ("accuracy", "Samples in the right state [%]", 100, Normalize(40, 100), "{:.1f}"),
    ("weight", "Weight error, median [%]", 100, LogNorm(0.1, 30), "{:.2g}"),
    ("height", "Height error, median [%]", 100, LogNorm(0.01, 30), "{:.2g}"),
)
BESIDE = ("hindsight", "unconstrained", "ours")


def table(found: dict[str, Any], key: str) -> np.ndarray:
    """Values (num_noise_levels, num_thresholds + 3), infinite where too much is missing."""
    rows = []
    for row in found["sweeps"]["noise"]:
        methods = found["cells"][row["cell"]]["methods"]
        entries = [*methods["qualitative"], *(methods[name] for name in BESIDE)]
        rows.append([value(entry[key]) for entry in entries])
    return np.array(rows)


def draw_panel(
    ax: Axes, found: dict[str, Any], key: str, title: str, factor: float, norm, shown: str
) -> None:
    """One measure over the plane; the three columns at the right are apart from it."""
    values = factor * table(found, key)
    noise = [row["level"] for row in found["sweeps"]["noise"]]
    columns = np.concatenate([np.arange(values.shape[1] - 3), values.shape[1] - 3 + np.arange(3) + 0.35])
    colours = "viridis" if key == "accuracy" else "viridis_r"
    for j, x in enumerate(columns):
        for i in range(len(noise)):
            known = np.isfinite(values[i, j])
            shade = norm(np.clip(values[i, j], norm.vmin, norm.vmax)) if known else np.nan
            ax.bar(x, 0.98, 0.98, i - 0.49, color=_colour(colours, shade), lw=0)
            text = _number(values[i, j], shown) if known else "none"
            ax.text(x, i, text, ha="center", va="center", fontsize=6,
                    color="white" if known and _dark(colours, shade) else INK)  # fmt: skip
    names = [f"×{v:g}" for v in found["thresholds"]] + ["best", "free\nHMM", "ours"]
    ax.set_xticks(columns, names)
    ax.set_yticks(range(len(noise)), [f"×{v:g}" for v in noise])
    ax.tick_params(length=0)
    ax.set_xlim(columns[0] - 0.5, columns[-1] + 0.5)
    ax.set_ylim(-0.5, len(noise) - 0.5)
    for side in ("left", "bottom"):
        ax.spines[side].set_visible(False)
    ax.set_title(title, loc="left")


def _number(value: float, shown: str) -> str:
    return f"{value:.0f}" if value >= 100 else shown.format(value)


def _colour(colours: str, shade: float) -> Any:
    import matplotlib

    return GREY + "55" if np.isnan(shade) else matplotlib.colormaps[colours](shade)


def _dark(colours: str, shade: float) -> bool:
    red, green, blue, _ = _colour(colours, shade)
    return 0.3 * red + 0.59 * green + 0.11 * blue < 0.5


def main() -> None:
    found = load()
    with canvas(target("sweep_plane"), height=5.6) as figure:
        axes = figure.subplots(2, 2, sharey=True)
        for ax, panel in zip(axes.ravel(), PANELS, strict=True):
            draw_panel(ax, found, *panel)
        figure.supylabel("noise, in units of the rig's", fontsize=8)
        figure.supxlabel("baseline's thresholds, in units of the paper's 0.05 N and 0.05 m/s; best pair in "
                         "hindsight; methods without thresholds", fontsize=8)  # fmt: skip


if __name__ == "__main__":
    main()
