"""Figure of docs/calibration.md: coverages by world, each with its standard error and what it should be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from experiments.stamps import save_figure

PANELS = (
    ("95", "properties, 95 %", (92, 97)), ("68", "properties, 68 %", (63, 73)),
    ("90", "boundaries, 90 %", (86, 94)),
)  # fmt: skip


def draw(rows: dict[str, dict[str, Any]], path: Path) -> None:
    """A panel for each level, a line for each world; grey is what is to be reached."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(10, 0.26 * len(rows) + 1.2), sharey=True, layout="constrained")
    names = list(rows)
    for ax, (key, title, (low, high)) in zip(axes, PANELS, strict=True):
        ax.axvspan(low, high, color="0.88", lw=0)
        for y, name in enumerate(names):
            share, error = rows[name][f"coverage_{key}"], rows[name][f"se_{key}"]
            if share is None:
                continue
            inside = low - 200 * error <= 100 * share <= high + 200 * error
            ax.errorbar(100 * share, y, xerr=100 * error, fmt="o", ms=3.5, lw=1,
                        color="C0" if inside else "C3")  # fmt: skip
        ax.set_title(title, fontsize=9)
        ax.set_xlim(30 if key == "68" else 55, 101)
        ax.tick_params(labelsize=8)
        ax.set_xlabel("true values inside [%]", fontsize=8)
        ax.grid(axis="x", lw=0.3)
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    path.parent.mkdir(parents=True, exist_ok=True)
    save_figure(figure, path)
    plt.close(figure)
