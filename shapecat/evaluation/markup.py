"""Metrics as text, and tables as HTML."""

from collections.abc import Sequence
from html import escape

__all__ = ["figure_text", "html_table"]


def figure_text(value: float | None, missing: str = "–") -> str:
    """Return a number with three decimals; ``missing`` if it is None."""
    return missing if value is None else f"{value:.3f}"


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as HTML; ``head`` is its header, empty for none."""
    cells = [("th", head)] if head else []
    cells += [("td", row) for row in rows]
    lines = (
        f"<tr>{''.join(f'<{tag}>{escape(cell)}</{tag}>' for cell in row)}</tr>"
        for tag, row in cells
    )
    return f"<table>{''.join(lines)}</table>"
