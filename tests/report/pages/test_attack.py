"""The page of an attack holds everything, and nothing else runs in it."""

from __future__ import annotations

import base64
from html.parser import HTMLParser

import numpy as np
import pytest
from helpers.made_drives import COST, make_document, make_drive

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation import metrics
from mi_nerfattack.io import files
from mi_nerfattack.report.pages import attack as page
from mi_nerfattack.rollout.drive import Lane


class Reader(HTMLParser):
    """Collect text and image sources, and check that tags nest."""

    def __init__(self):
        super().__init__()
        self.open, self.text, self.sources, self.links = [], [], [], []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        if tag == "img":
            self.sources.append(values["src"])
        self.links += [v for k, v in attrs if k in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def test_page_is_self_contained_and_escaped(tmp_path):
    pixels = np.random.default_rng(4).integers(0, 256, (5, 6, 3), dtype=np.uint8)
    files.write_image(tmp_path / "a.png", pixels)
    drives = [
        make_drive([0.125], route="<b>x</b>"),
        make_drive([1.0], route="<b>x</b>", run=1),
    ]
    document = metrics.metrics_document(
        {"name": "<i>"}, 7, drives, {"<b>x</b>": Lane(0.85, 1.75)}, COST
    )
    title, scenario = 'Plot "1" <script>alert(1)</script>', "a = '</pre>$seed & <i>'"
    path = tmp_path / "report.html"
    page.write_report(
        path, document, {title: tmp_path / "a.png"}, scenario, {"mitsuba": "3.9<1"}
    )
    reader = Reader()
    reader.feed(files.read_text(path))
    reader.close()
    text = "".join(reader.text)
    assert reader.open == []
    assert scenario in text
    assert title in text
    assert "3.9<1" in text
    assert "0.562" in text
    assert "<title>&lt;i&gt;</title>" in files.read_text(path)
    assert "<script" not in files.read_text(path)
    assert all(link.startswith("data:") for link in reader.links)
    (source,) = reader.sources
    (tmp_path / "b.png").write_bytes(base64.b64decode(source.partition(",")[2]))
    np.testing.assert_array_equal(files.read_image(tmp_path / "b.png"), pixels)


def test_page_names_a_missing_picture(tmp_path):
    images = {"a": tmp_path / "none.png"}
    with pytest.raises(InputError, match=r"none\.png"):
        page.write_report(tmp_path / "r.html", make_document(), images, "", {})
    assert not (tmp_path / "r.html").exists()
