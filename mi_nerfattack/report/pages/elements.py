"""Parts of HTML pages that need no network and no other file."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

from PIL import Image

from mi_nerfattack.io import files

STYLE = """
:root { color-scheme: light dark; --ink: #1c1e21; --paper: #ffffff; --soft: #5c636b;
  --rule: #d9dde2; --tint: #f4f6f8; --bad: #b34700; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8eb; --paper: #15181c;
  --soft: #9aa3ad; --rule: #343a42; --tint: #1e2329; --bad: #ff9d5c; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.25rem 4rem; max-width: 72rem; color: var(--ink);
  background: var(--paper); font: 1rem/1.55 system-ui, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .7rem; }
p, figcaption, caption { color: var(--soft); max-width: 46rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding-bottom: .5rem; }
th, td { padding: .35rem .9rem .35rem 0; text-align: left; vertical-align: baseline;
  border-bottom: 1px solid var(--rule); white-space: nowrap; }
thead th { color: var(--soft); font-weight: 600; border-bottom-width: 2px; }
td.number, th.number { text-align: right; }
td.bad { color: var(--bad); font-weight: 600; }
tr.first td { border-top: 2px solid var(--rule); }
figure { margin: 0 0 1.8rem; }
figcaption { margin-bottom: .5rem; font-weight: 600; }
img { max-width: 100%; height: auto; display: block; background: #fff;
  border: 1px solid var(--rule); border-radius: 6px; }
pre { background: var(--tint); border: 1px solid var(--rule); border-radius: 6px;
  padding: .9rem 1rem; overflow-x: auto; font: .85rem/1.5 ui-monospace, Menlo, Consolas,
  "DejaVu Sans Mono", monospace; }
@media print { body { max-width: none; } figure, tr { break-inside: avoid; } }
"""

_FRAME = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>$style</style>
</head>
<body>
<header>
<h1>$title</h1>
{lead}
</header>
<main>
{main}
</main>
</body>
</html>
"""


def page(lead: str, main: str) -> Template:
    """Return a page to be filled in, with the places ``title`` and ``style`` as well.

    Args:
        lead: HTML below the title.
        main: HTML of the content; both with places of their own, ``$name``.
    """
    return Template(_FRAME.format(lead=lead, main=main))


def pairs(values: Mapping[str, Any]) -> str:
    """Return a table with a row for each name and its value."""
    rows = "\n".join(_pair(name, value) for name, value in values.items())
    return f"<table><tbody>\n{rows}\n</tbody></table>"


def _pair(name: str, value: Any) -> str:
    text = f"{value:,.1f}" if isinstance(value, float) else str(value)
    return (
        f"<tr><td>{html.escape(str(name))}</td>"
        f'<td class="number">{html.escape(text)}</td></tr>'
    )


def table(
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    bad: Container[tuple[int, int]] = (),
) -> str:
    """Return a table whose first column is text and whose others are numbers.

    Args:
        columns: their names.
        rows: of cells, as many as columns.
        bad: row and column, from 0, of the cells that stand out.
    """
    head = "".join(_cell("th", i, name, False) for i, name in enumerate(columns))
    lines = []
    for i, row in enumerate(rows):
        cells = [_cell("td", j, text, (i, j) in bad) for j, text in enumerate(row)]
        lines.append("<tr>" + "".join(cells) + "</tr>")
    body = "\n".join(lines)
    return f"<table><thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table>"


def _cell(tag: str, column: int, text: str, is_bad: bool) -> str:
    kind = ("number" if column else "") + (" bad" if is_bad else "")
    return f'<{tag} class="{kind}">{html.escape(text)}</{tag}>'


def figure(title: str, path: str | Path) -> str:
    """Return an image file as a figure, embedded as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(files.read_image(path)).save(buffer, "PNG", optimize=True)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    text = html.escape(title)
    return (
        f'<figure><figcaption>{text}</figcaption>\n<img alt="{text}" '
        f'src="data:image/png;base64,{data}"></figure>'
    )
