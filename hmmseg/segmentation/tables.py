"""Segmentations as tables for people to read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

if TYPE_CHECKING:
    from hmmseg.segmentation.spans import Segmentation


def spans_table(segmentation: Segmentation) -> Table:
    """The spans of one trial for people to read."""
    table = Table(title=f"{Path(segmentation.file).name} ({segmentation.rate:.4g} Hz)", title_justify="left")
    for head, justify in (("subtask", "left"), ("state", "left"), ("start [s]", "right"),
                          ("90 % interval", "left"), ("end [s]", "right")):  # fmt: skip
        table.add_column(head, justify=justify)  # type: ignore[arg-type]
    elsewhere = any(span.alternatives for span in segmentation.spans)
    if elsewhere:
        table.add_column("could as well be at [s]", justify="left")
    for span in segmentation.spans:
        low, high = span.start_90
        interval = f"{low:.3f} to {high:.3f}" if high > low else ""
        places = ", ".join(f"{p.time:.3f} ({100 * p.probability:.0f} %)" for p in span.alternatives)
        row = [span.label, span.state, f"{span.start:.3f}", interval, f"{span.end:.3f}"]
        table.add_row(*row, *[places] * elsewhere)
    return table


def trials_table(segmentations: Sequence[Segmentation]) -> Table:
    """One row a trial: whether it fits its task, or where it does not."""
    table = Table(title=f"{len(segmentations)} trials", title_justify="left")
    for head in ("trial", "rate", "subtasks", "fits its task"):
        table.add_column(head)
    for s in segmentations:
        verdict = "yes" if s.failed is None else str(s.failed)
        table.add_row(Path(s.file).name, f"{s.rate:.4g} Hz", str(len(s.spans)), verdict)
    return table
