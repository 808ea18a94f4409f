"""What a page holds and says, read as a browser would."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from mi_nerfattack.report.plots import charts
from mi_nerfattack.report.plots import map as maps

_VOID = ("meta", "img", "input", "br")


class PageReader(HTMLParser):
    """Collects text, tables, pictures and addresses, and checks that tags nest.

    Attributes:
        text: all of it.
        rows: cells of every table's rows, as text.
        images: attributes of each picture.
        addresses: all that the page could fetch, `data:` URIs and fragments, too.
    """

    def __init__(self, page: str) -> None:
        super().__init__()
        self.text, self.rows, self.images = "", [], []
        self.addresses = re.findall(r"url\(([^)]*)\)|@import", page)
        self._open = []
        self.feed(page)
        self.close()
        assert self._open == []
        self.rows = [[" ".join(cell.split()) for cell in row] for row in self.rows]

    def handle_starttag(self, tag, attrs):
        values, fetched = dict(attrs), "src srcset href action data poster".split()
        self.addresses += [value for key, value in attrs if key in fetched]
        if tag == "link":
            self.addresses.append("link")
        if tag == "img":
            self.images.append(values)
        if tag == "br":
            self.handle_data(" ")
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in _VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if {"td", "th"} & set(self._open):
            self.rows[-1][-1] += data

    def check_alone(self):
        """Assert that nothing but the file itself is needed, nor a picture unsaid."""
        for address in self.addresses:
            assert address.startswith(("data:image/", "#")), address[:80]
        assert all(image["alt"] for image in self.images)


def page_text(path: Path) -> str:
    """Read a page; each `data:` URI is cut out, for it may spell any word."""
    return re.sub(r'(?<=")data:[^"]*', "data:", path.read_text("utf-8"))


def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Return a list that gets the figures of plots, which are not written."""
    figures: list[Figure] = []
    for module in (charts, maps):
        monkeypatch.setattr(module, "save", lambda _, figure: figures.append(figure))
    return figures
