"""docs/sequences.md: table and figure of what experiments/sequences.py found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from experiments.table_text import load, markdown, percent

FIGURE = Path(__file__).parents[1] / "docs" / "figures" / "sequences.png"
ROWS = {
    "none": "no labels", "asked": "the label asked for", "trial": "one labelled trial",
}  # fmt: skip


def table() -> str | None:
    """A row for each group of cases and what was known; draws the figure."""
    found = load("sequences")
    if found is None:
        return None
    rows = []
    for group, entry in found["groups"].items():
        for key, label in ROWS.items():
            s = entry[key]
            if not s:
                continue
            sure = "" if s["sure_right"] is None else percent(s["sure_right"], 0)
            shares = [percent(s[k], 0) for k in ("right", "within_a_sample", "listed", "coverage_90")]
            cells = [f"{s['boundaries']}", percent(s["median"]), *shares, percent(s["width"])]
            rows.append([group, label, *cells, percent(s["sure"], 0), sure])
    _draw(found["groups"], FIGURE)
    head = ["cases", "known", "boundaries", "median error", "right", "within a sample",
            "truth at a listed place", "90 % intervals hold", "their width", "one place only",
            "of these right"]  # fmt: skip
    note = (
        f"{found['worlds']} worlds drawn of many kinds, as many of levels that jump in white noise (abrupt). "
        "Errors and widths as shares of the trial. The labelled trial is not scored."
    )
    return f"{markdown(head, rows)}\n\n{note}"


def _draw(groups: dict[str, Any], path: Path) -> None:
    """Reliability: probability said of places without labels, and the share that were true."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(4.2, 4.0), layout="constrained")
    ax.plot([0, 1], [0, 1], color="0.6", lw=0.8)
    for group, entry in groups.items():
        bins = entry["none"]["reliability"]
        ax.plot([b["said"] for b in bins], [b["true"] for b in bins], "-", lw=0.8, label=group)
        ax.scatter(
            [b["said"] for b in bins],
            [b["true"] for b in bins],
            s=[3 + 40 * b["count"] / max(each["count"] for each in bins) for b in bins],
        )
    ax.set_xlabel("probability said of a place")
    ax.set_ylabel("share that were true")
    ax.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
