"""A page of sections, as HTML or Markdown: sentences, tables, facts and pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mi_nerfattack.io import files
from mi_nerfattack.io.strict import finite
from mi_nerfattack.report.columns import Table
from mi_nerfattack.report.pages.elements import render

# What ends a cell of a table or begins an element, and how Markdown shows it.
_IN_MARKDOWN = str.maketrans({"&": "&amp;", "<": "&lt;", "|": "\\|", "\n": " "})


@dataclass(frozen=True)
class Picture:
    """An image file under its title; HTML holds it, Markdown names it."""

    title: str
    path: Path


#: A sentence, a table, facts by name, or a picture.
Block = str | Table | Mapping[str, Any] | Picture
Sections = Mapping[str, Iterable[Block]]


def write_report(
    folder: Path,
    title: str,
    verdict: str,
    metrics: Mapping[str, Any],
    sections: Sections,
) -> Path:
    """Write `metrics.json` and then `report.html`, which holds its pictures.

    Args:
        folder: exists; files of these names are replaced.
        title: of the page.
        verdict: below the title.
        metrics: numbers for programs; what is not finite becomes null.
        sections: content by title.

    Returns:
        Path of the page.
    """
    files.write_json(folder / "metrics.json", finite(metrics))
    page = folder / "report.html"
    files.write_text(
        page,
        render("sections.html.j2", title=title, verdict=verdict, sections=sections),
    )
    return page


def markdown(title: str, lead: str, sections: Sections) -> str:
    """Return a page as Markdown, in which no text ends a cell or begins an element.

    Args:
        title: of the page; text from `code` in it stays as it is, as everywhere.
        lead: below the title.
        sections: content by title.
    """
    paragraphs = [f"# {escaped(title)}", escaped(lead)]
    for name, blocks in sections.items():
        paragraphs += [f"## {escaped(name)}", *map(_as_markdown, blocks)]
    return "\n\n".join(paragraphs) + "\n"


def code(value: str) -> Markup:
    """Return text as Markdown's code, in which only its own mark and `|` count."""
    return Markup("`" + value.replace("`", "'").replace("|", "\\|") + "`")


def _as_markdown(block: Block) -> str:
    if isinstance(block, str):
        return escaped(block)
    if isinstance(block, Picture):
        return f"![{escaped(block.title)}]({escaped(block.path.name)})"
    if isinstance(block, Mapping):
        lines = [("", ""), *block.items()]
    else:
        lines = [[column.header for column in (*block.labels, *block.shown)]]
        lines += [[*names, *(c.text for c in cells)] for _, names, cells in block.body]
    header, *rows = [list(map(escaped, cells)) for cells in lines]
    return markdown_table(header, rows)


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown.

    Args:
        header: of the columns.
        rows: cells.
    """
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def escaped(text: object) -> str:
    """Return the text of a cell of a table in Markdown; its markup stays."""
    return text if isinstance(text, Markup) else str(text).translate(_IN_MARKDOWN)
