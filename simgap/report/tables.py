"""A diagnosis as tables for people to read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table

from hmmseg.numbers import estimate, interval, shown_as


def tables(body: Mapping[str, Any]) -> list[Table]:
    """Probabilities, parameters of the cause and the largest cells, for people to read."""
    likely = Table(title="probabilities", title_justify="left")
    likely.add_column("candidate", no_wrap=True)
    likely.add_column("probability", justify="right")
    for name, value in sorted(body["probabilities"].items(), key=lambda item: -item[1])[:6]:
        likely.add_row(name, f"{value:.3f}")
    out = [likely]
    if body["causes"]:
        values = Table(title="parameters", title_justify="left")
        for head in ("parameter", "estimate", "90 % interval"):
            values.add_column(head, no_wrap=True)
        for name, p in body["effects"]["+".join(body["causes"])]["parameters"].items():
            low, high = p["interval_90"]
            shown = shown_as(p["unit"])
            values.add_row(name, estimate(p["mean"], p["sd"], shown), interval(low, high, shown))
        out.append(values)
    if body["next_experiment"] is not None:
        following = Table(title="next experiment", title_justify="left", show_header=False)
        asked = body["next_experiment"]
        gain = f"by {asked['expected_gain_nats']:.0f} nats at least"
        following.add_row(asked["do"])
        following.add_row(f"expected to tell {', '.join(asked['separates'])} apart, {gain}")
        out.append(following)
    if body["where"]:
        cells = Table(title="where the gap is largest", title_justify="left")
        for head in ("trial", "channel", "subtask", "band [Hz]", "share", "z"):
            cells.add_column(head, no_wrap=True)
        for row in body["where"][:8]:
            low, high = row["band"]
            cells.add_row(
                row["trial"],
                row["channel"],
                row["subtask"],
                f"{low:g}-{high:g}",
                f"{100 * row['share']:.0f} %",
                f"{row['z']:.1f}",
            )
        out.append(cells)
    return out
