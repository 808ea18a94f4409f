"""The net of a box on sheets of paper, as a PDF of exact size."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import missing
from mi_nerfattack.io import files
from mi_nerfattack.props.attacked import AttackedBox
from mi_nerfattack.props.net import MM, Net, Rectangle
from mi_nerfattack.report.plots.charts import RC

try:
    import matplotlib
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
except ImportError as error:
    raise missing("matplotlib", "a net on paper", error) from error

PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
_MARGIN = 10.0  # what printers leave white, millimetres
_FOOTER = 14.0  # of each page: ruler and small print
_OVERLAP = 10.0  # of neighbouring pages
_PAD = 0.5  # around the net, for the width of its lines
_MAX_PAGES = 400
_MAX_DPI = 1200
_THUMBNAIL_PX = 96, 96
_CUT: dict[str, Any] = {"color": "black", "linewidth": 0.5}
_FOLD: dict[str, Any] = {"color": "0.35", "linewidth": 0.3, "dashes": (6, 4)}


@dataclass(frozen=True)
class Tile:
    """What one page shows: its column and row from 0, and a part of the net."""

    column: int
    row: int
    part: Rectangle

    @property
    def name(self) -> str:
        """Column as a letter, row from 1, from the top left: B3."""
        letters, number = "", self.column
        while number >= 0:
            letters = chr(ord("A") + number % 26) + letters
            number = number // 26 - 1
        return f"{letters}{self.row + 1}"


@dataclass(frozen=True)
class Sheets:
    """How a net lies on pages.

    Attributes:
        width, height: of the paper, millimetres.
        columns, rows: of the whole grid; pages without any of the net are left out.
        tiles: the pages, row by row from the top.
    """

    width: float
    height: float
    columns: int
    rows: int
    tiles: tuple[Tile, ...]


def lay_out(net: Net, paper: str) -> Sheets:
    """Tile a net, with the paper turned as needs fewer pages.

    Raises:
        InputError: it would take more than 400 pages.
    """
    short, long = PAPERS[paper]
    sizes = (short, long), (long, short)
    options = [sheets for size in sizes if (sheets := _tiled(net, *size))]
    best = min(options, key=lambda sheets: len(sheets.tiles), default=None)
    if best is None or len(best.tiles) > _MAX_PAGES:
        raise InputError(
            f"--size-mm: the net takes more than the {_MAX_PAGES} pages of {paper} "
            "that are allowed; print it smaller, or on larger --paper"
        )
    return best


def _tiled(net: Net, width: float, height: float) -> Sheets | None:
    """Tile it; None if rows or columns, each with a part of it, exceed the limit."""
    across, high = width - 2 * _MARGIN, height - 2 * _MARGIN - _FOOTER
    bounds = net.bounds
    counts = [
        (size + 2 * _PAD - _OVERLAP) / (page - _OVERLAP)
        for size, page in ((bounds.width, across), (bounds.height, high))
    ]
    if not all(count <= _MAX_PAGES for count in counts):
        return None
    columns, rows = (max(1, math.ceil(count)) for count in counts)
    step_x, step_y = across - _OVERLAP, high - _OVERLAP
    left = bounds.left + (bounds.width - columns * step_x - _OVERLAP) / 2
    top = bounds.top - (bounds.height - rows * step_y - _OVERLAP) / 2
    tiles = [
        Tile(
            c,
            r,
            Rectangle(left + c * step_x, top - r * step_y - high, across, high),
        )
        for r in range(rows)
        for c in range(columns)
    ]
    drawn = [*net.faces.values(), *(Rectangle.around(tab.outline) for tab in net.tabs)]
    used = [t for t in tiles if any(part.common(t.part) for part in drawn)]
    return Sheets(width, height, columns, rows=rows, tiles=tuple(used))


def write_net(
    path: str | Path,
    box: AttackedBox,
    edges_mm: np.ndarray,
    paper: str = "a4",
    dpi: int = 300,
    on_page: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write the net of a box as a PDF, atomically.

    Args:
        path: the file.
        box: what is printed; colours are sRGB, as they are.
        edges_mm: (3,), printed edges.
        paper: one of `PAPERS`.
        dpi: pixels an inch of the faces.
        on_page: called with (pages done, all pages).

    Returns:
        Number of pages.

    Raises:
        InputError: too many pages, an impossible resolution, or a file that cannot be
            written.
    """
    if not 10 <= dpi <= _MAX_DPI:
        raise InputError(f"--dpi: {dpi}; allowed are 10 to {_MAX_DPI}")
    net = Net(edges_mm, box.sheet)
    sheets = lay_out(net, paper)
    total = len(sheets.tiles) + (len(sheets.tiles) > 1)
    metadata = {"Title": f"{box.name}, run {box.run}", "CreationDate": None}
    buffer = io.BytesIO()
    with matplotlib.rc_context(RC), PdfPages(buffer, metadata=metadata) as pdf:
        for done, page in enumerate(
            pages(box, net, sheets, edges_mm=edges_mm, dpi=dpi), 1
        ):
            pdf.savefig(page)
            on_page(done, total)
    files.write_bytes(path, buffer.getvalue())
    return total


def pages(
    box: AttackedBox, net: Net, sheets: Sheets, edges_mm: np.ndarray, dpi: int
) -> Iterator[Figure]:
    """Draw the pages; of several, one before them shows how they lie."""
    edges = " x ".join(f"{edge:.1f}" for edge in edges_mm)
    description = (
        f"{box.name}, run {box.run}, digest {box.digest[:16]}; edges {edges} mm, "
        f"{dpi} dpi, sRGB"
    )
    if len(sheets.tiles) > 1:
        yield _overview(box, net, sheets, description=description)
    for tile in sheets.tiles:
        yield _page(box, net, sheets, tile=tile, dpi=dpi, description=description)


def _page(
    box: AttackedBox, net: Net, sheets: Sheets, tile: Tile, dpi: int, description: str
) -> Figure:
    part = tile.part
    place = Rectangle(_MARGIN, _MARGIN + _FOOTER, part.width, part.height)
    figure, axes = _sheet(sheets, place, part)
    shown = []
    for face, rectangle in net.faces.items():
        common = rectangle.common(part)
        if common is not None:
            shown.append(face)
            _paint(axes, box.images[face], rectangle, part=common, dpi=dpi)
    _draw_lines(axes, net)
    _mark_neighbours(figure, sheets, tile, place=place)
    where = f"page {tile.name} of A1 to {_last(sheets)}; " * (len(sheets.tiles) > 1)
    _foot(
        figure,
        sheets,
        f"{where}faces: {', '.join(shown) or 'none'}",
        description=description,
    )
    return figure


def _paint(
    axes: Any, image: np.ndarray, rectangle: Rectangle, part: Rectangle, dpi: int
) -> None:
    """Show the part of a picture that lies on a page, at the page's resolution."""
    height, width = image.shape[:2]
    scale_x, scale_y = width / rectangle.width, height / rectangle.height
    source = (
        max(0.0, (part.left - rectangle.left) * scale_x),
        max(0.0, (rectangle.top - part.top) * scale_y),
        min(float(width), (part.right - rectangle.left) * scale_x),
        min(float(height), (rectangle.top - part.bottom) * scale_y),
    )
    across, down = (max(1, round(e / MM * dpi)) for e in (part.width, part.height))
    pixels = Image.fromarray(image).resize(
        (across, down), Image.Resampling.BICUBIC, source
    )
    extent = part.left, part.right, part.bottom, part.top
    axes.imshow(np.asarray(pixels), extent=extent, interpolation="none", aspect="auto")


def _sheet(sheets: Sheets, place: Rectangle, shows: Rectangle) -> tuple[Figure, Any]:
    """Make a page whose part `place` shows a part of the net."""
    width, height = sheets.width, sheets.height
    figure = Figure((width / MM, height / MM))
    spot = place.left / width, place.bottom / height
    axes = figure.add_axes((*spot, place.width / width, place.height / height))
    axes.set_axis_off()
    # pictures would stretch them
    axes.set_autoscale_on(False)
    axes.set_xlim(shows.left, shows.right)
    axes.set_ylim(shows.bottom, shows.top)
    return figure, axes


def _draw_lines(axes: Any, net: Net) -> None:
    for lines, style in ((net.folds, _FOLD), (net.cuts, _CUT)):
        for (x0, y0), (x1, y1) in lines:
            axes.add_line(Line2D([x0, x1], [y0, y1], **style))
    for tab in net.tabs:
        x, y = np.mean(tab.outline, 0)
        (x0, y0), (x1, y1) = tab.outline[0], tab.outline[-1]
        fold = math.hypot(x1 - x0, y1 - y0)
        axes.text(
            x,
            y,
            f"glue under {tab.under}",
            fontsize=min(6.0, 0.15 * fold),  # half of the fold's length
            ha="center",
            va="center",
            rotation=90 if x0 == x1 else 0,
            clip_on=True,
        )


def _mark_neighbours(
    figure: Figure, sheets: Sheets, tile: Tile, place: Rectangle
) -> None:
    """Tick, in the margin, the middle of what this page shares with its neighbours."""
    half, tick = _OVERLAP / 2, 6.0
    sides = {
        (-1, 0): (place.left + half, None),
        (1, 0): (place.right - half, None),
        (0, -1): (None, place.top - half),
        (0, 1): (None, place.bottom + half),
    }
    names = {(t.column, t.row): t.name for t in sheets.tiles}
    for (column, row), (x, y) in sides.items():
        other = names.get((tile.column + column, tile.row + row))
        if other is None:
            continue
        if x is not None:
            spans = (place.top, place.top + tick), (place.bottom - tick, place.bottom)
            for low, high in spans:
                _line(figure, sheets, (x, x), ys=(low, high))
            _text(figure, sheets, x + 1, y=place.top + 2, text=f"cut or lay on {other}")
        elif y is not None:
            spans = (place.left - tick, place.left), (place.right, place.right + tick)
            for low, high in spans:
                _line(figure, sheets, (low, high), ys=(y, y))
            note = f"cut or lay on {other}"
            _text(figure, sheets, place.left - 4, y=y + 1, text=note, rotation=90)


def _foot(figure: Figure, sheets: Sheets, where: str, description: str) -> None:
    """Draw a ruler of 100 mm and the small print."""
    base = _MARGIN + 3
    _line(figure, sheets, (_MARGIN, _MARGIN + 100), ys=(base, base))
    for centimetre in range(11):
        x, rise = _MARGIN + 10 * centimetre, 3.0 if centimetre % 5 == 0 else 1.5
        _line(figure, sheets, (x, x), ys=(base, base + rise))
    note = "100 mm: measure; print at 100 %, not fitted to the page"
    _text(figure, sheets, _MARGIN, y=_MARGIN - 0.5, text=note)
    _text(figure, sheets, _MARGIN + 104, y=_MARGIN + 3.5, text=where)
    _text(figure, sheets, _MARGIN + 104, y=_MARGIN - 0.5, text=description)


def _overview(box: AttackedBox, net: Net, sheets: Sheets, description: str) -> Figure:
    """Show the whole net, reduced, with the names of faces and pages."""
    rectangles = [tile.part for tile in sheets.tiles]
    left, bottom = min(p.left for p in rectangles), min(p.bottom for p in rectangles)
    width = max(p.right for p in rectangles) - left
    height = max(p.top for p in rectangles) - bottom
    room = sheets.width - 2 * _MARGIN, sheets.height - 2 * _MARGIN - _FOOTER
    scale = min(room[0] / width, room[1] / height)
    place = Rectangle(_MARGIN, _MARGIN + _FOOTER, scale * width, scale * height)
    figure, axes = _sheet(sheets, place, Rectangle(left, bottom, width, height))
    for face, spot in net.faces.items():
        small = Image.fromarray(box.images[face]).resize(_THUMBNAIL_PX)
        extent = spot.left, spot.right, spot.bottom, spot.top
        axes.imshow(
            np.asarray(small), extent=extent, interpolation="none", aspect="auto"
        )
        x, y = spot.left + spot.width / 2, spot.bottom + spot.height / 2
        frame = {"facecolor": "white", "linewidth": 0, "pad": 1}
        axes.text(x, y, face, fontsize=8, ha="center", va="center", bbox=frame)
    for tile in sheets.tiles:
        part = tile.part
        xs = [part.left, part.right, part.right, part.left, part.left]
        ys = [part.bottom, part.bottom, part.top, part.top, part.bottom]
        axes.add_line(Line2D(xs, ys, color="tab:blue", linewidth=0.4))
        axes.text(part.left, part.top, f" {tile.name}", fontsize=6, va="top")
    count = len(sheets.tiles)
    where = f"reduced: how {count} pages, A1 to {_last(sheets)}, lie side by side"
    _foot(figure, sheets, where, description=description)
    return figure


def _last(sheets: Sheets) -> str:
    return Tile(sheets.columns - 1, sheets.rows - 1, Rectangle(0, 0, 0, 0)).name


def _line(
    figure: Figure, sheets: Sheets, xs: tuple[float, float], ys: tuple[float, float]
) -> None:
    """Draw a line, millimetres from the page's lower left corner."""
    across = [x / sheets.width for x in xs]
    up = [y / sheets.height for y in ys]
    line = Line2D(across, up, transform=figure.transFigure, **_CUT)
    figure.add_artist(line)


def _text(
    figure: Figure, sheets: Sheets, x: float, y: float, text: str, **style: Any
) -> None:
    """Write small print, millimetres from the page's lower left corner."""
    figure.text(x / sheets.width, y / sheets.height, text, fontsize=5, **style)
