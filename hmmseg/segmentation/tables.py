"""Results as tables, on a terminal, in a notebook and as `repr`."""

from __future__ import annotations

import html
import io
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from hmmseg.segmentation.spans import Segmentation

WIDTH = 120  # characters of a `repr`


def as_text(table: Table) -> str:
    """The table as the terminal shows it, without colours."""
    out = io.StringIO()
    Console(file=out, width=WIDTH, color_system=None).print(table, highlight=False, markup=False)
    return out.getvalue()


def as_html(table: Table) -> str:
    """The table as HTML, for a notebook."""

    def row(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    heads = row([str(column.header) for column in table.columns], "th")
    columns = [[str(cell) for cell in column.cells] for column in table.columns]
    rows = "".join(row(list(cells), "td") for cells in zip(*columns, strict=True))
    caption = f"<caption>{html.escape(str(table.title))}</caption>" if table.title else ""
    return f"<table>{caption}<thead>{heads}</thead><tbody>{rows}</tbody></table>"


def spans_table(segmentation: Segmentation) -> Table:
    """The spans of one trial for people to read."""
    table = Table(title=f"{Path(segmentation.file).name} ({segmentation.rate:.4g} Hz)", title_justify="left")
    for head, justify in (("subtask", "left"), ("state", "left"), ("start [s]", "right"),
                          ("90 % interval", "left"), ("end [s]", "right")):  # fmt: skip
        table.add_column(head, justify=justify)  # type: ignore[arg-type]
    for span in segmentation.spans:
        low, high = span.start_90
        interval = f"{low:.3f} to {high:.3f}" if high > low else ""
        name = f"{span.subtask} {span.object or ''}".strip()
        table.add_row(name, span.state, f"{span.start:.3f}", interval, f"{span.end:.3f}")
    return table
