"""Tables of results as text, for `repr`, and as HTML, for a notebook."""

from __future__ import annotations

import html
import io

from rich.console import Console
from rich.table import Table

WIDTH = 120  # look: characters of a `repr`


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
