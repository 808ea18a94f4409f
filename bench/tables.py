"""Tables in Markdown, as commands print them and pages have them."""

from __future__ import annotations

from mi_nerfattack.report.pages.sections import markdown_table as markdown

__all__ = ["markdown", "number"]


def number(value: float) -> str:
    """Return a figure with three digits, or all those before the point."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
