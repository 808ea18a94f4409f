"""Nets: how they fold, and their sizes as measured in the PDF and in pixels."""

from __future__ import annotations

import re
import zlib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from support.worlds.attacks import COLOURS, made_box

from mi_nerfattack.errors import InputError
from mi_nerfattack.props import paper
from mi_nerfattack.props.net import Net, Rectangle

POINT_MM = 25.4 / 72
# lines end anywhere
PICTURE = re.compile(
    rb"1 0 0 1 (\S+) (\S+) cm (\S+) -?0 -?0 (\S+) -?0 (\S+) cm /I\d+ Do".replace(
        b" ", rb"\s"
    )
)


def pdf_pages(path: Path) -> list[tuple[tuple[float, ...], list[Rectangle]]]:
    """Return the size of each page, and where its pictures lie, millimetres."""
    raw, layouts = path.read_bytes(), []
    pages = re.findall(rb"/MediaBox\s\[\s0\s0\s([^\]]+)\]\s/Contents\s(\d+)\s0\sR", raw)
    for size, number in pages:
        start = raw.index(b"\n%s 0 obj" % number)
        stream = raw.index(b"stream\n", start) + len(b"stream\n")
        text = zlib.decompressobj().decompress(raw[stream:])
        pictures = []
        for values in PICTURE.findall(text):
            x, y, a, d, f = (POINT_MM * float(value) for value in values)
            assert d == pytest.approx(-f)  # rows from the top
            pictures.append(Rectangle(x, y, a, f))
        assert text.count(b" Do") == len(pictures)
        layouts.append((tuple(POINT_MM * float(v) for v in size.split()), pictures))
    return layouts


def coloured(figure, colour, dpi: int = 150) -> tuple[float, float]:
    """Return width and height of what has a colour on a page, millimetres."""
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    canvas.draw()
    same = np.abs(np.asarray(canvas.buffer_rgba())[..., :3] - np.int16(colour)).max(2)
    rows, columns = np.nonzero(same < 8)
    return np.ptp(columns + 1) * 25.4 / dpi, np.ptp(rows + 1) * 25.4 / dpi


@pytest.mark.parametrize("extent", [(1.0, 1.0, 1.0), (1.0, 0.6, 1.4)])
def test_what_meets_on_paper_meets_when_it_is_folded(extent):
    box = made_box(extent=extent)
    net = Net(box.edges_mm(None))

    def in_world(face: str, point) -> np.ndarray:
        spot, (corner, across, down) = net.faces[face], box.plane(face)
        share = (point[0] - spot.left) / spot.width
        return corner + share * across + (spot.top - point[1]) / spot.height * down

    def owners(line) -> list[str]:
        x, y = np.mean(line, 0)
        return [
            face
            for face, r in net.faces.items()
            if r.left - 1e-9 <= x <= r.right + 1e-9
            and r.bottom - 1e-9 <= y <= r.top + 1e-9
        ]

    assert len(net.folds) == 12 and len(net.tabs) == 7
    for line in net.folds[:5]:
        first, second = owners(line)
        for point in line:
            np.testing.assert_allclose(in_world(first, point), in_world(second, point))
    glued = set()
    for tab in net.tabs:
        (face,) = owners((tab.outline[0], tab.outline[3]))
        ends = [in_world(face, tab.outline[i]) for i in (0, 3)]
        corner, across, down = box.plane(tab.under)
        normal = np.cross(across, down)
        for end in ends:
            assert (end - corner) @ normal == pytest.approx(0, abs=1e-9)
        glued.add(tuple(np.round(np.mean(ends, 0), 6)))
    assert len(glued) == 7


def test_one_page_is_exact(tmp_path):
    box = made_box(extent=(1.0, 0.75, 0.5))
    edges = box.edges_mm(40.0)
    assert paper.write_net(tmp_path / "a.pdf", box, edges) == 1
    ((size, pictures),) = pdf_pages(tmp_path / "a.pdf")
    np.testing.assert_allclose(size, (210, 297), atol=0.01)
    extents = sorted((p.width, p.height) for p in pictures)
    expected = [(30, 20), (30, 20), (40, 20), (40, 20), (40, 30), (40, 30)]
    np.testing.assert_allclose(extents, expected, atol=0.01)
    assert b"/Width 472" in (tmp_path / "a.pdf").read_bytes()  # 40 mm of 300 dpi
    (figure,) = paper.pages(
        box, Net(edges), paper.lay_out(Net(edges), "a4"), edges, 150
    )
    x, y, z = edges
    for face, expected in (("front", (x, z)), ("left", (y, z)), ("top", (x, y))):
        np.testing.assert_allclose(coloured(figure, COLOURS[face]), expected, atol=0.5)
    # the ruler, whose outermost ticks are the only black from 12 to 16 mm
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., 0]
    at = pixels.shape[0] - round(15.5 * 150 / 25.4)
    columns = np.nonzero(pixels[at] < 100)[0] * 25.4 / 150
    assert np.ptp(columns) == pytest.approx(100, abs=0.5)


@pytest.mark.parametrize(("sheet", "size"), [("front", (40, 20)), ("top", (40, 30))])
def test_a_flat_object_is_one_sheet(tmp_path, sheet, size):
    box = replace(made_box(extent=(1.0, 0.75, 0.5)), sheet=sheet)
    edges = box.edges_mm(40.0)
    net = Net(edges, sheet)
    assert not net.tabs and not net.folds and len(net.cuts) == 4
    assert (net.bounds.width, net.bounds.height) == pytest.approx(size)
    assert paper.write_net(tmp_path / "a.pdf", box, edges) == 1
    ((_, pictures),) = pdf_pages(tmp_path / "a.pdf")
    assert [(p.width, p.height) for p in pictures] == [pytest.approx(size, abs=0.01)]
    (figure,) = paper.pages(box, net, paper.lay_out(net, "a4"), edges, 150)
    np.testing.assert_allclose(coloured(figure, COLOURS[sheet]), size, atol=0.5)


@pytest.mark.parametrize("name", paper.PAPERS)
def test_pages_that_overlap_add_up(tmp_path, name):
    box = made_box()
    edges = box.edges_mm(120.0)
    net = Net(edges)
    sheets = paper.lay_out(net, name)
    count = paper.write_net(tmp_path / "a.pdf", box, edges, name, 30)
    pages = pdf_pages(tmp_path / "a.pdf")
    assert len(pages) == count == len(sheets.tiles) + 1 > 2
    margin, foot = 10.0, 24.0
    rectangles = []
    for tile, ((width, height), pictures) in zip(sheets.tiles, pages[1:], strict=True):
        assert sorted((width, height)) == pytest.approx(paper.PAPERS[name], abs=0.01)
        dx, dy = tile.part.left - margin, tile.part.bottom - foot
        for p in pictures:
            assert p.left > margin - 0.01 and p.right < width - margin + 0.01
            rectangles.append(Rectangle(p.left + dx, p.bottom + dy, p.width, p.height))
    for face in net.faces.values():
        own = [
            p for p in rectangles if (c := p.common(face)) and c.width * c.height > 0.1
        ]
        covered = np.zeros((120, 120), bool)
        for p in own:
            x0, y0 = p.left - face.left, p.bottom - face.bottom
            columns = slice(round(x0), round(x0 + p.width))
            covered[round(y0) : round(y0 + p.height), columns] = True
        assert covered.all()
        for edge, ends in (
            (face.left, [p.left for p in own]),
            (face.top, [p.top for p in own]),
        ):
            assert min(abs(end - edge) for end in ends) < 0.01
    same_row = [(a.part, b.part) for a, b in pairwise(sheets.tiles) if a.row == b.row]
    assert all(a.right - b.left == pytest.approx(10) for a, b in same_row)


def test_refused(tmp_path):
    box = made_box()
    for size, dpi, message in (
        (5000.0, 300, "--size-mm: the net takes more than .* of a4"),
        (1e100, 300, "--size-mm: the net takes more than"),
        (50.0, 5, "--dpi: 5"),
        (0.0, 300, "--size-mm"),
        (float("nan"), 300, "--size-mm"),
    ):
        with pytest.raises(InputError, match=message):
            paper.write_net(tmp_path / "a.pdf", box, box.edges_mm(size), dpi=dpi)
        assert not list(tmp_path.iterdir())
