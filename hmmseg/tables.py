"""Results that show themselves as tables: as text, for `repr`, and as HTML, for notebooks."""

from __future__ import annotations

import html
import io
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Sequence
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:  # rich is imported when something is shown
    from rich.table import Table

WIDTH = 120  # look: characters of a `repr`


class Brief:
    """A dataclass of many arrays with a short `repr`: shapes and types of its fields."""

    def __repr__(self) -> str:
        inside = (f"{f.name}={_brief(getattr(self, f.name))}" for f in fields(self))  # type: ignore[arg-type]
        return f"{type(self).__name__}({', '.join(inside)})"


def _brief(value: Any) -> str:
    if hasattr(value, "shape"):
        return f"array {tuple(value.shape)}" if value.size > 1 else f"{float(value.sum()):.6g}"
    if is_dataclass(value):
        return type(value).__name__
    if isinstance(value, list | tuple | dict) and value:
        return f"{type(value).__name__} of {len(value)}"
    return repr(value)


class Tabled(ABC):
    """A result that shows itself as its `words`, if it has any, and its `tables`."""

    @abstractmethod
    def tables(self) -> list[Table]:
        """The tables to show."""

    def words(self) -> str:
        """A line to show before them, or nothing."""
        return ""

    def __repr__(self) -> str:
        return "\n".join([*filter(None, [self.words()]), *map(as_text, self.tables())])

    def _repr_html_(self) -> str:
        intro = f"<p>{html.escape(self.words())}</p>" if self.words() else ""
        return intro + "".join(map(as_html, self.tables()))


def listed(
    title: str,
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    right: Collection[str] = (),
    wraps: bool = False,
) -> Table:
    """A table for the terminal.

    Args:
        title: shown above it.
        heads: of the columns; without any there is no header row.
        rows: cells, one per column.
        right: heads of the columns that are right-aligned.
        wraps: whether cells may be wrapped.

    Returns:
        The table.
    """
    from rich.table import Table

    table = Table(title=title, title_justify="left", show_header=bool(heads))
    for head in heads:
        side: Literal["left", "right"] = "right" if head in right else "left"
        table.add_column(head, justify=side, no_wrap=not wraps, overflow="fold" if wraps else "ellipsis")
    for row in rows:
        table.add_row(*row)
    return table


def as_text(table: Table) -> str:
    """The table as the terminal shows it, without colours."""
    from rich.console import Console

    out = io.StringIO()
    # In a notebook rich would display the table itself, and return nothing.
    console = Console(file=out, width=WIDTH, color_system=None, force_jupyter=False)
    console.print(table, highlight=False, markup=False)
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
